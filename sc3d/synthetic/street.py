"""A street between two rows of town houses: lawns before them, hedges, trees, lamps, parked cars."""

from __future__ import annotations

import numpy as np

from sc3d.geometry.cameras import View
from sc3d.settings.synthesize import Synthesize
from sc3d.synthetic.facades import add_block, add_town_house
from sc3d.synthetic.ground import DRIVEWAY, HALF_PAVED, HALF_ROAD, Ground, add_ground, plan_street
from sc3d.synthetic.mesh import GLASS, NO_CLASS, PAINT, PLAIN, ROAD, MeshBuilder, linear, placed, upright_pose
from sc3d.synthetic.objects import CAR_TINTS, GABLE, Building, add_fence
from sc3d.synthetic.plants import add_bough, add_bush, add_tree
from sc3d.synthetic.walk import walk
from sc3d.synthetic.world import World, finish_world

FRONT = 8.0  # m from the middle of the street to the facades
BEYOND = 18.0  # houses stand up to this far outside of the site, m
NEAR_LEAF = 0.1  # m
# side: z up, x forwards, in halves of the length, of a car's body
PROFILE = [(-1.0, 0.35), (-0.97, 0.78), (-0.9, 0.92), (0.42, 0.9), (0.9, 0.74), (1.0, 0.55), (0.98, 0.3)]


def build_street(settings: Synthesize) -> tuple[World, list[View]]:
    """The street of `settings.seed` along the x axis, and the views that are taken of it: some of them look
    past a bough that hangs before the camera.
    """
    streams = np.random.default_rng([settings.seed, 1]).spawn(6)
    ground = plan_street(settings.side, streams[0])
    buildings = _place_houses(ground, streams[1])
    views = walk(settings, ground)
    builder = MeshBuilder()
    add_ground(builder, ground)
    for building in buildings:
        add_town_house(builder, building, streams[2])
    _add_curbs(builder, ground)
    _plant(builder, ground, buildings, views, streams[3])
    _park_cars(builder, ground, views, streams[4])
    _add_lamps(builder, ground, streams[5])
    return finish_world(settings.seed, ground, buildings, builder, street=True), views


def _place_houses(ground: Ground, rng: np.random.Generator) -> list[Building]:
    """Two rows with a few gaps; levels their plots and paves the ways to their doors in `ground`."""
    buildings, end = [], ground.extent / 2 + BEYOND
    for side in (1.0, -1.0):
        x = -end
        while x < end:
            half, depth = rng.uniform(2.9, 4.6), rng.uniform(4.0, 4.8)
            setback = FRONT + rng.choice([0.0, 0.0, 0.35, 0.7])
            wall = 3.0 * rng.choice([2, 2, 3]) + rng.uniform(0.45, 0.95)
            middle, y = x + half, side * (setback + depth)
            base = float(ground.height(np.array([[middle, side * FRONT]]))[0]) + 0.05
            yaw = 0.0 if side > 0 else np.pi
            building = Building((middle, y), base, yaw, (half, depth), float(wall), GABLE)
            buildings.append(building)
            ground.pads.append((middle, y, yaw, half, depth, base - 0.05))
            way = [
                middle,
                side * (HALF_PAVED + setback) / 2,
                0.0,
                1.0,
                (setback - HALF_PAVED) / 2,
                0.7,
                DRIVEWAY,
            ]
            if rng.random() < 0.6:
                ground.rects = np.vstack([ground.rects, way])
            x += 2 * half + (rng.uniform(2.5, 4.5) if rng.random() < 0.2 else 0.0)
    return buildings


def _add_curbs(builder: MeshBuilder, ground: Ground) -> None:
    """Curb stones, a meter each, between carriageway and pavements."""
    object_id = builder.new_object()
    end = 0.55 * ground.extent + BEYOND
    for side in (-1.0, 1.0):
        low, high = sorted((side * (HALF_ROAD - 0.05), side * (HALF_ROAD + 0.75)))
        for x in np.arange(-end, end, 1.0):
            level = float(ground.height(np.array([[x + 0.5, side * (HALF_ROAD + 0.75)]]))[0])
            pose = upright_pose(np.array([x, 0.0, level]), 0.0)
            tint = linear((168, 164, 156)) * (0.85 + 0.3 * ((x * 0.618) % 1.0))
            builder.box(pose, (0.006, low, -0.4), (0.994, high, 0.025), (PLAIN, ROAD, object_id), tint)


def _plant(
    builder: MeshBuilder,
    ground: Ground,
    buildings: list[Building],
    views: list[View],
    rng: np.random.Generator,
) -> None:
    """Trees on the grass strips, bushes and low walls before the houses, tall trees behind and at the ends,
    boughs before some cameras.
    """
    reach = ground.extent / 2 + BEYOND
    for side in (-1.0, 1.0):
        for x in np.arange(-reach, reach, 9.5):
            spot = _on_ground(ground, x + rng.uniform(-2.5, 2.5), side * rng.uniform(5.5, 6.1))
            add_tree(builder, spot, rng.uniform(1.3, 2.0), rng, NEAR_LEAF, stem=rng.uniform(2.2, 2.9))
        for x in np.arange(-reach, reach, 1.9):
            if rng.random() < 0.5:
                size = rng.uniform(0.3, 0.55)
                spot = _on_ground(
                    ground, x + rng.uniform(-0.6, 0.6), side * (FRONT - size - rng.uniform(0.0, 0.4))
                )
                if not _on_way(ground, spot, size):
                    add_bush(builder, spot, (size, size, 0.8 * size), 0.0, rng, NEAR_LEAF)
        for x in np.arange(-2 * reach, 2 * reach, 9.0):
            spot = _on_ground(ground, x + rng.uniform(-3, 3), side * rng.uniform(21.0, 30.0))
            add_tree(builder, spot, rng.uniform(3.0, 4.5), rng)
        for x in np.linspace(reach + 4, reach + 40, 8):
            for end in (-1.0, 1.0):
                spot = _on_ground(ground, end * x + rng.uniform(-3, 3), side * rng.uniform(7.0, 16.0))
                add_tree(builder, spot, rng.uniform(2.5, 4.0), rng)
    for building in buildings[2::4]:
        ends = placed(
            building.pose,
            np.column_stack(
                [
                    np.linspace(-0.95, 0.95, 4) * building.half[0],
                    np.full(4, -building.half[1] - 2.9),
                    np.zeros(4),
                ]
            ),
        )
        ends[:, 2] = ground.height(ends[:, :2])
        if not any(_on_way(ground, spot, 1.4) for spot in ends):
            add_fence(builder, ends, linear((168, 160, 146)) * rng.uniform(0.7, 1.1))
    for number in range(1, len(views) - len(views) // 4, 4):
        _hang_bough(builder, ground, views[number], rng)


def _hang_bough(builder: MeshBuilder, ground: Ground, view: View, rng: np.random.Generator) -> None:
    """A bough that reaches from a tree beside the photographer into an upper corner of the photo."""
    right, down, forward = view.cam_from_world[:3, :3]
    side = rng.choice([-1.0, 1.0])
    ahead = forward * [1, 1, 0] / np.linalg.norm(forward[:2])
    trunk = _on_ground(ground, *(view.center - 1.5 * ahead + 1.3 * side * right)[:2])
    tip = view.center + rng.uniform(1.2, 1.7) * forward + 0.5 * side * right - 0.4 * down
    add_tree(builder, trunk, 1.3, rng, NEAR_LEAF, stem=3.0)
    add_bough(builder, trunk + [0.0, 0.0, 2.5], tip, rng)


def _park_cars(builder: MeshBuilder, ground: Ground, views: list[View], rng: np.random.Generator) -> None:
    """Cars along both curbs, but not right before a photographer who looks down at the road."""
    down = np.array([view.center[0] for view in views if view.cam_from_world[2, 2] < -0.1])
    reach = ground.extent / 2 + BEYOND
    for side in (-1.0, 1.0):
        for x in np.arange(-reach, reach, 6.5):
            if rng.random() < (0.2 if side < 0 else 0.5):  # the near ones hide the houses
                spot = _on_ground(ground, x + rng.uniform(-0.8, 0.8), side * rng.uniform(1.95, 2.05))
                if side < 0 and (np.abs(down - spot[0]) < 2.6).any():
                    continue
                _add_car(builder, spot, 0.0 if side < 0 else np.pi, rng)


def _add_car(builder: MeshBuilder, position: np.ndarray, yaw: float, rng: np.random.Generator) -> None:
    """A car with a rounded profile, wheels, windows and lights, at `position` (3,) on the ground."""
    object_id = builder.new_object()
    pose = upright_pose(position, yaw)
    paint, glass = (PAINT, NO_CLASS, object_id), (GLASS, NO_CLASS, object_id)
    tint = linear(CAR_TINTS[rng.integers(len(CAR_TINTS))])
    length, width, roof = rng.uniform(1.95, 2.25), rng.uniform(0.84, 0.9), rng.uniform(1.42, 1.56)
    outline = np.array(PROFILE) * [length, 1.0]
    _extrude(builder, pose, outline, width, paint, tint)
    low = np.array([[-0.9, -0.97], [0.46, -0.97], [0.46, 0.97], [-0.9, 0.97]]) * [length, width]
    high = np.array([[-0.72, -0.8], [0.14, -0.8], [0.14, 0.8], [-0.72, 0.8]]) * [length, width]
    for i in range(4):
        j = (i + 1) % 4
        a, b = np.array([*low[i], 0.9]), np.array([*low[j], 0.9])
        d, c = np.array([*high[i], roof]), np.array([*high[j], roof])
        builder.polygon(placed(pose, np.stack([a, b, c, d])), paint, tint)
        out = np.cross(b - a, d - a)
        out = 0.012 * out / np.linalg.norm(out)
        panes = ((0.07, 0.93),) if i % 2 else ((0.06, 0.36), (0.4, 0.68), (0.72, 0.94))
        for start, stop in panes:
            corners = [a + start * (b - a), a + stop * (b - a), d + stop * (c - d), d + start * (c - d)]
            inner = [corners[0] * 0.92 + corners[3] * 0.08, corners[1] * 0.92 + corners[2] * 0.08]
            inner += [corners[2] * 0.9 + corners[1] * 0.1, corners[3] * 0.9 + corners[0] * 0.1]
            builder.polygon(placed(pose, np.stack(inner) + out), glass, np.array([0.03, 0.036, 0.045]))
    builder.polygon(placed(pose, np.c_[high, np.full(4, roof)]), paint, tint)
    _add_wheels(builder, pose, (length, width), object_id)
    for y in (-0.72 * width, 0.72 * width):
        for x, color in ((0.985 * length, (235, 235, 225)), (-0.985 * length, (170, 20, 20))):
            add_block(
                builder, pose, (x - 0.05, y - 0.14, 0.58), (x + 0.05, y + 0.14, 0.72), paint, linear(color)
            )
    for x in (-length, length):
        plate = (x - 0.03, -0.26, 0.38), (x + 0.03, 0.26, 0.5)
        add_block(builder, pose, *plate, (PLAIN, NO_CLASS, object_id), linear((220, 220, 200)))


def _add_wheels(builder: MeshBuilder, pose: np.ndarray, size: tuple[float, float], object_id: int) -> None:
    length, width = size
    angles = np.arange(14) * 2 * np.pi / 14
    circle = np.stack([np.cos(angles), np.sin(angles)], 1)
    for x in (-0.6 * length, 0.63 * length):
        for radius, beyond, tint in ((0.33, 0.02, 0.012), (0.2, 0.03, 0.35)):
            outline = [x, 0.33] + radius * circle[::-1]
            _extrude(builder, pose, outline, width + beyond, (PAINT, NO_CLASS, object_id), np.full(3, tint))


def _extrude(
    builder: MeshBuilder,
    pose: np.ndarray,
    outline: np.ndarray,
    half_width: float,
    kind: tuple[int, int, int],
    tint: np.ndarray,
) -> None:
    """A convex outline (N, 2) in x and z, clockwise seen from -y, as wide as a car."""
    right = np.column_stack([outline[:, 0], np.full(len(outline), -half_width), outline[:, 1]])
    left = right * [1, -1, 1]
    builder.polygon(placed(pose, right[::-1]), kind, tint)
    builder.polygon(placed(pose, left), kind, tint)
    for i in range(len(outline)):
        j = (i + 1) % len(outline)
        builder.polygon(placed(pose, np.stack([right[i], right[j], left[j], left[i]])), kind, tint)


def _add_lamps(builder: MeshBuilder, ground: Ground, rng: np.random.Generator) -> None:
    """Street lamps, thin as they are."""
    steel = linear((70, 78, 76))
    for number, x in enumerate(np.arange(-0.5, 0.51, 0.2) * ground.extent):
        side = 1.0 if number % 2 else -1.0
        object_id = builder.new_object()
        pose = upright_pose(
            _on_ground(ground, x + rng.uniform(-1, 1), side * 4.75), 0.0 if side < 0 else np.pi
        )
        kind = (PLAIN, NO_CLASS, object_id)
        add_block(builder, pose, (-0.09, -0.09, -0.3), (0.09, 0.09, 0.9), kind, steel)
        add_block(builder, pose, (-0.05, -0.05, 0.9), (0.05, 0.05, 4.6), kind, steel)
        add_block(builder, pose, (-0.04, -0.05, 4.5), (0.04, 1.1, 4.58), kind, steel)
        add_block(builder, pose, (-0.12, 0.7, 4.44), (0.12, 1.25, 4.56), kind, linear((200, 200, 190)))


def _on_ground(ground: Ground, x: float, y: float) -> np.ndarray:
    return np.array([x, y, ground.height(np.array([[x, y]]))[0]])


def _on_way(ground: Ground, spot: np.ndarray, margin: float) -> bool:
    """Whether a place is on a paved way to a door."""
    return any(abs(spot[0] - rect[0]) < rect[5] + margin and spot[1] * rect[1] > 0 for rect in ground.rects)
