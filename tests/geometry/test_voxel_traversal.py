"""The voxel grid as a surface: a step-by-step twin of the traversal, analytic shapes, floaters and gaps, both
directions of visibility.
"""

import numba
import numpy as np
import open3d as o3d
import pytest

from sc3d.geometry.cameras import look_at, pinhole_view, rays
from sc3d.geometry.neighbors import NeighborIndex
from sc3d.geometry.raycast import Surface, first_surface, nearest_points, see_points
from sc3d.geometry.voxel_patches import Patches
from sc3d.geometry.voxel_traversal import VoxelSurface
from sc3d.geometry.voxels import voxel_keys
from sc3d.labelling.cloud import Cloud
from sc3d.labelling.fusion import fuse
from sc3d.scene.labelled_cloud import SURFACE_VOXEL, read_surface, spacing_of
from sc3d.scene.labels import UNSEEN
from sc3d.settings.labels import Label

UP = np.float32([0, 0, 1])
DIAGONALS = [np.float32([x, y, z]) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if x or y or z]


def unit(vectors: np.ndarray) -> np.ndarray:
    return (vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)).astype(np.float32)


def camera_at(center: np.ndarray):
    """A view whose camera frame is the world, moved to `center`: directions are world directions."""
    cam_from_world = np.eye(4)
    cam_from_world[:3, 3] = -center
    return pinhole_view("a", (4, 4), (4, 4, 2, 2), cam_from_world)


def occupancy(rng: np.random.Generator, extent: int, share: float) -> np.ndarray:
    """(V, 3) random voxels in the order of their keys, over several blocks, most of them empty."""
    voxels = np.argwhere(rng.random((extent, extent, extent)) < share) + 8
    return voxels[np.argsort(voxel_keys(voxels + 0.5, np.zeros(3), 1.0))]


def patches_of(voxels: np.ndarray, shapes: np.ndarray, voxel_size: float) -> Patches:
    keys = voxel_keys(voxels + 0.5, np.zeros(3), 1.0)
    return Patches.from_shapes(keys, shapes.astype(np.float32), voxel_size, np.zeros(3))


def rays_from(rng: np.random.Generator, extent: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Starts (3,) in voxels and directions (K, 3): outside and inside the grid, on voxel corners; along axes
    and diagonals, towards corners, any.
    """
    middle = 8 + extent / 2
    starts = (
        [middle + extent * d for d in DIAGONALS]
        + list(rng.uniform(8, 8 + extent, (10, 3)))
        + list(rng.integers(8, 8 + extent, (10, 3)).astype(float))
    )
    starts += [np.array([middle, middle, -5.0]), np.array([8.0, 8.0, 100.0])]
    bundles = []
    for start in starts:
        corners = rng.integers(8, 9 + extent, (30, 3)) - start
        directions = np.concatenate(
            [DIAGONALS, rng.normal(size=(40, 3)), corners[np.abs(corners).max(axis=1) > 0]]
        )
        bundles.append((start, unit(directions)))
    return bundles


def slow_hits(
    shapes: np.ndarray, positions: np.ndarray, directions: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Range and |cosine| (K,) of the nearer of the patches (K, 2, 12) of one voxel per ray; positions (K, 3)
    from the voxel's corner.
    """
    d, n, away = directions[:, None], shapes[:, :, 3:6], shapes[:, :, :3] - positions[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = np.where(d == 0, 1e300, 1 / d)
        times = (
            np.stack([shapes[:, :, 6:9] - positions[:, None], shapes[:, :, 9:] - positions[:, None]])
            * inverse
        )
        enter, leave = times.min(axis=0).max(axis=2), times.max(axis=0).min(axis=2)
        slope, scattered = dot(d, n), (n == 0).all(axis=2)
        distance = np.where(
            scattered, np.maximum(enter, np.minimum(leave, dot(away, d))), dot(away, n) / slope
        )
        distance[~((distance > 0) & (enter <= distance) & (distance <= leave))] = np.inf
    nearest, rows = distance.argmin(axis=1), np.arange(len(distance))
    return distance[rows, nearest], np.where(scattered, 1, np.abs(slope))[rows, nearest]


def dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    # in the order of the kernel, to the bit
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]


def slow_trace(
    lookup: np.ndarray, shapes: np.ndarray, positions: np.ndarray, directions: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """A DDA over single voxels without blocks or bounds, for all rays (K, 3) at once; lookup: (S, S, S) row
    of a voxel, -1 = nothing there.
    """
    voxels, ahead, rows = (
        np.floor(positions).astype(int),
        (directions >= 0).astype(int),
        np.arange(len(positions)),
    )
    inverse = np.divide(1, directions, out=np.zeros_like(directions), where=directions != 0)
    distance, incidence = np.full(len(rows), np.inf), np.zeros(len(rows))
    for _ in range(300):
        inside = rows[np.isinf(distance) & ((voxels >= 0) & (voxels < len(lookup))).all(axis=1)]
        found = inside[lookup[tuple(voxels[inside].T)] >= 0]
        ranges, cosines = slow_hits(
            shapes[lookup[tuple(voxels[found].T)]], (positions - voxels)[found], directions[found]
        )
        distance[found], incidence[found] = ranges, np.where(np.isfinite(ranges), cosines, 0)
        # the first of equal ones
        axis = np.where(directions == 0, np.inf, (voxels + ahead - positions) * inverse).argmin(axis=1)
        voxels[rows, axis] += 2 * ahead[rows, axis] - 1
    return distance, incidence


@pytest.mark.parametrize(
    ("seed", "share", "voxel_size", "num_hits"),
    [(0, 0.002, 0.25, 30), (1, 0.03, 0.25, 500), (2, 0.3, 1.0, 2000)],
)
def test_hits_are_those_of_a_dda_over_single_voxels(seed, share, voxel_size, num_hits):
    rng = np.random.default_rng(seed)
    voxels = occupancy(rng, 30, share)
    shapes = np.concatenate(
        [
            rng.random((len(voxels), 2, 3)),
            unit(rng.normal(size=(len(voxels), 2, 3))),
            rng.uniform(-0.2, 0.3, (len(voxels), 2, 3)),
            rng.uniform(0.7, 1.2, (len(voxels), 2, 3)),
        ],
        axis=2,
    ).astype(np.float32)
    kind = rng.random(len(voxels))
    shapes[kind < 0.4, 1] = np.nan  # one side only
    shapes[kind < 0.2, 0, 3:6] = 0  # scattered points
    surface = VoxelSurface(patches_of(voxels, shapes, voxel_size))
    lookup = np.full((48, 48, 48), -1)
    lookup[tuple(voxels.T)] = np.arange(len(voxels))
    bundles = rays_from(rng, 30)
    fast = np.concatenate(
        [surface.cast(camera_at(start * voxel_size), directions) for start, directions in bundles], axis=1
    )
    starts = np.concatenate([np.tile(start, (len(directions), 1)) for start, directions in bundles])
    directions = np.concatenate([directions for _, directions in bundles]).astype(np.float64)
    distance, incidence = slow_trace(lookup, shapes.astype(np.float64), starts, directions)
    np.testing.assert_array_equal(fast[0], (distance * voxel_size).astype(np.float32))
    np.testing.assert_array_equal(fast[1], incidence.astype(np.float32))
    assert (
        np.isfinite(distance).sum() > num_hits
        and (directions == 0).any(axis=1)[np.isfinite(distance)].sum() > num_hits / 20
    )


def test_the_first_voxel_is_that_of_a_slab_test_over_all_voxels():
    rng = np.random.default_rng(3)
    voxels = occupancy(rng, 24, 0.01)
    shapes = np.full((len(voxels), 2, 12), np.nan)
    # a ray that enters is stopped beside the middle
    shapes[:, 0, :3], shapes[:, 0, 3:6], shapes[:, 0, 6:9], shapes[:, 0, 9:] = 0.5, 0, 0, 1
    surface = VoxelSurface(patches_of(voxels, shapes, 1.0))
    for start in [*rng.uniform(8, 32, (10, 3)), *rng.uniform(-40, 80, (10, 3))]:
        directions = unit(rng.normal(size=(200, 3)) + 0.5 * (20 - start) / 30)
        distance, _ = surface.cast(camera_at(start), directions)
        times = (np.stack([voxels, voxels + 1]) - start)[:, None] / directions.astype(np.float64)[
            None, :, None
        ]
        enters, leaves = times.min(axis=0).max(axis=2), times.max(axis=0).min(axis=2)
        first = np.clip((voxels + 0.5 - start) @ directions.T.astype(np.float64), enters.T, leaves.T).T
        blocked = (first > 0) & (leaves > enters)
        nearest = np.where(blocked, enters, np.inf).argmin(axis=1)
        rows = np.arange(len(directions))
        np.testing.assert_allclose(
            distance, np.where(blocked.any(axis=1), first[rows, nearest], np.inf), rtol=1e-5, atol=1e-5
        )


def test_no_ray_and_no_surface_give_nothing():
    points = np.random.default_rng(0).uniform(0, 100, (200, 3))  # floaters only
    surface = VoxelSurface.from_cloud(points, np.tile(UP, (200, 1)), 0.5)
    distance, incidence = surface.cast(
        camera_at(np.zeros(3)), unit(np.random.default_rng(1).normal(size=(50, 3)))
    )
    assert np.isinf(distance).all() and (incidence == 0).all()
    plane = np.random.default_rng(0).uniform(0, 4, (2000, 3)) * [1, 1, 0]
    distance, _ = VoxelSurface.from_cloud(plane, np.tile(UP, (2000, 1)), 0.3).cast(
        camera_at(np.array([2.0, 2, 5])), np.float32([[np.nan] * 3, [0, 0, -1]])
    )
    assert np.isinf(distance[0]) and abs(distance[1] - 5) < 1e-5


def sphere(num: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Random points of a sphere of radius 2, and its normals."""
    normals = np.random.default_rng(seed).normal(size=(num, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return 2 * normals, normals.astype(np.float32)


def ring(size: int = 300) -> list:
    """Views of a sphere of radius 2 from all sides."""
    directions = np.random.default_rng(0).normal(size=(8, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return [
        pinhole_view(
            "a", (size, size), (1.1 * size, 1.1 * size, size / 2, size / 2), look_at(9 * d, np.zeros(3))
        )
        for d in directions
    ]


def range_to_sphere(view) -> np.ndarray:
    """(H, W) exact range; NaN outside."""
    directions, _ = rays(view)
    along = -directions @ view.center
    inside = 4 - (view.center @ view.center - along**2)
    return np.where(inside > 0, along - np.sqrt(np.maximum(inside, 0)), np.nan).reshape(
        view.height, view.width
    )


@pytest.mark.parametrize("noise", [0.0, 0.2])
def test_ranges_are_finer_than_voxels(noise):
    points, normals = sphere(20_000)
    voxel = SURFACE_VOXEL * spacing_of(points)
    points = points + noise * voxel * np.random.default_rng(1).normal(size=(len(points), 1)) * normals
    surface = VoxelSurface.from_cloud(points, normals, voxel)
    for view in ring()[:3]:
        first, exact = first_surface(surface, view), range_to_sphere(view)
        # between ray and normal, from the triangle of center, camera and hit
        cosine = np.abs(81 - 4 - exact**2) / (4 * exact)
        inner = np.isfinite(exact) & (cosine > 0.3)
        error = np.abs(first.range - exact)[inner] * cosine[inner] / voxel
        assert np.isfinite(first.range)[np.isfinite(exact)].mean() > 0.998
        assert np.median(error) < (0.15 if noise else 0.01) and np.quantile(error, 0.99) < (
            0.65 if noise else 0.05
        )


def test_pixel_to_surface_and_point_to_pixel_agree_on_a_sphere():
    """A pixel binds only points that face it: beyond the horizon, planes stand out a little,
    next to points that face away.
    """
    points, normals = sphere(20_000)
    spacing = spacing_of(points)
    surface, index, agree = (
        VoxelSurface.from_cloud(points, normals, SURFACE_VOXEL * spacing),
        NeighborIndex(points),
        [],
    )
    for view in ring(900)[:4]:
        # the sphere fills the picture
        near = pinhole_view("a", (900, 900), (1750, 1750, 450, 450), view.cam_from_world)
        first = first_surface(surface, near)
        forward, backward = np.zeros((2, len(points)), bool)
        forward[see_points(near, points, normals, first, 2 * spacing).points] = True
        rows = nearest_points(first, near, index, 4 * spacing)
        backward[np.unique(rows[rows >= 0])] = True
        assert (forward == backward).mean() > 0.98
        agree.append((forward == (backward & (dot(near.center - points, normals) > 0))).mean())
    assert min(agree) > 0.99


def grid(low: float, high: float, step: float, height: float) -> np.ndarray:
    x, y = np.meshgrid(np.arange(low, high, step), np.arange(low, high, step))
    return np.stack([x.ravel(), y.ravel(), np.full(x.size, height)], axis=1)


def overhead(height: float = 20.0, size: int = 400):
    return pinhole_view(
        "top",
        (size, size),
        (size, size, size / 2, size / 2),
        look_at(np.array([0.0, 0, height]), np.zeros(3)),
    )


def seen_by(view, points: np.ndarray, surface: VoxelSurface, tolerance: float = 0.1) -> np.ndarray:
    visible = np.zeros(len(points), bool)
    visible[
        see_points(
            view, points, np.tile(UP, (len(points), 1)), first_surface(surface, view), tolerance
        ).points
    ] = True
    return visible


@pytest.mark.parametrize("regular", [True, False])
def test_half_of_a_foreground_still_blocks_and_floaters_do_not(regular):
    rng = np.random.default_rng(0)
    ground, roof = grid(-6, 6, 0.1, 0.0), grid(-3, 3, 0.1, 5.0)
    if not regular:
        ground[:, :2], roof[:, :2] = rng.uniform(-6, 6, (len(ground), 2)), rng.uniform(-3, 3, (len(roof), 2))
    roof = roof[rng.permutation(len(roof))[: len(roof) // 2]]
    floaters = np.array([[3.3, 3.3, 8.0], [-3.3, 3.3, 8.0], [-3.25, 3.3, 8.03]])  # one alone, and a pair
    points = np.concatenate([ground, roof, floaters])
    surface = VoxelSurface.from_cloud(points, np.tile(UP, (len(points), 1)), SURFACE_VOXEL * 0.1)
    view = overhead()
    visible = seen_by(view, points, surface)
    behind = np.abs(ground[:, :2]).max(axis=1) < 3.8  # the roof covers up to 4
    assert visible[: len(ground)][behind].mean() < 0.002
    for floater in floaters:
        under = np.linalg.norm(ground[:, :2] - floater[:2] * 20 / 12, axis=1) < 0.4
        assert under.sum() > 20 and visible[: len(ground)][under].all()
    rows = nearest_points(first_surface(surface, view), view, NeighborIndex(points), 0.3)
    assert not (rows >= len(points) - len(floaters)).any()


def test_nothing_grows_beyond_the_edge_of_a_roof():
    ground, roof = grid(-6, 6, 0.1, 0.0), grid(-2, 2.05, 0.1, 5.0)
    points = np.concatenate([ground, roof])
    visible = seen_by(
        overhead(), points, VoxelSurface.from_cloud(points, np.tile(UP, (len(points), 1)), 0.25)
    )[: len(ground)]
    reach = np.abs(ground[:, :2]).max(axis=1)
    assert not visible[reach < 2 * 20 / 15 - 0.1].any()
    # at most 1.5 spacings, 20 cm with the pixel, too large
    assert visible[(reach > 2.2 * 20 / 15) & (reach < 5.8)].all()


def test_a_wall_thinner_than_a_voxel_shows_the_face_on_the_camera_s_side():
    faces = [np.roll(grid(-2, 2, 0.1, x), 1, axis=1) for x in (-0.05, 0.05)]
    points = np.concatenate(faces)
    normals = np.repeat(np.float32([[-1, 0, 0], [1, 0, 0]]), len(faces[0]), axis=0)
    surface = VoxelSurface.from_cloud(points, normals, 0.25)
    for side in (-1.0, 1.0):
        distance, incidence = surface.cast(
            camera_at(np.array([6 * side, 0.3, 0.2])), np.float32([[-side, 0, 0]])
        )
        assert abs(distance[0] - 5.95) < 1e-4 and incidence[0] == pytest.approx(1)


def test_no_label_passes_a_wall():
    rng = np.random.default_rng(0)
    ground = np.column_stack([rng.uniform(-6, 6, (15_000, 2)), np.zeros(15_000)])
    roof = np.column_stack([rng.uniform(-3, 3, (4000, 2)), np.full(4000, 4.0)])
    points, normals = np.concatenate([ground, roof]), np.tile(UP, (19_000, 1))
    views = [
        pinhole_view(f"{k}", (200, 200), (200, 200, 100, 100), look_at(np.array([x, 0.1, 20.0]), np.zeros(3)))
        for k, x in enumerate((-3.0, 0.0, 3.0))
    ]
    surface = VoxelSurface.from_cloud(points, normals, SURFACE_VOXEL * spacing_of(points))
    settings = Label(voxel_size=0.25, edge_width=0, verify="no", method="majority")
    labels = fuse(
        Cloud(points, normals),
        views,
        lambda view: (np.full((200, 200), 2, np.uint8), None),
        surface,
        5,
        settings,
    ).labels
    hidden = np.abs(ground[:, :2]).max(axis=1) < 2.7  # under the roof for all three
    assert (labels.state[: len(ground)][hidden] == UNSEEN).all()
    assert (labels.label[len(ground) :] == 2).mean() > 0.99


def test_the_surface_depends_on_neither_order_nor_threads_nor_units_nor_zero():
    points, normals = sphere(6000, 1)
    # rough, so that normals scatter in some voxels
    points[:2000] *= 1 + 0.05 * np.random.default_rng(2).normal(size=(2000, 1))
    normals[:1000] = normals[np.random.default_rng(3).permutation(1000)]
    view, voxel = ring()[0], 0.2
    first = first_surface(VoxelSurface.from_cloud(points, normals, voxel), view)
    order = np.random.default_rng(4).permutation(len(points))
    again = first_surface(VoxelSurface.from_cloud(points[order], normals[order], voxel), view)
    numba.set_num_threads(min(2, numba.config.NUMBA_NUM_THREADS))  # `conftest` sets it back
    threaded = first_surface(VoxelSurface.from_cloud(points, normals, voxel), view)
    for other in (again, threaded):
        np.testing.assert_array_equal(first.range, other.range)
        np.testing.assert_array_equal(first.incidence, other.incidence)
    offset = np.array([5e5, 5e6, 200.0])
    far = first_surface(VoxelSurface.from_cloud(points + offset, normals, voxel), view.shifted(-offset))
    larger = pinhole_view("a", (300, 300), (330, 330, 150, 150), look_at(100 * view.center, np.zeros(3)))
    scaled = first_surface(VoxelSurface.from_cloud(100 * points, normals, 100 * voxel), larger)
    for other in (far.range, scaled.range / 100):
        assert (np.isfinite(other) == np.isfinite(first.range)).mean() > 0.9999
        both = np.isfinite(other) & np.isfinite(first.range)
        assert (np.abs(other[both] - first.range[both]) < 1e-5).mean() > 0.9999


def test_patches_close_gaps_but_leave_what_is_open():
    plane = grid(0, 4, 0.1, 0.0)
    hole = np.abs(plane[:, :2] - 2).max(axis=1) < 0.2  # one and a half voxels wide: a gap
    window = np.abs(plane[:, :2] - 1).max(axis=1) < 0.55  # four voxels wide: an opening
    for missing, closed in ((hole, True), (window, False)):
        surface = VoxelSurface.from_cloud(plane[~missing], np.tile(UP, ((~missing).sum(), 1)), 0.25)
        middle = plane[missing].mean(axis=0)
        distance, _ = surface.cast(camera_at(middle + [0, 0, 3]), np.float32([[0, 0, -1]]))
        assert np.isfinite(distance[0]) == closed


def test_estimated_normals_do_for_a_cloud_without():
    points, _ = sphere(6000)
    view = ring()[0]
    first, exact = first_surface(VoxelSurface.from_cloud(points, None, 0.2), view), range_to_sphere(view)
    inner = np.isfinite(exact) & (first.incidence > 0.3)
    assert inner.mean() > 0.15 and np.quantile(np.abs(first.range - exact)[inner], 0.99) < 0.05


def test_the_mesh_is_the_surface_unless_another_is_wanted(tmp_path):
    points = grid(-2, 2, 0.1, 1.0)
    normals, mesh = np.tile(UP, (len(points), 1)), tmp_path / "mesh.ply"
    assert isinstance(read_surface([mesh], points, normals, np.zeros(3)), VoxelSurface)
    box = o3d.t.geometry.TriangleMesh.create_box(4, 4, 4)
    o3d.t.io.write_triangle_mesh(str(mesh), box)
    assert isinstance(read_surface([mesh], points, normals, np.zeros(3)), Surface)
    assert isinstance(read_surface([mesh], points, normals, np.zeros(3), "voxels"), VoxelSurface)
    for kind, height in (("auto", 4), ("surfels", 1), ("voxels", 1)):
        distance, _ = read_surface([mesh], points, normals, np.zeros(3), kind).cast(
            camera_at(np.array([1.03, 1.04, 9])), np.float32([[0, 0, -1]])
        )
        assert 9 - distance[0] == pytest.approx(height, abs=1e-4)
