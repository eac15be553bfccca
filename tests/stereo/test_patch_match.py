"""PatchMatch on textured planes whose depth is known exactly, and its kernels against slow twins."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from sc3d.geometry.cameras import View, rays
from sc3d.io.images import write_image
from sc3d.scene.depth_map import DepthMap, depth_file, read_depth_map
from sc3d.stereo import patch_match
from sc3d.stereo.agreement import RELATIVE, TOLERANCE, count_agreements
from sc3d.stereo.multi_view import StereoJob, estimate_depths, plane_normals, save, upsampled
from sc3d.stereo.pinhole_pairs import GrayView, stacked, transfers
from sc3d.tiling.executor import SerialExecutor
from tests.stereo.textured_scene import FOCAL, HEIGHT, WIDTH, textured_view

SLANTED = (np.array([0.5, 0.3, -1.0]), -5.0 / np.linalg.norm([0.5, 0.3, -1.0]))
UP = np.array([0.0, -1.0, 0.0])
CENTERS = [np.array([x, y, 0.0]) for x, y in ((0, 0), (0.5, 0), (-0.5, 0), (0, 0.5), (0, -0.5))]


def job_of(folder: Path, views: list[GrayView], depths: list[np.ndarray]) -> StereoJob:
    """All views against all others, begun at 30 of the true depths."""
    random, seeds = np.random.default_rng(1), []
    for depth in depths:
        rows, columns = np.nonzero(depth)
        chosen = random.choice(len(rows), 30, replace=False)
        seeds.append(
            np.column_stack([columns[chosen], rows[chosen], 1 / depth[rows[chosen], columns[chosen]]])
        )
    cameras = [view.view for view in views]
    sources = [np.array([other for other in range(len(views)) if other != row]) for row in range(len(views))]
    ranges = [(0.02, 1.0, 1.0)] * len(views)
    for name in ("work", "output"):
        (folder / name).mkdir(exist_ok=True)
    job = StereoJob(
        folder, cameras, cameras, sources, ranges, seeds, WIDTH, UP, folder / "work", folder / "output"
    )
    for row, view in enumerate(views):
        gray = np.round(view.gray * 255).astype(np.uint8)
        save(job.gray_file(row), gray)
        (folder / "images").mkdir(exist_ok=True)
        write_image(folder / "images" / view.view.name, np.repeat(gray[..., None], 3, axis=2))
    return job


@pytest.fixture(scope="module")
def slanted(tmp_path_factory) -> tuple[StereoJob, list[np.ndarray]]:
    pairs = [
        textured_view(center, np.array([0, 0, 5.0]), [SLANTED], name=f"{number}.png")
        for number, center in enumerate(CENTERS)
    ]
    job = job_of(tmp_path_factory.mktemp("slanted"), [pair[0] for pair in pairs], [pair[1] for pair in pairs])
    estimate_depths(job, SerialExecutor())
    return job, [pair[1] for pair in pairs]


def result(job: StereoJob, row: int) -> DepthMap:
    return read_depth_map(depth_file(job.output, job.views[row].name))


def test_a_slanted_plane_is_found_everywhere(slanted):
    job, depths = slanted
    found = result(job, 0)
    inner = np.s_[8:-8, 8:-8]
    disparity = np.abs(0.5 * WIDTH * (1 / found.depth[inner] - 1 / depths[0][inner]))  # px, between neighbors
    assert np.median(disparity) < 0.03 and np.quantile(disparity, 0.95) < 0.1
    assert (found.num_views[inner] >= 2).mean() > 0.95


def test_normals_are_those_of_the_plane_and_face_the_camera(slanted):
    job, _ = slanted
    found, view = result(job, 0), job.views[0]
    normals = found.normals[8:-8, 8:-8].astype(float) / 127
    true = view.cam_from_world[:3, :3] @ SLANTED[0] / np.linalg.norm(SLANTED[0])
    true *= -np.sign(true[2])
    angles = np.degrees(np.arccos(np.clip(normals @ true, -1, 1)))
    assert np.median(angles) < 4 and np.quantile(angles, 0.9) < 15
    assert (normals[..., 2] < 0).all()


def test_plane_normals_of_an_exact_plane():
    gray, depth = textured_view(CENTERS[0], np.array([0, 0, 5.0]), [SLANTED])
    inverse = (1 / depth).astype(np.float64)
    slopes = [np.gradient(inverse, axis=axis) for axis in (1, 0)]
    normals = plane_normals(gray.view, np.stack([inverse, *slopes], axis=2)) / 127
    true = SLANTED[0] / np.linalg.norm(SLANTED[0])
    true = gray.view.cam_from_world[:3, :3] @ true
    assert np.abs(normals - true * -np.sign(true[2])).max() < 0.01


def test_what_stands_in_front_is_told_from_what_is_behind(tmp_path):
    wall, behind = (np.array([0.0, 0, -1]), -3.0), (np.array([0.0, 0, -1]), -6.0)
    pairs = [
        textured_view(center, center + [0, 0, 5.0], [behind], name=f"{n}.png")
        for n, center in enumerate(CENTERS)
    ]
    fronts = [textured_view(center, center + [0, 0, 5.0], [wall], seed=7) for center in CENTERS]
    views, depths = [], []
    for (gray, depth), (front, front_depth), center in zip(pairs, fronts, CENTERS, strict=True):
        directions, ray_z = rays(gray.view)
        x = center[0] + (directions[:, 0] / ray_z * 3.0).reshape(HEIGHT, WIDTH)
        left = x < 0  # the wall ends at x = 0
        views.append(replace(gray, gray=np.where(left, front.gray, gray.gray).astype(np.float32)))
        depths.append(np.where(left, front_depth, depth))
    job = job_of(tmp_path, views, depths)
    estimate_depths(job, SerialExecutor())
    found = result(job, 0)
    error = np.abs(found.depth / depths[0] - 1)
    assert (error < 0.01)[8:-8, 8:-8].mean() > 0.93
    sure = found.num_views >= 2
    assert (error[sure] < 0.02).mean() > 0.985 and sure[8:-8, 8:-8].mean() > 0.85


def test_an_even_sky_is_confirmed_by_nobody(tmp_path):
    """Above the horizon of a ground plane there is nothing but noise of the sensor."""
    ground, target = (np.array([0.0, -1, 0]), -1.5), np.array([0, 0.3, 5.0])
    random, views, depths = np.random.default_rng(0), [], []
    for number, center in enumerate(CENTERS):
        gray, depth = textured_view(center, target + center, [ground], name=f"{number}.png")
        depth[depth > 60] = 0
        sky = 0.9 + random.normal(0, 0.5 / 255, depth.shape)
        views.append(replace(gray, gray=np.where(depth > 0, gray.gray, sky).astype(np.float32)))
        depths.append(depth)
    job = job_of(tmp_path, views, depths)
    estimate_depths(job, SerialExecutor())
    found, sky = result(job, 0), depths[0] == 0
    inside = np.zeros_like(sky)
    inside[: np.nonzero(sky.any(1))[0].max() - 6] = True
    assert sky.mean() > 0.2 and (found.num_views >= 2)[sky & inside].mean() < 0.03
    assert found.sky[sky & inside].mean() > 0.97 and not found.sky[depths[0] > 0].mean() > 0.02
    assert not found.depth[found.sky].any() and not found.num_views[found.sky].any()


def test_views_in_any_order_give_the_same_and_so_does_an_interrupted_run(slanted, tmp_path):
    job, _ = slanted
    again = replace(job, work=tmp_path / "work", output=tmp_path / "output")
    for folder in (again.work, again.output):
        folder.mkdir()
    for row in range(len(job.views)):
        save(again.gray_file(row), np.load(job.gray_file(row)))

    class Backwards:
        def run(self, name, function, items, needs=None):
            done = [function(item) for item in reversed(items)]
            return [function(item) for item in items[:2]] + done[::-1][2:]  # some of them twice

    estimate_depths(again, Backwards())
    for row in range(len(job.views)):
        for mine, other in zip(
            vars(result(job, row)).values(), vars(result(again, row)).values(), strict=True
        ):
            np.testing.assert_array_equal(mine, other)


def test_dissimilarity_is_that_of_its_definition():
    """Against NCC with exact plane homographies, at random pixels and planes."""
    pairs = [textured_view(center, np.array([0, 0, 5.0]), [SLANTED]) for center in CENTERS[:2]]
    (first, depth), (second, _) = pairs
    A, B = transfers([first.view], [second.view])
    inverse = 1 / depth
    slopes = [np.gradient(inverse, axis=axis) for axis in (1, 0)]
    random = np.random.default_rng(0)
    for row, column in zip(random.integers(20, 100, 40), random.integers(30, 130, 40), strict=True):
        q = inverse[row, column] * random.uniform(0.97, 1.03)
        a, b = slopes[0][row, column], slopes[1][row, column]
        stereo = patch_match.Stereo(
            first.gray,
            second.gray[None],
            np.array([[WIDTH, HEIGHT]]),
            A,
            B,
            np.float32(0),
            np.float32(1),
            np.float32(1),
            np.zeros((1, 0, 0, 3), np.float32),
            A,
            B,
        )
        cost, planes = np.empty((HEIGHT, WIDTH), np.float32), np.zeros((HEIGHT, WIDTH, 3), np.float32)
        planes[row, column] = q, a, b
        patch_match.evaluate(stereo, planes, cost)
        got = cost[row, column]
        assert abs(got - slow_dissimilarity(first.gray, second.gray, A[0], B[0], row, column, q, a, b)) < 0.02


def slow_dissimilarity(gray, other, A, B, row, column, q, a, b) -> float:
    """1 - NCC, each pixel of the patch moved by itself."""
    offsets = np.arange(-patch_match.RADIUS, patch_match.RADIUS + 1, patch_match.STEP)
    dy, dx = (each.ravel() for each in np.meshgrid(offsets, offsets, indexing="ij"))
    reference = gray[row + dy, column + dx].astype(float)
    difference = (reference - gray[row, column]) / patch_match.COLOR
    weights = np.exp(-0.5 * (difference**2 + (dx**2 + dy**2) / patch_match.SPATIAL**2))
    weights /= weights.sum()
    pixels = np.stack([column + 0.5 + dx, row + 0.5 + dy, np.ones(len(dx))])
    moved = A.astype(float) @ pixels + B[:, None].astype(float) * (q + a * dx + b * dy)
    u, v = moved[:2] / moved[2] - 0.5
    sampled = map_coordinates(other.astype(float), [v, u], order=1)
    mean = lambda value: (weights * value).sum()
    covariance = mean(reference * sampled) - mean(reference) * mean(sampled)
    variances = [mean(value**2) - mean(value) ** 2 + patch_match.NOISE for value in (reference, sampled)]
    return 1 - covariance / np.sqrt(variances[0] * variances[1])


def test_agreements_are_those_of_a_slow_twin():
    random = np.random.default_rng(3)
    pairs = [textured_view(center, np.array([0, 0, 5.0]), [SLANTED]) for center in CENTERS]
    views = [pair[0].view for pair in pairs]
    maps = [
        (1 / pair[1] * random.choice([1.0, 1.004, 1.03, 0.0], pair[1].shape)).astype(np.float32)
        for pair in pairs
    ]
    facing = [np.stack([map_, 0 * map_, 0 * map_], axis=2) for map_ in maps]
    counts = count_agreements(maps[0], views[0], facing[1:], views[1:])
    assert set(np.unique(counts)) >= {0, 1, 2}
    for row, column in zip(random.integers(0, HEIGHT, 300), random.integers(0, WIDTH, 300), strict=True):
        slow = sum(
            agrees(views[0], maps[0], other, map_, row, column)
            for other, map_ in zip(views[1:], maps[1:], strict=True)
        )
        assert counts[row, column] == slow


def test_between_pixels_a_slanted_plane_agrees_where_a_stepped_one_does_not():
    """Ground at a grazing angle: from row to row its inverse depth changes by more than RELATIVE."""
    ground, target = (np.array([0.0, -1, 0]), -1.0), np.array([0.0, 0.3, 5.0])
    views, inverses = [], []
    for center in CENTERS[:3]:
        gray, depth = textured_view(center + [0, 0, 0.37 * center[0]], target + center, [ground])
        views.append(gray.view)
        inverses.append(np.where(depth > 0, 1 / np.maximum(depth, 1e-9), 0))
    planes = []
    for inverse in inverses:
        slopes = np.gradient(inverse, axis=1), np.gradient(inverse, axis=0)
        planes.append(np.stack([inverse, *slopes], axis=2).astype(np.float32))
    far = (inverses[0] > 0.02) & (inverses[0] < 0.12)
    far[:, :20] = far[:, -20:] = False
    own = inverses[0].astype(np.float32)
    slanted = count_agreements(own, views[0], planes[1:], views[1:])
    stepped = count_agreements(
        own, views[0], [each * np.float32([1, 0, 0]) for each in planes[1:]], views[1:]
    )
    assert far.sum() > 500 and (slanted[far] == 2).mean() > 0.98
    assert (stepped[far] == 2).mean() < 0.8
    loose = count_agreements(own * np.float32(1.02), views[0], planes[1:], views[1:], 3.0)
    assert (loose >= count_agreements(own * np.float32(1.02), views[0], planes[1:], views[1:])).all()
    assert (loose[far] == 2).mean() > 0.9


def test_of_two_sources_one_is_enough_where_the_other_sees_nothing():
    """Three photos of a strip: most pixels of an outer one lie in one of the two others only. The right plane must
    cost less there than a wrong one that happens to lie in both.
    """
    (first, depth), (near, _), (far, _) = [
        textured_view(np.array([x, 0.0, 0.0]), np.array([x, 0.0, 5.0]), [SLANTED]) for x in (0.0, 1.0, 4.5)
    ]
    views = [near.view, far.view]
    inverse = (1 / depth).astype(np.float32)
    true = np.stack([inverse, np.gradient(inverse, axis=1), np.gradient(inverse, axis=0)], axis=2)
    stereo = patch_match.Stereo(
        first.gray,
        stacked([near.gray, far.gray]),
        np.array([[WIDTH, HEIGHT]] * 2),
        *transfers([first.view] * 2, views),
        np.float32(0.02),
        np.float32(1),
        np.float32(0.5),
        np.zeros((2, 0, 0, 3), np.float32),
        *transfers(views, [first.view] * 2),
    )
    x = 0.5 + np.arange(WIDTH) - FOCAL * 1.0 * inverse  # columns in the near view
    other = 0.5 + np.arange(WIDTH) - FOCAL * 4.5 * inverse
    lonely = (x > 15) & (x < WIDTH - 15) & (other < 0)
    lonely[:10] = lonely[-10:] = False
    assert lonely.mean() > 0.3
    right, wrong = np.empty((HEIGHT, WIDTH), np.float32), np.empty((HEIGHT, WIDTH), np.float32)
    patch_match.evaluate(stereo, true, right)
    assert (right[lonely] < patch_match.LONELY + 0.1).mean() > 0.95
    for factor in (0.3, 0.6, 1.3):
        patch_match.evaluate(stereo, true * np.float32(factor), wrong)
        assert (wrong > right)[lonely].mean() > 0.95
    alone = stereo._replace(
        sources=stereo.sources[:1],
        sizes=stereo.sizes[:1],
        A=stereo.A[:1],
        B=stereo.B[:1],
        others=stereo.others[:1],
    )
    patch_match.evaluate(alone, true, wrong)
    np.testing.assert_allclose(right[lonely], wrong[lonely] + patch_match.LONELY, atol=1e-4)


def test_three_photos_of_a_strip_are_right_where_one_other_sees_them(tmp_path):
    """The two outer ones share next to nothing."""
    pairs = [
        textured_view(np.array([x, 0.0, 0.0]), np.array([x, 0.0, 5.0]), [SLANTED], name=f"{number}.png")
        for number, x in enumerate((0.0, 1.8, 3.6))
    ]
    job = job_of(tmp_path, [pair[0] for pair in pairs], [pair[1] for pair in pairs])
    estimate_depths(job, SerialExecutor())
    found, depth = result(job, 0), pairs[0][1]
    shift = FOCAL * 1.8 / depth  # px, to the middle one
    columns = 0.5 + np.arange(WIDTH) * np.ones((HEIGHT, 1))
    lonely = (columns - shift > 8) & (columns - 2 * shift < 0) & (columns < WIDTH - 8)
    lonely[:8] = lonely[-8:] = False
    assert lonely.mean() > 0.15
    error = np.abs(found.depth / depth - 1)[lonely]
    assert (error < 0.01).mean() > 0.95 and np.quantile(error, 0.98) < 0.05
    assert (found.num_views[lonely] == 1).mean() > 0.9


def agrees(
    view: View, inverse: np.ndarray, other: View, other_inverse: np.ndarray, row: int, column: int
) -> bool:
    def point(camera: View, pixel, q):
        local = np.linalg.solve(camera.matrix, [*pixel, 1.0]) / q
        return camera.cam_from_world[:3, :3].T @ (local - camera.cam_from_world[:3, 3])

    def pixel(camera: View, world):
        moved = camera.matrix @ (camera.cam_from_world[:3, :3] @ world + camera.cam_from_world[:3, 3])
        return moved[:2] / moved[2], moved[2]

    if inverse[row, column] <= 0:
        return False
    (u, v), z = pixel(other, point(view, (column + 0.5, row + 0.5), inverse[row, column]))
    if not (0 <= u < WIDTH and 0 <= v < HEIGHT):
        return False
    found = other_inverse[int(v), int(u)]
    if found <= 0 or abs(found * z - 1) > RELATIVE:
        return False
    back, _ = pixel(view, point(other, (u, v), found))
    return bool(np.hypot(*(back - [column + 0.5, row + 0.5])) < TOLERANCE)


def test_upsampled_planes_stay_the_same_planes():
    height, width = 30, 40
    a, b = 0.002, -0.003
    columns, rows = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    planes = np.stack(
        [0.2 + a * columns + b * rows, np.full_like(columns, a), np.full_like(columns, b)], axis=2
    )
    finer = upsampled(planes.astype(np.float32), (61, 79))
    fine_columns, fine_rows = np.meshgrid((np.arange(79) + 0.5) * 40 / 79, (np.arange(61) + 0.5) * 30 / 61)
    np.testing.assert_allclose(finer[..., 0], 0.2 + a * fine_columns + b * fine_rows, rtol=1e-5)
    np.testing.assert_allclose(
        finer[..., 1:], np.broadcast_to([a * 40 / 79, b * 30 / 61], (61, 79, 2)), rtol=1e-5
    )


def test_stacked_images_of_any_size():
    stack = stacked([np.ones((2, 5)), np.full((4, 3), 2.0)])
    assert stack.shape == (2, 4, 5) and stack[0, :2].min() == 1 and stack[1, :, 3:].max() == 0
