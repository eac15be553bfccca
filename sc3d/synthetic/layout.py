"""Where things stand: buildings along the roads, driveways, trees beside houses and roads, hedges, walls and
cars.
"""

from __future__ import annotations

import numpy as np

from sc3d.synthetic.ground import DRIVEWAY, HALF_PAVED, PARKING, Ground, rect_distance
from sc3d.synthetic.mesh import MeshBuilder, linear
from sc3d.synthetic.objects import FLAT, GABLE, HIP, Building, add_car, add_fence
from sc3d.synthetic.plants import add_bush, add_conifer, add_tree


def place_buildings(ground: Ground, rng: np.random.Generator) -> list[Building]:
    """Houses facing the roads, one of them a flat-roofed hall with a car park; levels their plots and paves
    their driveways in `ground`.
    """
    wanted = max(2, round(14 * (ground.extent / 120) ** 2))
    limit = ground.extent / 2 - 3.0
    buildings: list[Building] = []
    for attempt in range(60 * wanted):
        if len(buildings) >= wanted:
            break
        # first, while there is room; small sites may have none
        hall = not buildings and attempt < 20 * wanted
        long, short = ((8.0, 10.0), (5.5, 6.5)) if hall else ((4.5, 7.5), (3.6, 4.8))
        half = rng.uniform(*long), rng.uniform(*short)
        # late comers fill the second row
        gap = 17.0 if hall else rng.uniform(4.0, 8.0) + (14.0 if attempt > 30 * wanted else 0.0)
        road = int(rng.integers(len(ground.center_lines)))
        x, y, yaw = _beside_road(ground, road, HALF_PAVED + gap + half[1], rng)
        wing = None
        if not hall and rng.random() < 0.5:
            side = rng.choice([-1.0, 1.0])
            wing = (side * (half[0] - 2.9), 0.8 * half[1] + rng.uniform(0.5, 2.0), 2.6, 0.8 * half[1])
        roof = FLAT if hall else int(rng.choice([GABLE, HIP, FLAT], p=[0.5, 0.35, 0.15]))
        wall = rng.uniform(5.0, 6.5) if hall else rng.choice([3.2, 5.8]) + rng.uniform(-0.2, 0.3)
        base = float(ground.height(np.array([[x, y]]))[0])
        building = Building((x, y), base, yaw, half, float(wall), roof, wing)
        if _fits(building, buildings, ground, limit):
            buildings.append(building)
            _pave(ground, building, gap, PARKING if hall else DRIVEWAY, rng)
            ground.pads.append((x, y, yaw, half[0], half[1] + (3.0 if wing else 0.0), base))
    return buildings


def plant(builder: MeshBuilder, ground: Ground, buildings: list[Building], rng: np.random.Generator) -> None:
    """Trees that overhang roofs, trees along the roads, clumps on the lawns, hedges and bushes; also beyond
    the site, sparsely.
    """
    share = (ground.extent / 120) ** 2
    spots: list[tuple[float, float, float]] = []
    for building in buildings:
        for _ in range(int(rng.integers(1, 4))):
            spots.append((*_beside_wall(building, rng.uniform(1.0, 2.2), rng), rng.uniform(2.2, 3.6)))
    for _ in range(round(26 * share)):
        road = int(rng.integers(len(ground.center_lines)))
        x, y, _ = _beside_road(ground, road, HALF_PAVED + rng.uniform(0.6, 1.4), rng)
        spots.append((x, y, rng.uniform(2.2, 3.4)))
    for _ in range(round(7 * share)):
        middle = rng.uniform(-0.47, 0.47, 2) * ground.extent
        spots += [
            (*(middle + rng.normal(0, 3.5, 2)), rng.uniform(1.6, 3.8)) for _ in range(int(rng.integers(2, 6)))
        ]
    for _ in range(round(30 * share)):
        angle, reach = rng.uniform(0, 2 * np.pi), rng.uniform(0.56, 1.0) * ground.extent
        spots.append((reach * np.cos(angle), reach * np.sin(angle), rng.uniform(2.0, 3.2)))
    planted = np.zeros((0, 3))
    for x, y, radius in spots:
        crowded = (
            len(planted)
            and (np.hypot(planted[:, 0] - x, planted[:, 1] - y) < 0.55 * (planted[:, 2] + radius)).any()
        )
        if crowded or not _on_lawn(np.array([[x, y]]), ground, buildings, 0.7)[0]:
            continue
        planted = np.vstack([planted, [x, y, radius]])
        position = np.array([x, y, ground.height(np.array([[x, y]]))[0]])
        (add_conifer if rng.random() < 0.16 else add_tree)(builder, position, radius, rng)
    _plant_bushes(builder, ground, buildings, rng)


def park_cars(builder: MeshBuilder, ground: Ground, rng: np.random.Generator) -> None:
    """Cars in both lanes of the roads, in driveways and in the bays of the car park."""
    share = ground.extent / 120
    taken = np.zeros((0, 2))
    spots = [
        _beside_road(ground, int(rng.integers(len(ground.center_lines))), 1.55, rng)
        for _ in range(round(14 * share))
    ]
    for x, y, cos, sin, half_length, half_width, kind in ground.rects:
        yaw = np.arctan2(sin, cos)
        if kind == PARKING:
            bays = np.arange(-np.floor(half_width / 2.5) * 2.5 + 1.25, half_width - 1.0, 2.5)
            reach = half_length - 2.7
            local = [(side * reach, bay) for side in (-1, 1) for bay in bays if rng.random() < 0.55]
        elif rng.random() < 0.6 and half_length > 2.8:
            local = [(rng.uniform(-0.4, 0.0) * half_length, 0.0)]
        else:
            local = []
        spots += [(x + cos * u - sin * v, y + sin * u + cos * v, yaw) for u, v in local]
    for x, y, yaw in spots:
        if max(abs(x), abs(y)) < 0.52 * ground.extent and not (np.hypot(*(taken - [x, y]).T) < 2.4).any():
            if not (np.abs(ground.road_offsets(np.array([[x, y]]))[0]) < 9).all():  # not on the junction
                taken = np.vstack([taken, [x, y]])
                add_car(builder, np.array([x, y, ground.height(np.array([[x, y]]))[0]]), yaw, rng)


def build_fences(
    builder: MeshBuilder, ground: Ground, buildings: list[Building], rng: np.random.Generator
) -> None:
    """Low walls on some garden borders."""
    for building in buildings[1::3]:
        x, y = -building.half[0] - 2.2, np.linspace(-building.half[1] - 1.0, building.half[1] + 4.0, 6)
        local = np.column_stack([np.full(6, x), y, np.zeros(6)])
        ends = local @ building.pose[:3, :3].T + building.pose[:3, 3]
        if _on_lawn(ends[:, :2], ground, buildings, 0.5).all():
            ends[:, 2] = ground.height(ends[:, :2])
            add_fence(builder, ends, linear((168, 160, 146)) * rng.uniform(0.7, 1.1))


def _beside_road(
    ground: Ground, road: int, offset: float, rng: np.random.Generator
) -> tuple[float, float, float]:
    """A place at `offset` m from a center line, on either side, and the yaw that turns a local -y towards the
    road.
    """
    line = ground.center_lines[road]
    line = line[np.abs(line).max(1) < 0.5 * ground.extent]
    i = int(rng.integers(1, len(line) - 1))
    tangent = line[i + 1] - line[i - 1]
    tangent /= np.linalg.norm(tangent)
    side = rng.choice([-1.0, 1.0])
    x, y = line[i] + side * offset * np.array([-tangent[1], tangent[0]])
    return float(x), float(y), float(np.arctan2(tangent[1], tangent[0]) + (0.0 if side > 0 else np.pi))


def _world_rects(building: Building, margin: float) -> list[tuple[float, ...]]:
    rects: list[tuple[float, ...]] = []
    for x, y, half_length, half_width in building.boxes():
        cx, cy, _ = (building.pose @ [x, y, 0.0, 1.0])[:3]
        rects.append(
            (cx, cy, np.cos(building.yaw), np.sin(building.yaw), half_length + margin, half_width + margin)
        )
    return rects


def _outline(building: Building, margin: float) -> np.ndarray:
    """(N, 2) points spread over the footprint."""
    grid = np.stack(np.meshgrid(np.linspace(-1, 1, 9), np.linspace(-1, 1, 9)), -1).reshape(-1, 2)
    points = []
    for x, y, cos, sin, half_length, half_width in _world_rects(building, margin):
        local = grid * [half_length, half_width]
        points.append(
            np.stack(
                [x + cos * local[:, 0] - sin * local[:, 1], y + sin * local[:, 0] + cos * local[:, 1]], 1
            )
        )
    return np.concatenate(points)


def _fits(building: Building, others: list[Building], ground: Ground, limit: float) -> bool:
    """True if the building stands inside the site, off the roads and the pavements, and clear of the other
    buildings and driveways.
    """
    points = _outline(building, 1.2)
    if np.abs(points).max() > limit or np.abs(ground.road_offsets(points)).min() < HALF_PAVED + 1.5:
        return False
    rects = [rect for other in others for rect in _world_rects(other, 2.0)] + [
        tuple(rect) for rect in ground.rects
    ]
    return all(rect_distance(points, rect).min() > 0.3 for rect in rects)


def _pave(ground: Ground, building: Building, gap: float, kind: int, rng: np.random.Generator) -> None:
    """Pave from the house to the road: a driveway 3 m wide, or a car park as wide as the hall."""
    reach = gap + 1.0  # up to the curb
    if kind == DRIVEWAY and gap > 12:
        return
    width = 1.5 if kind == DRIVEWAY else building.half[0]
    shift = rng.choice([-0.6, 0.6]) * building.half[0] if kind == DRIVEWAY else 0.0
    x, y, _ = (building.pose @ [shift, -building.half[1] - reach / 2 + 0.2, 0.0, 1.0])[:3]
    yaw = building.yaw + np.pi / 2  # along the way to the road
    rect = [x, y, np.cos(yaw), np.sin(yaw), reach / 2 + 0.3, width, kind]
    ground.rects = np.vstack([ground.rects, rect])


def _beside_wall(building: Building, distance: float, rng: np.random.Generator) -> tuple[float, float]:
    a, b = building.half
    along = rng.uniform(-1, 1)
    x, y, far_x, far_y = along * a, along * b, a + distance, b + distance
    local = [(x, far_y), (x, -far_y), (far_x, y), (-far_x, y)][int(rng.integers(4))]
    x, y, _ = (building.pose @ [*local, 0.0, 1.0])[:3]
    return float(x), float(y)


def _on_lawn(xy: np.ndarray, ground: Ground, buildings: list[Building], margin: float) -> np.ndarray:
    """(N,) bool: at least `margin` m from buildings, roads and paved places."""
    free = np.abs(ground.road_offsets(xy)).min(1) > HALF_PAVED + 0.5 * margin
    for rect in [rect for building in buildings for rect in _world_rects(building, 0.0)] + list(ground.rects):
        free &= rect_distance(xy, rect) > margin
    return free


def _plant_bushes(
    builder: MeshBuilder, ground: Ground, buildings: list[Building], rng: np.random.Generator
) -> None:
    for building in buildings:
        for _ in range(4):  # single bushes at the walls
            x, y = _beside_wall(building, rng.uniform(0.9, 1.6), rng)
            if _on_lawn(np.array([[x, y]]), ground, buildings, 0.6)[0]:
                size, position = rng.uniform(0.5, 1.1), np.array([x, y, ground.height(np.array([[x, y]]))[0]])
                add_bush(builder, position, (size, size, 0.8 * size), 0.0, rng)
        if rng.random() < 0.5:  # a hedge behind the house, in pieces that follow the ground
            for x in np.arange(-building.half[0] - 2, building.half[0] + 2.1, 1.7):
                px, py, _ = (building.pose @ [x, building.half[1] + 6.0, 0.0, 1.0])[:3]
                if _on_lawn(np.array([[px, py]]), ground, buildings, 0.6)[0]:
                    position = np.array([px, py, ground.height(np.array([[px, py]]))[0]])
                    add_bush(builder, position, (1.0, 0.55, 0.75), building.yaw, rng)
