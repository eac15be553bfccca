"""Town houses that are seen from the street: walls with recessed windows and doors, frames, sills, cornices,
shutters, balconies.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sc3d.synthetic.mesh import (
    ASHLAR,
    BRICK,
    BUILDING,
    MASONRY,
    PANE,
    PLAIN,
    PLASTER,
    TILES,
    WOOD,
    MeshBuilder,
    linear,
    placed,
    upright_pose,
)
from sc3d.synthetic.objects import BASEMENT, ROOF_TINTS, Building

# fmt: off
PLASTER_TINTS = [(226, 208, 168), (214, 178, 140), (200, 206, 196), (232, 226, 214), (196, 150, 122), (176, 190, 202)]
BRICK_TINTS = [(150, 78, 58), (168, 100, 72), (132, 72, 60)]
STONE_TINTS = [(196, 186, 164), (180, 174, 162)]
TRIM_TINTS = [(228, 224, 214), (196, 188, 172), (150, 140, 128)]
WOOD_TINTS = [(52, 84, 70), (110, 44, 38), (50, 66, 100), (120, 92, 62), (86, 90, 92)]
# fmt: on
STORY = 3.0  # m
RECESS, DOOR_RECESS = 0.2, 0.32  # m behind the wall


@dataclass(frozen=True)
class Opening:
    """A hole in a wall: along it and above the ground, m."""

    left: float
    right: float
    low: float
    high: float
    door: bool = False

    @property
    def depth(self) -> float:
        """Of the pane or the door leaf behind the wall, m."""
        return DOOR_RECESS if self.door else RECESS


@dataclass(frozen=True)
class Style:
    """wall: material; tint of the wall, trim, wood and roof: linear RGB, (3,); shutters, balconies: the house has
    some.
    """

    wall: int
    tint: np.ndarray
    trim: np.ndarray
    wood: np.ndarray
    roof: np.ndarray
    shutters: bool
    balconies: bool


def choose_style(rng: np.random.Generator) -> Style:
    """Plaster, brick or stone, and what goes with it."""

    def pick(tints: list[tuple[int, int, int]]) -> np.ndarray:
        return linear(tints[rng.integers(len(tints))]) * rng.uniform(0.88, 1.08)

    wall = int(rng.choice([PLASTER, MASONRY, ASHLAR], p=[0.5, 0.3, 0.2]))
    tint = pick({PLASTER: PLASTER_TINTS, MASONRY: BRICK_TINTS, ASHLAR: STONE_TINTS}[wall])
    return Style(
        wall,
        tint,
        pick(TRIM_TINTS),
        pick(WOOD_TINTS),
        pick(ROOF_TINTS),
        bool(rng.random() < 0.5),
        bool(rng.random() < 0.5),
    )


def add_town_house(builder: MeshBuilder, building: Building, rng: np.random.Generator) -> None:
    """A house whose front, local -y, faces the street; its roof drains to the street and to the back."""
    object_id, style = builder.new_object(), choose_style(rng)
    half_length, half_width = building.half
    wall = (style.wall, BUILDING, object_id)
    front = building.pose @ _turned(-half_length, -half_width, 0.0)
    openings = _front_openings(2 * half_length, building.wall, rng)
    _add_wall(builder, front, (2 * half_length, building.wall), openings, wall, style.tint)
    for opening in openings:
        _add_opening(builder, front, opening, style, object_id, rng)
    _add_trim(builder, front, (2 * half_length, building.wall), openings, style, object_id)
    if style.balconies:
        _add_balconies(builder, front, openings, object_id, rng)
    for x, y, turn, length in (
        (half_length, half_width, np.pi, half_length),
        (-half_length, half_width, -np.pi / 2, half_width),
        (half_length, -half_width, np.pi / 2, half_width),
    ):
        pose = building.pose @ _turned(x, y, turn)
        _add_wall(builder, pose, (2 * length, building.wall), [], (PLASTER, *wall[1:]), 0.9 * style.tint)
    _add_roof(builder, building, style, object_id, rng)


def add_block(
    builder: MeshBuilder,
    pose: np.ndarray,
    low: tuple[float, float, float],
    high: tuple[float, float, float],
    kind: tuple[int, int, int],
    tint: np.ndarray,
) -> None:
    """A box with all six faces, which is seen from below too."""
    builder.box(pose, low, high, kind, tint)
    (x0, y0, z0), (x1, y1, _) = low, high
    bottom = [[x0, y0, z0], [x0, y1, z0], [x1, y1, z0], [x1, y0, z0]]
    builder.polygon(placed(pose, bottom), kind, tint)


def _turned(x: float, y: float, yaw: float) -> np.ndarray:
    """A wall's frame: x along it as seen from outside, y inwards, z up."""
    return upright_pose(np.array([x, y, 0.0]), yaw)


def _front_openings(width: float, height: float, rng: np.random.Generator) -> list[Opening]:
    """Windows in rows and columns, one door among those on the ground."""
    columns = max(2, int(width / rng.uniform(1.75, 2.3)))
    pitch, half = width / columns, rng.uniform(0.46, 0.58)
    door, shop = int(rng.integers(columns)), rng.random() < 0.25
    openings = []
    for story in range(int((height - 0.4) / STORY)):
        base, tall = STORY * story, (1.75, 1.6, 1.35)[min(story, 2)]
        for column in range(columns):
            middle = pitch * (column + 0.5)
            if story == 0 and column == door:
                openings.append(Opening(middle - 0.55, middle + 0.55, 0.2, 2.5, door=True))
                continue
            wide = 0.42 * pitch if story == 0 and shop else half
            low = base + (0.65 if story == 0 and shop else 0.95)
            openings.append(Opening(middle - wide, middle + wide, low, base + 0.95 + tall))
    return openings


def _add_wall(
    builder: MeshBuilder,
    pose: np.ndarray,
    size: tuple[float, float],
    openings: list[Opening],
    kind: tuple[int, int, int],
    tint: np.ndarray,
) -> None:
    """A wall of size (width, height) in its frame `pose`, with holes and their reveals; it goes down below
    the ground.
    """
    width, height = size
    xs = np.unique([0.0, width, *(x for hole in openings for x in (hole.left, hole.right))])
    zs = np.unique([-BASEMENT, height, *(z for hole in openings for z in (hole.low, hole.high))])
    quads = []
    for x0, x1 in zip(xs[:-1], xs[1:]):
        for z0, z1 in zip(zs[:-1], zs[1:]):
            x, z = (x0 + x1) / 2, (z0 + z1) / 2
            if not any(hole.left < x < hole.right and hole.low < z < hole.high for hole in openings):
                quads.append([[x0, 0, z0], [x1, 0, z0], [x1, 0, z1], [x0, 0, z1]])
    local = np.array(quads)
    corners = placed(pose, local.reshape(-1, 3)).reshape(-1, 4, 3)
    triangles = np.concatenate([corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]])
    frame = np.stack([pose[:3, 3], pose[:3, 0], pose[:3, 2]])
    builder.add(triangles, kind, tint, frame, size)
    for hole in openings:
        (a, b), (low, high), d = (hole.left, hole.right), (hole.low, hole.high), hole.depth
        for reveal in (
            [[a, 0, low], [a, d, low], [a, d, high], [a, 0, high]],
            [[b, d, low], [b, 0, low], [b, 0, high], [b, d, high]],
            [[a, 0, low], [b, 0, low], [b, d, low], [a, d, low]],
            [[a, d, high], [b, d, high], [b, 0, high], [a, 0, high]],
        ):
            builder.polygon(placed(pose, reveal), (PLASTER, *kind[1:]), 1.05 * tint)


def _add_opening(
    builder: MeshBuilder,
    pose: np.ndarray,
    hole: Opening,
    style: Style,
    object_id: int,
    rng: np.random.Generator,
) -> None:
    """What fills a hole and surrounds it."""
    (a, b), (low, high), d = (hole.left, hole.right), (hole.low, hole.high), hole.depth
    wood, trim = (WOOD, BUILDING, object_id), (PLAIN, BUILDING, object_id)

    def block(x0: float, x1: float, y: tuple[float, float], z0: float, z1: float, kind, tint) -> None:
        add_block(builder, pose, (x0, y[0], z0), (x1, y[1], z1), kind, tint)

    back = placed(pose, [[a, d, low], [b, d, low], [b, d, high], [a, d, high]])
    builder.polygon(back, wood if hole.door else (PANE, BUILDING, object_id), style.wood)
    frame = style.wood if hole.door else linear((226, 226, 220))
    bar = 0.07
    for x in (a, b - bar) if hole.door else (a, (a + b - bar) / 2, b - bar):
        block(x, x + bar, (d - 0.06, d), low, high, trim, frame)
    for z in (high - 0.62, high - bar) if hole.door else (low, low + 0.62 * (high - low), high - bar):
        block(a, b, (d - 0.05, d), z, z + bar, trim, frame)
    if hole.door:
        for x in (a + 0.14, (a + b) / 2 + 0.04):  # panels, and the steps
            block(x, x + 0.34, (d - 0.03, d), low + 0.2, low + 0.9, wood, 1.3 * style.wood)
            block(x, x + 0.34, (d - 0.03, d), low + 1.05, high - 0.7, wood, 1.3 * style.wood)
        block(a - 0.2, b + 0.2, (-0.75, d), -0.4, low, trim, style.trim)
        block(a - 0.2, b + 0.2, (-1.05, -0.75), -0.4, low - 0.1, trim, style.trim)
    else:
        block(a - 0.1, b + 0.1, (-0.12, 0.02), low - 0.1, low, trim, style.trim)
    block(a - 0.14, a, (-0.04, 0.02), low, high, trim, style.trim)
    block(b, b + 0.14, (-0.04, 0.02), low, high, trim, style.trim)
    block(a - 0.14, b + 0.14, (-0.06, 0.02), high, high + 0.22, trim, style.trim)
    if style.shutters and not hole.door and b - a < 1.3:
        for x in (a - 0.14 - (b - a) / 2, b + 0.14):
            block(x, x + (b - a) / 2, (-0.06, -0.01), low, high, wood, style.wood * rng.uniform(0.9, 1.1))


def _add_trim(
    builder: MeshBuilder,
    pose: np.ndarray,
    size: tuple[float, float],
    openings: list[Opening],
    style: Style,
    object_id: int,
) -> None:
    """Plinth, string courses, cornice and a downpipe."""
    width, height = size
    trim = (PLAIN, BUILDING, object_id)
    door = next(hole for hole in openings if hole.door)
    for left, right in ((0.0, door.left - 0.14), (door.right + 0.14, width)):
        add_block(
            builder,
            pose,
            (left, -0.06, -BASEMENT),
            (right, 0.02, 0.45),
            (ASHLAR, BUILDING, object_id),
            0.8 * style.trim,
        )
    for story in range(1, int((height - 0.4) / STORY)):
        add_block(
            builder,
            pose,
            (0, -0.08, STORY * story - 0.05),
            (width, 0.02, STORY * story + 0.14),
            trim,
            style.trim,
        )
    add_block(builder, pose, (0, -0.2, height - 0.35), (width, 0.02, height - 0.18), trim, style.trim)
    add_block(builder, pose, (0, -0.34, height - 0.18), (width, 0.02, height), trim, 0.92 * style.trim)
    pipe = linear((120, 122, 120))
    add_block(builder, pose, (width - 0.16, -0.18, -0.3), (width - 0.05, -0.08, height - 0.35), trim, pipe)


def _add_balconies(
    builder: MeshBuilder, pose: np.ndarray, openings: list[Opening], object_id: int, rng: np.random.Generator
) -> None:
    """Slabs with railings before some upper windows."""
    trim, iron = (PLAIN, BUILDING, object_id), linear((46, 48, 50))
    upper = [hole for hole in openings if STORY < hole.low < 2 * STORY]
    for number in rng.choice(len(upper), max(1, len(upper) // 3), replace=False):
        left, right, floor = upper[number].left - 0.35, upper[number].right + 0.35, upper[number].low - 0.35
        add_block(
            builder, pose, (left, -0.95, floor - 0.15), (right, 0.0, floor), trim, linear((170, 166, 158))
        )
        for x in np.linspace(left, right - 0.035, 14):
            add_block(builder, pose, (x, -0.93, floor), (x + 0.035, -0.895, floor + 0.95), trim, iron)
        add_block(builder, pose, (left, -0.94, floor + 0.95), (right, -0.88, floor + 1.0), trim, iron)
        for x in (left, right - 0.05):
            add_block(builder, pose, (x, -0.94, floor + 0.95), (x + 0.05, 0.0, floor + 1.0), trim, iron)


def _add_roof(
    builder: MeshBuilder, building: Building, style: Style, object_id: int, rng: np.random.Generator
) -> None:
    """Two slopes of tiles, gables, a chimney and a dormer."""
    (a, half_width), low, pose = building.half, building.wall, building.pose
    b = half_width + 0.38
    slope = rng.uniform(0.65, 0.85)
    top = low + slope * b
    tiles, plaster = (TILES, BUILDING, object_id), (PLASTER, BUILDING, object_id)
    for corners, kind, tint in (
        ([[-a, -b, low], [a, -b, low], [a, 0, top], [-a, 0, top]], tiles, style.roof),
        ([[a, b, low], [-a, b, low], [-a, 0, top], [a, 0, top]], tiles, style.roof),
        ([[a, -b, low], [a, b, low], [a, 0, top]], plaster, 0.9 * style.tint),
        ([[-a, b, low], [-a, -b, low], [-a, 0, top]], plaster, 0.9 * style.tint),
    ):
        builder.polygon(placed(pose, corners), kind, tint)
    x = rng.uniform(-0.7, 0.7) * a
    brick = (BRICK, BUILDING, object_id)
    builder.box(pose, (x - 0.4, 0.4, low + 1), (x + 0.4, 1.0, top + 0.9), brick, linear((140, 84, 66)))
    front = -0.72 * b
    foot = low + slope * (b + front) - 0.2
    for x in np.linspace(-0.5, 0.5, 2) * a:
        add_block(builder, pose, (x - 0.6, front, foot), (x + 0.6, -0.1, foot + 1.35), plaster, style.tint)
        window = [[x - 0.4, front - 0.02, foot + 0.35], [x + 0.4, front - 0.02, foot + 0.35]]
        window += [[x + 0.4, front - 0.02, foot + 1.2], [x - 0.4, front - 0.02, foot + 1.2]]
        builder.polygon(placed(pose, window), (PANE, BUILDING, object_id), style.wood)
        eaves = (x - 0.75, front - 0.15, foot + 1.35), (x + 0.75, 0.0, foot + 1.47)
        add_block(builder, pose, *eaves, (PLAIN, BUILDING, object_id), 0.7 * style.roof)
