"""Trees, bushes and hedges: trunks and see-through crowns of small leaf triangles."""

from __future__ import annotations

import numpy as np

from sc3d.synthetic.mesh import BARK, LEAF, TREE, MeshBuilder, face_normals, linear, upright_pose

LEAF_TINTS = [(74, 104, 48), (90, 120, 50), (58, 88, 44), (96, 118, 50), (66, 100, 58), (108, 124, 60)]
CONIFER_TINT = (48, 76, 50)
LEAF_SIDE = 0.36  # m


def add_tree(
    builder: MeshBuilder,
    position: np.ndarray,
    radius: float,
    rng: np.random.Generator,
    leaf_side: float = LEAF_SIDE,
    stem: float | None = None,
) -> None:
    """A broad-leaved tree at `position` (3,) on the ground with a crown of `radius` m: lobes on an ellipsoid,
    leaves of `leaf_side` m on the lobes; stem: height of its lowest leaves, m, None = any.
    """
    object_id = builder.new_object()
    height = radius * rng.uniform(0.75, 1.0)  # vertical half axis of the crown
    usual = rng.uniform(1.6, 2.4) + 0.35 * radius
    stem = usual if stem is None else stem + 0.15 * height
    crown = position + [0, 0, stem + height]
    _add_trunk(builder, position, stem + 0.8 * height, 0.07 * radius + 0.08, object_id, rng)
    num_lobes = int(9 + 3 * radius)
    directions = _sphere(num_lobes, rng)
    directions[:, 2] = 1.15 * np.abs(directions[:, 2]) - 0.35  # few lobes hang low
    lobes = crown + directions * [radius, radius, height] * rng.uniform(0.5, 0.72, (num_lobes, 1))
    sizes = radius * rng.uniform(0.3, 0.48, num_lobes)
    num_leaves = int(330 * radius**2 * (LEAF_SIDE / leaf_side) ** 1.6)
    lobe = rng.choice(num_lobes, num_leaves, p=sizes**2 / (sizes**2).sum())
    outward = _sphere(num_leaves, rng)
    reach = sizes[lobe] * rng.uniform(0.75, 1.08, num_leaves)
    centers = lobes[lobe] + outward * reach[:, None] * [1, 1, 0.8]
    depth = np.linalg.norm((centers - crown) / [radius, radius, height], axis=1)
    tint = linear(LEAF_TINTS[rng.integers(len(LEAF_TINTS))]) * rng.uniform(0.88, 1.12, 3)
    shade = (0.45 + 0.6 * np.clip(depth, 0, 1.1)) * rng.uniform(0.8, 1.2, num_lobes)[lobe]
    _add_leaves(builder, centers, outward, tint * shade[:, None], object_id, rng, leaf_side)


def add_conifer(builder: MeshBuilder, position: np.ndarray, radius: float, rng: np.random.Generator) -> None:
    """A conical tree with whorls of drooping branches; `radius` m at its foot, four to five times as tall."""
    object_id = builder.new_object()
    height = radius * rng.uniform(3.6, 4.6)
    _add_trunk(builder, position, 0.9 * height, 0.07 * radius + 0.06, object_id, rng)
    num_leaves = int(420 * radius**2)
    level = 1.0 - np.sqrt(rng.random(num_leaves))
    level = 0.5 * level + 0.5 * np.round(level * 9) / 9
    angle = rng.uniform(0, 2 * np.pi, num_leaves)
    spikes = 0.78 + 0.22 * np.sin(7 * angle + 9 * level)
    reach = radius * (1 - level) * spikes * rng.uniform(0.3, 1.0, num_leaves) ** 0.4
    centers = position + np.stack(
        [reach * np.cos(angle), reach * np.sin(angle), 0.9 + level * (height - 0.9) - 0.25 * reach], 1
    )
    outward = np.stack([np.cos(angle), np.sin(angle), np.full(num_leaves, 0.6)], 1) / np.sqrt(1.36)
    shade = rng.uniform(0.7, 1.3, num_leaves) * (0.5 + 0.6 * reach / np.maximum(radius * (1 - level), 0.1))
    _add_leaves(builder, centers, outward, linear(CONIFER_TINT) * shade[:, None], object_id, rng)


def add_bush(
    builder: MeshBuilder,
    position: np.ndarray,
    half: tuple[float, float, float],
    yaw: float,
    rng: np.random.Generator,
    leaf_side: float = LEAF_SIDE,
) -> None:
    """A bush or a piece of hedge: leaves on a rounded box of half sizes `half` m, standing on `position`
    (3,).
    """
    object_id = builder.new_object()
    turn = upright_pose(np.zeros(3), yaw)[:3, :3]
    area = half[0] * half[1] + 2 * half[2] * (half[0] + half[1])
    num_leaves = int((60 + 22 * area) * (LEAF_SIDE / leaf_side) ** 1.6)
    outward = _sphere(num_leaves, rng)
    outward[:, 2] = np.abs(outward[:, 2])
    boxed = outward / np.maximum((np.abs(outward) ** 3).sum(1, keepdims=True) ** (1 / 3), 1e-9)
    local = boxed * np.asarray(half) * rng.uniform(0.8, 1.08, (num_leaves, 1))
    centers = position + [0, 0, 0.15] + (local * [1, 1, 1.7]) @ turn.T
    tint = linear(LEAF_TINTS[rng.integers(len(LEAF_TINTS))]) * rng.uniform(0.8, 1.2)
    shade = rng.uniform(0.7, 1.2, num_leaves) * (0.6 + 0.45 * outward[:, 2])
    _add_leaves(builder, centers, outward @ turn.T, tint * shade[:, None], object_id, rng, leaf_side)


def add_bough(builder: MeshBuilder, base: np.ndarray, tip: np.ndarray, rng: np.random.Generator) -> None:
    """A bough from `base` to `tip`, (3,) world, with leaves of 7 cm that hang from its outer part."""
    object_id = builder.new_object()
    num_leaves = 160
    along = rng.uniform(0.55, 1.05, num_leaves)
    way = base + along[:, None] * (tip - base)
    outward = _sphere(num_leaves, rng)
    hang = np.abs(rng.normal(0, 0.12, num_leaves))
    centers = way + outward * rng.uniform(0.02, 0.16, (num_leaves, 1)) - hang[:, None] * [0, 0, 1]
    tint = linear(LEAF_TINTS[rng.integers(len(LEAF_TINTS))])
    shade = rng.uniform(0.7, 1.3, (num_leaves, 1))
    _add_leaves(builder, centers, outward, tint * shade, object_id, rng, 0.07)
    axis = (tip - base) / np.linalg.norm(tip - base)
    side = np.cross(axis, [0.0, 0.0, 1.0])
    side /= np.linalg.norm(side)
    corners = [side, np.cross(axis, side), -side, -np.cross(axis, side)]
    for i in range(4):
        a, b = corners[i], corners[(i + 1) % 4]
        quad = np.stack([base + 0.045 * b, base + 0.045 * a, tip + 0.008 * a, tip + 0.008 * b])
        builder.polygon(quad, (BARK, TREE, object_id), linear((104, 84, 64)))


def _add_leaves(
    builder: MeshBuilder,
    centers: np.ndarray,
    outward: np.ndarray,
    tints: np.ndarray,
    object_id: int,
    rng: np.random.Generator,
    leaf_side: float = LEAF_SIDE,
) -> None:
    """Leaf triangles at `centers` (N, 3), roughly facing `outward`; shaded as parts of the crown, which is
    what they look like from above. Small ones are seen from near: they are pointed at both ends.
    """
    facing = outward + 0.8 * _sphere(len(centers), rng)
    facing /= np.linalg.norm(facing, axis=1, keepdims=True)
    side = np.cross(facing, _sphere(len(centers), rng))
    side /= np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-9)
    up = np.cross(facing, side)
    size = leaf_side * rng.uniform(0.7, 1.3, (len(centers), 1))
    corners = np.stack(
        [
            centers - 0.5 * size * side - 0.3 * size * up,
            centers + 0.5 * size * side - 0.3 * size * up,
            centers + 0.6 * size * up,
        ],
        1,
    )
    if leaf_side < LEAF_SIDE:
        far = centers[:, None] - 0.9 * (size * up)[:, None]
        corners = np.concatenate([corners, np.concatenate([far, corners[:, 1::-1][:, :2]], 1)])
        outward, tints, centers = np.tile(outward, (2, 1)), np.tile(tints, (2, 1)), np.tile(centers, (2, 1))
    normals = 0.7 * outward + 0.3 * face_normals(corners) + [0, 0, 0.25]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    builder.add(
        corners, (LEAF, TREE, object_id), tints * rng.uniform(0.75, 1.25, (len(centers), 1)), normals=normals
    )


def _add_trunk(
    builder: MeshBuilder,
    position: np.ndarray,
    height: float,
    radius: float,
    object_id: int,
    rng: np.random.Generator,
) -> None:
    """A six-sided tapering trunk that starts below the ground."""
    angle = np.arange(6) * np.pi / 3 + rng.uniform(0, 1)
    ring = np.stack([np.cos(angle), np.sin(angle), np.zeros(6)], 1)
    lean = np.array([*rng.normal(0, 0.03, 2) * height, height])
    low, high = position + ring * radius * 1.3 - [0, 0, 0.4], position + ring * radius * 0.5 + lean
    tint = linear((104, 84, 64)) * rng.uniform(0.7, 1.1)
    for i in range(6):
        j = (i + 1) % 6
        builder.polygon(np.stack([low[i], low[j], high[j], high[i]]), (BARK, TREE, object_id), tint)


def _sphere(num: int, rng: np.random.Generator) -> np.ndarray:
    """(num, 3) random unit vectors."""
    vectors = rng.normal(size=(num, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
