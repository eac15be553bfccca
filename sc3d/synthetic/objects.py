"""Buildings and cars as triangles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sc3d.synthetic.mesh import (
    BRICK,
    BUILDING,
    FLAT_ROOF,
    GLASS,
    NO_CLASS,
    PAINT,
    PLAIN,
    TILES,
    WALL,
    MeshBuilder,
    linear,
    placed,
    upright_pose,
)

GABLE, HIP, FLAT = range(3)
# fmt: off
WALL_TINTS = [(214, 200, 176), (196, 180, 160), (160, 96, 76), (222, 216, 206), (172, 140, 112),
              (150, 108, 90), (190, 196, 190)]
ROOF_TINTS = [(158, 88, 64), (120, 70, 56), (92, 90, 94), (128, 104, 84), (74, 72, 76), (172, 112, 78),
              (104, 98, 90)]
FLAT_TINTS = [(168, 164, 156), (120, 120, 122), (190, 186, 178), (146, 138, 126)]
CAR_TINTS = [(190, 30, 30), (230, 230, 232), (40, 70, 150), (30, 32, 36), (150, 152, 156), (210, 170, 40),
             (70, 110, 90)]
# fmt: on
BASEMENT = 0.8  # walls go this far below the ground, so that no slope leaves a gap, m


@dataclass(frozen=True)
class Building:
    """A building's main box: center and base height (world, m), yaw (rad), half sizes and wall height (m),
    roof GABLE, HIP or FLAT.

    wing: (x, y, half length, half width) of a second, lower box in the building's frame, or None
    """

    center: tuple[float, float]
    base: float
    yaw: float
    half: tuple[float, float]
    wall: float
    roof: int
    wing: tuple[float, float, float, float] | None = None

    @property
    def pose(self) -> np.ndarray:
        """(4, 4) world_from_building, origin on the ground."""
        return upright_pose(np.array([*self.center, self.base]), self.yaw)

    def boxes(self) -> list[tuple[float, float, float, float]]:
        """x, y, half length and half width of each box in the building's frame, m."""
        return [(0.0, 0.0, *self.half)] + ([self.wing] if self.wing else [])


def add_building(builder: MeshBuilder, building: Building, rng: np.random.Generator) -> None:
    """Walls, roofs with eaves, chimneys and roof machines of one building."""
    object_id = builder.new_object()
    wall_tint = linear(WALL_TINTS[rng.integers(len(WALL_TINTS))]) * rng.uniform(0.85, 1.1)
    palette = FLAT_TINTS if building.roof == FLAT else ROOF_TINTS
    roof_tint = linear(palette[rng.integers(len(palette))]) * rng.uniform(0.85, 1.15)
    for number, (x, y, half_length, half_width) in enumerate(building.boxes()):
        pose = building.pose @ upright_pose(np.array([x, y, 0.0]), 0.0)
        wall = building.wall - 0.55 * number  # lower, so that no two roof faces coincide
        if half_width > half_length:  # the ridge runs along the longer side
            pose = pose @ upright_pose(np.zeros(3), np.pi / 2)
            half_length, half_width = half_width, half_length
        _add_walls(builder, pose, (half_length, half_width, wall), (WALL, BUILDING, object_id), wall_tint)
        if building.roof == FLAT:
            _add_flat_roof(
                builder, pose, (half_length, half_width, wall), object_id, (roof_tint, wall_tint), rng
            )
        else:
            inset = 0.0 if building.roof == GABLE else half_width + 0.5
            _add_pitched_roof(
                builder, pose, (half_length, half_width, wall, inset), object_id, (roof_tint, wall_tint)
            )
            if number == 0 or rng.random() < 0.3:
                _add_chimney(builder, pose, (half_length, half_width, wall, inset), object_id, rng)


def _add_walls(
    builder: MeshBuilder,
    pose: np.ndarray,
    size: tuple[float, float, float],
    kind: tuple[int, int, int],
    tint: np.ndarray,
) -> None:
    """Four walls whose texture starts at the ground, plus a plain strip below it."""
    half_length, half_width, wall = size
    low, high = (-half_length, -half_width), (half_length, half_width)
    builder.box(pose, (*low, -BASEMENT), (*high, 0), (PLAIN, *kind[1:]), 0.6 * tint, top=False)
    builder.box(pose, (*low, 0), (*high, wall), kind, tint, top=False)


def _add_pitched_roof(
    builder: MeshBuilder,
    pose: np.ndarray,
    size: tuple[float, float, float, float],
    object_id: int,
    tints: tuple[np.ndarray, np.ndarray],
) -> None:
    """A gable (inset 0) or hip roof with 0.5 m eaves on a gutter board."""
    half_length, half_width, wall, inset = size
    a, b, low = half_length + 0.5, half_width + 0.5, wall + 0.12
    top = low + 0.62 * b
    ridge = max(a - inset, 0.05)
    plain, tiles, eave = (PLAIN, BUILDING, object_id), (TILES, BUILDING, object_id), wall - 0.12
    end = (tiles, tints[0]) if inset else (plain, tints[1])
    # fmt: off
    builder.box(pose, (-a, -b, eave), (a, b, low), plain, linear((215, 212, 205)))
    for corners, kind, tint in (
        ([[-a, -b, eave], [-a, b, eave], [a, b, eave], [a, -b, eave]], plain, linear((190, 185, 175))),
        ([[-a, -b, low], [a, -b, low], [ridge, 0, top], [-ridge, 0, top]], tiles, tints[0]),
        ([[a, b, low], [-a, b, low], [-ridge, 0, top], [ridge, 0, top]], tiles, tints[0]),
        ([[a, -b, low], [a, b, low], [ridge, 0, top]], *end),
        ([[-a, b, low], [-a, -b, low], [-ridge, 0, top]], *end),
    ):
        builder.polygon(placed(pose, corners), kind, tint)
    builder.box(pose, (-ridge, -0.14, top - 0.08), (ridge, 0.14, top + 0.05), plain, 0.7 * tints[0])
    # fmt: on


def _add_chimney(
    builder: MeshBuilder,
    pose: np.ndarray,
    size: tuple[float, float, float, float],
    object_id: int,
    rng: np.random.Generator,
) -> None:
    half_length, half_width, wall, inset = size
    x = rng.uniform(-0.7, 0.7) * max(half_length - inset, 0.3)
    y = rng.uniform(0.2, 0.45) * half_width * rng.choice([-1, 1])
    top = wall + 0.62 * (half_width + 0.5) + 0.9
    brick, plain = (BRICK, BUILDING, object_id), (PLAIN, BUILDING, object_id)
    # fmt: off
    builder.box(pose, (x - 0.4, y - 0.3, wall), (x + 0.4, y + 0.3, top), brick, linear((140, 84, 66)))
    builder.box(pose, (x - 0.2, y - 0.15, top), (x + 0.2, y + 0.15, top + 0.25), plain, linear((90, 60, 48)))
    # fmt: on


def _add_flat_roof(
    builder: MeshBuilder,
    pose: np.ndarray,
    size: tuple[float, float, float],
    object_id: int,
    tints: tuple[np.ndarray, np.ndarray],
    rng: np.random.Generator,
) -> None:
    """A roof 0.4 m below its parapet, with machines on it."""
    (a, b, wall), rim = size, 0.3
    plain, floor = (PLAIN, BUILDING, object_id), wall - 0.4
    outer = np.array([[-a, -b], [a, -b], [a, b], [-a, b]])
    inner = outer - rim * np.sign(outer)
    for i in range(4):
        j = (i + 1) % 4
        edge = [[*outer[i], wall], [*outer[j], wall], [*inner[j], wall], [*inner[i], wall]]
        inside = [[*inner[j], floor], [*inner[i], floor], [*inner[i], wall], [*inner[j], wall]]
        builder.polygon(placed(pose, edge), plain, 0.9 * tints[1])
        builder.polygon(placed(pose, inside), plain, 0.8 * tints[1])
    builder.polygon(placed(pose, np.c_[inner, np.full(4, floor)]), (FLAT_ROOF, BUILDING, object_id), tints[0])
    for _ in range(int(rng.integers(2, 5))):
        x, y = rng.uniform(-0.7, 0.7) * a, rng.uniform(-0.6, 0.6) * b
        w, d, h = rng.uniform(0.5, 1.2), rng.uniform(0.4, 0.9), rng.uniform(0.6, 1.5)
        low, high, lid = (x - w, y - d, floor), (x + w, y + d, floor + h), 0.06
        builder.box(pose, low, high, plain, linear((186, 188, 190)) * rng.uniform(0.6, 1.1))
        low, high = (x - 0.5 * w, y - 0.5 * d, floor + h), (x + 0.5 * w, y + 0.5 * d, floor + h + lid)
        builder.box(pose, low, high, plain, linear((60, 62, 66)))


def add_car(builder: MeshBuilder, position: np.ndarray, yaw: float, rng: np.random.Generator) -> None:
    """A car at `position` (3,) on the ground: wheels, body, tapered cabin with a painted roof."""
    object_id = builder.new_object()
    pose = upright_pose(position, yaw)
    paint, glass = (PAINT, NO_CLASS, object_id), (GLASS, NO_CLASS, object_id)
    tint = linear(CAR_TINTS[rng.integers(len(CAR_TINTS))])
    length, width = rng.uniform(2.0, 2.35), rng.uniform(0.85, 0.95)
    for x in (-0.62 * length, 0.62 * length):
        axle = (x - 0.33, -width - 0.02, -0.15), (x + 0.33, width + 0.02, 0.62)
        builder.box(pose, *axle, paint, np.full(3, 0.008))
    builder.box(pose, (-length, -width, 0.22), (length, width, 0.82), paint, tint)
    low = np.array([[-0.72, -0.92], [0.42, -0.92], [0.42, 0.92], [-0.72, 0.92]]) * [length, width]
    high = np.array([[-0.55, -0.8], [0.18, -0.8], [0.18, 0.8], [-0.55, 0.8]]) * [length, width]
    for i in range(4):
        j = (i + 1) % 4
        window = [[*low[i], 0.82], [*low[j], 0.82], [*high[j], 1.42], [*high[i], 1.42]]
        builder.polygon(placed(pose, window), glass, np.array([0.02, 0.025, 0.03]))
    builder.polygon(placed(pose, np.c_[high, np.full(4, 1.42)]), paint, tint)


def add_fence(builder: MeshBuilder, ends: np.ndarray, tint: np.ndarray) -> None:
    """A low garden wall between consecutive points of `ends` (N, 3) on the ground."""
    object_id = builder.new_object()
    for start, end in zip(ends[:-1], ends[1:]):
        yaw = np.arctan2(end[1] - start[1], end[0] - start[0])
        pose = upright_pose(np.minimum(start, [np.inf, np.inf, end[2]]), yaw)
        length = np.linalg.norm((end - start)[:2])
        builder.box(pose, (0, -0.1, -0.5), (length + 0.1, 0.1, 0.9), (PLAIN, NO_CLASS, object_id), tint)
