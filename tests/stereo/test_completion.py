"""Sky, ground and what goes on, against scenes whose planes are known exactly."""

from __future__ import annotations

import numpy as np
import pytest

from sc3d.geometry.cameras import View, look_at, pinhole_view, rays
from sc3d.stereo.completion import (
    CELLS,
    Ground,
    _ground_planes,
    continued_planes,
    find_sky,
    fit_ground,
    horizon,
    not_below,
    without_speckles,
)

UP = np.array([0.0, 0.0, 1.0])
WIDTH, HEIGHT = 160, 120


def level_view(height: float = 2.0, drop: float = 0.0) -> View:
    """From above the origin along y; drop: how far the view sinks on 10 units."""
    pose = look_at(np.array([0.0, 0.0, height]), np.array([0.0, 10.0, height - drop]), (0.0, 0.0, 1.0))
    return pinhole_view("a.png", (WIDTH, HEIGHT), (150.0, 150.0, 80.0, 60.0), pose)


# ------------------------------------------------------------------------------------------------------------- sky


def street() -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """RGB photo, and where in it are sky, a dark building, a bright facade, leaves before the sky and ground."""
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    noise = np.random.default_rng(0).integers(0, 60, (HEIGHT, WIDTH, 1))
    parts = {
        "ground": rows >= 60,
        "building": (rows >= 30) & (rows < 60) & (columns < 50),
        "facade": (rows >= 20) & (rows < 60) & (columns >= 50) & (columns < 90),
        "leaves": (rows < 25) & (columns >= 110) & (columns < 140),
    }
    parts["sky"] = ~np.any(list(parts.values()), axis=0)
    blue = 150 + rows[..., None] * [1.2, 0.9, 0.5] + [0, 30, 70]
    image = np.where(parts["sky"][..., None], blue, 0)
    for name, color in (
        ("ground", (60, 70, 50)),
        ("building", (90, 60, 50)),
        ("facade", (185, 180, 160)),
        ("leaves", (10, 40, 5)),
    ):
        image = np.where(parts[name][..., None], color + noise, image)
    return np.clip(image, 0, 255).astype(np.uint8), parts


def test_sky_is_found_and_nothing_else_is():
    image, parts = street()
    confirmed = parts["ground"] | parts["building"] | parts["facade"]
    sky = find_sky(image, confirmed, horizon(level_view(), UP))
    core = parts["sky"].copy()
    for name in ("building", "facade", "leaves"):
        core &= ~grown(parts[name], 3)
        assert sky[parts[name] & ~grown(parts["sky"], 3)].mean() < 0.02, name
    assert sky[core].mean() > 0.97
    assert not sky[parts["ground"]].any()


def grown(mask: np.ndarray, reach: int) -> np.ndarray:
    import cv2

    return cv2.dilate(mask.astype(np.uint8), np.ones((2 * reach + 1,) * 2, np.uint8)).astype(bool)


def test_a_bright_facade_that_is_confirmed_up_to_the_border_is_no_sky():
    image, parts = street()
    image[:60, 50:90] = 235  # even, bright, up to the border: only depth tells it from sky
    parts["facade"][:60, 50:90] = True
    confirmed = parts["ground"] | parts["building"] | parts["facade"]
    sky = find_sky(image, confirmed, horizon(level_view(), UP))
    assert not sky[2:58, 58:82].any()
    assert sky[2:20, 145:].all()


def test_without_a_horizon_in_the_photo_there_is_no_sky():
    image = np.full((HEIGHT, WIDTH, 3), 240, np.uint8)
    image[60:] = 100
    nadir = pinhole_view(
        "n", (WIDTH, HEIGHT), (150.0, 150.0, 80.0, 60.0), look_at(np.array([0, 0, 50.0]), np.zeros(3))
    )
    nothing = np.zeros((HEIGHT, WIDTH), bool)
    assert not find_sky(image, nothing, horizon(nadir, UP)).any()
    assert not find_sky(image, nothing, horizon(level_view(drop=8.0), UP)).any()
    assert find_sky(image, nothing, horizon(level_view(), UP)).any()


def test_horizon_is_the_elevation_of_the_rays():
    view = level_view(drop=2.0)
    directions, _ = rays(view)
    np.testing.assert_allclose(horizon(view, UP).ravel(), directions @ UP, atol=1e-9)


# ---------------------------------------------------------------------------------------------------------- ground


def on_plane(count: int, normal: np.ndarray, seed: int = 0) -> np.ndarray:
    """(count, 3) points of the plane normal . X = 0, 40 units wide."""
    xy = np.random.default_rng(seed).uniform(-20, 20, (count, 2))
    return np.column_stack([xy, -(xy @ normal[:2]) / normal[2]])


@pytest.mark.parametrize("angle", [0.0, 3.0])
def test_ground_under_walls_is_the_plane_that_it_is(angle):
    random = np.random.default_rng(1)
    normal = np.array([np.sin(np.deg2rad(angle)), 0.0, np.cos(np.deg2rad(angle))])
    ground = on_plane(1500, normal) + random.normal(0, 0.005, (1500, 3))
    walls = np.column_stack(
        [random.uniform(-20, 20, 3000), np.full(3000, 15.0), random.uniform(2.0, 9.0, 3000)]
    )
    centers = np.column_stack([np.linspace(-4, 4, 5), np.zeros(5), np.full(5, 2.5)])
    found = fit_ground(np.concatenate([ground, walls]), centers, UP)
    assert found is not None
    assert np.degrees(np.arccos(found.up @ normal)) < 0.2 and abs(found.height) < 0.03
    inner = np.abs(ground[:, :2]).max(axis=1) < 12
    assert np.abs(ground[inner] @ found.up - found.height - found.relief_at(ground[inner])).max() < 0.05


def bump(points: np.ndarray) -> np.ndarray:
    return 0.3 * np.exp(-(points[:, :2] ** 2).sum(axis=1) / (2 * 5.0**2))


def test_relief_is_the_bump_that_the_points_have():
    points = on_plane(6000, UP)
    points[:, 2] = bump(points)
    found = fit_ground(points, np.tile([0.0, 0.0, 4.0], (3, 1)) + [[-1, 0, 0], [0, 0, 0], [1, 0, 0]], UP)
    assert found is not None
    probes = on_plane(500, UP, seed=5) * [0.7, 0.7, 0]
    probes[:, 2] = bump(probes)
    errors = np.abs(probes @ found.up - found.height - found.relief_at(probes))
    assert np.median(errors) < 0.01 and errors.max() < 0.05


def test_few_points_or_only_a_wall_that_the_cameras_touch_are_no_ground():
    centers = np.column_stack([np.linspace(-4, 4, 5), np.zeros(5), np.full(5, 2.0)])
    assert fit_ground(on_plane(49, UP), centers, UP) is None
    assert fit_ground(on_plane(500, UP) + [0, 0, 5.0], centers, UP) is None  # all above the cameras
    assert fit_ground(np.empty((0, 3)), centers, UP) is None
    assert fit_ground(on_plane(500, UP), centers, UP) is not None


def flat_ground(relief: np.ndarray | None = None, size: float = 2.0) -> Ground:
    start = np.full(2, -size * (CELLS - 1) / 2)
    heights = np.zeros((CELLS, CELLS)) if relief is None else relief
    return Ground(UP, 0.0, np.eye(3)[:2], start, size, heights)


def test_ground_planes_are_what_rays_hit():
    view = level_view(drop=3.0)
    planes = _ground_planes(view, flat_ground())
    directions, ray_z = rays(view)
    with np.errstate(divide="ignore"):
        along = -view.center[2] / directions[:, 2]
    inverse = np.where(along > 0, 1 / (along * ray_z), 0).reshape(HEIGHT, WIDTH)
    np.testing.assert_allclose(planes[..., 0], inverse, rtol=1e-4, atol=1e-7)
    down = planes[..., 0] > 0
    assert 0.5 < down.mean() < 1
    inner = down[:-1] & down[1:]
    np.testing.assert_allclose(np.diff(planes[..., 0], axis=0)[inner], planes[:-1][inner][:, 2], rtol=1e-3)
    below = level_view(height=-1.0)
    assert not _ground_planes(below, flat_ground()).any()


def test_ground_with_relief_is_what_rays_hit():
    slope = np.tile(0.05 * (np.arange(CELLS) - (CELLS - 1) / 2), (CELLS, 1)).T * 2.0  # 0.05 per unit along y
    view = level_view(height=5.0, drop=5.0)
    planes = _ground_planes(view, flat_ground(slope))
    directions, ray_z = rays(view)
    along = -view.center[2] / (directions[:, 2] - 0.05 * directions[:, 1])  # z = 0.05 y
    points = view.center + directions * along[:, None]
    on_map = ((along > 0) & (np.abs(points[:, :2]).max(axis=1) < 20)).reshape(HEIGHT, WIDTH)
    true = (1 / (along * ray_z)).reshape(HEIGHT, WIDTH)
    assert on_map.mean() > 0.4
    assert np.abs(planes[..., 0] / true - 1)[on_map].max() < 0.01


def test_what_agrees_a_little_below_the_ground_is_left_out():
    view = level_view(drop=3.0)
    planes = _ground_planes(view, flat_ground())
    confirmed = planes[..., 0] > 0
    planes[100:106, 20:26, 0] /= 2  # 36 pixels, twice as far as the ground
    kept = not_below(view, planes, confirmed, flat_ground())
    assert not kept[100:106, 20:26].any() and kept.sum() == confirmed.sum() - 36
    planes[80:110, 60:120, 0] /= 2  # a real pit is large
    assert not_below(view, planes, confirmed, flat_ground())[85:105, 65:115].all()


# --------------------------------------------------------------------------------------------------- what goes on


def slanted_planes() -> np.ndarray:
    columns, rows = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    q = 0.2 + 2e-4 * columns - 1e-4 * rows
    return np.stack([q, np.full_like(q, 2e-4), np.full_like(q, -1e-4)], axis=2).astype(np.float32)


def test_a_hole_in_a_slanted_plane_is_filled_exactly():
    planes, image = slanted_planes(), np.full((HEIGHT, WIDTH, 3), 120, np.uint8)
    confirmed = np.ones((HEIGHT, WIDTH), bool)
    confirmed[50:55, 70:75] = False
    given = planes.copy()
    given[~confirmed] = 9.0  # what nobody confirms is not looked at
    found = continued_planes(level_view(), given, confirmed, image, None)
    np.testing.assert_allclose(found, planes, rtol=1e-5)


def test_surface_goes_on_for_a_few_pixels_only_and_less_across_an_edge():
    planes, image = slanted_planes(), np.full((HEIGHT, WIDTH, 3), 120, np.uint8)
    confirmed = np.zeros((HEIGHT, WIDTH), bool)
    confirmed[:, :60] = True
    found = continued_planes(level_view(), planes, confirmed, image, None)[..., 0] > 0
    assert (found.sum(axis=1) == 60 + 3).all()  # 2 % of 160 px
    image[:, 60:] = 200  # 80 gray values cost 10 px
    assert (continued_planes(level_view(), planes, confirmed, image, None)[..., 0] > 0).sum() == 60 * HEIGHT
    assert not continued_planes(level_view(), planes, np.zeros_like(confirmed), image, None).any()


@pytest.mark.parametrize("height, drop, goes_on", [(2.0, 2.0, True), (2.0, 10.0, False)])
def test_ground_goes_on_where_it_is_seen_flat_only(height, drop, goes_on):
    view, ground = level_view(height, drop), flat_ground()
    level = _ground_planes(view, ground)
    image = np.full((HEIGHT, WIDTH, 3), 120, np.uint8)
    confirmed = level[..., 0] > 0
    confirmed[:, 40:] = False
    found = continued_planes(view, level, confirmed, image, ground)
    hole = (level[..., 0] > 0) & (np.arange(WIDTH) > 60)
    farthest = np.quantile(level[..., 0][confirmed], 0.01)
    beyond, hole = hole & (level[..., 0] < farthest), hole & (level[..., 0] > farthest)
    assert not found[beyond].any()
    flat = hole & (horizon(view, UP) > -0.3)
    if goes_on:
        assert flat.sum() > 2000
        np.testing.assert_allclose(found[flat], level[flat], rtol=1e-4)
    steep = hole & (horizon(view, UP) < -0.36)
    assert (steep.sum() > 2000) or goes_on
    assert not found[steep].any()


def test_speckles_are_dropped_and_surfaces_stay():
    inverse = np.full((HEIGHT, WIDTH), 0.2, np.float32)
    confirmed = np.zeros((HEIGHT, WIDTH), bool)
    confirmed[20:60, 20:60] = True
    confirmed[100, 100] = confirmed[100, 102] = True
    inverse[40:42, 40:42] = 0.4  # a patch of its own depth within a surface
    kept = without_speckles(inverse, confirmed)
    assert not kept[100].any() and not kept[40:42, 40:42].any()
    assert kept.sum() == 40 * 40 - 4
    assert not without_speckles(inverse, np.zeros_like(confirmed)).any()
