"""The fused voting pass against a slow twin, and what must not change the result."""

from dataclasses import replace

import numba
import numpy as np
import open3d as o3d
import pycolmap
import pytest

from sc3d.geometry.cameras import View, look_at, project
from sc3d.geometry.raycast import Surface, first_surface, see_points
from sc3d.geometry.voxels import sort_by_voxel
from sc3d.labelling.cloud import Cloud
from sc3d.labelling.density import FULL, GaussianField, gaussian_density, kernel_density, voxel_shares
from sc3d.labelling.fusion import fuse
from sc3d.labelling.observation import observe
from sc3d.labelling.voting import (
    GRAZING,
    MIN_WEIGHT,
    SCALE,
    CameraParameters,
    VoteAccumulator,
    VoteWeighting,
    to_camera,
    to_pixel,
)
from sc3d.scene.labels import LOCKED
from sc3d.settings.labels import Label, PaperMechanisms

MODELS = {
    "SIMPLE_PINHOLE": [110, 80, 60],
    "PINHOLE": [110, 112, 80, 60],
    "SIMPLE_RADIAL": [110, 80, 60, 0.05],
    "RADIAL": [110, 80, 60, 0.05, -0.02],
    "OPENCV": [110, 112, 80, 60, 0.05, -0.02, 1e-3, -2e-3],
    "OPENCV_FISHEYE": [90, 92, 80, 60, 0.02, -0.01, 0, 0],
}
SETTINGS = Label(voxel_size=0.25, verify="no", mechanisms=PaperMechanisms(incidence=True))


def world(seed: int = 0) -> tuple[Cloud, Surface]:
    """Ground, a box and scattered leaves, with the ground and the box as the surface."""
    rng = np.random.default_rng(seed)
    ground = np.concatenate([rng.uniform(-5, 5, (6000, 2)), np.zeros((6000, 1))], axis=1)
    box = o3d.t.geometry.TriangleMesh.create_box(2, 2, 2)
    corners = box.vertex.positions.numpy().astype(np.float64) - [1, 1, 0]
    triangles = box.triangle.indices.numpy()
    chosen, (u, v) = rng.integers(0, 12, 3000), rng.dirichlet((1, 1, 1), 3000).T[:2]
    a, b, c = (corners[triangles[chosen, k]] for k in range(3))
    sides = a + u[:, None] * (b - a) + v[:, None] * (c - a)
    leaves = rng.normal([3, 3, 1.5], 0.4, (1500, 3))
    normals = np.concatenate(
        [np.tile([0, 0, 1.0], (6000, 1)), np.cross(b - a, c - a), rng.normal(size=(1500, 3))]
    )
    normals = (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32)
    floor = np.array([[-5.0, -5, 0], [5, -5, 0], [5, 5, 0], [-5, 5, 0]])
    surface = Surface.from_mesh(
        np.concatenate([corners, floor]), np.concatenate([triangles, [[8, 9, 10], [8, 10, 11]]]), np.zeros(3)
    )
    return Cloud(np.concatenate([ground, sides, leaves]), normals), surface


def views_of(model: str, count: int = 6) -> list[View]:
    camera = pycolmap.Camera(model=model, width=160, height=120, params=MODELS[model])
    angles = np.arange(count) * 1.1
    return [
        View(
            f"{row}.jpg", camera, look_at(np.array([7 * np.cos(a), 7 * np.sin(a), 6 + row % 3]), np.zeros(3))
        )
        for row, a in enumerate(angles)
    ]


def noise_masks(views: list[View], seed: int = 1) -> dict:
    rng = np.random.default_rng(seed)
    coarse = {
        view.name: (
            rng.integers(0, 5, (12, 16)).astype(np.uint8),
            rng.integers(0, 256, (120, 160)).astype(np.uint8),
        )
        for view in views
    }
    return {
        name: (np.kron(mask, np.ones((10, 10), np.uint8)), confidence)
        for name, (mask, confidence) in coarse.items()
    }


def slow_votes(cloud: Cloud, views: list[View], masks: dict, surface: Surface, settings: Label) -> np.ndarray:
    """(N, 5) votes of each point's cell, from `see_points` and numpy."""
    accumulator = VoteAccumulator.for_cloud(cloud, settings.voxel_size, 5)
    cells = accumulator.to_points(np.arange(len(accumulator.votes)))
    facing = accumulator.to_points(accumulator.cloud.facing)
    votes = np.zeros((len(accumulator.votes), 5), np.int64)
    reference = np.median([np.linalg.norm(view.center - np.median(cloud.points, axis=0)) for view in views])
    for view in views:
        mask, confidence = masks[view.name]
        first = first_surface(surface, view)
        weights = observe(mask, confidence, first.range, settings.edge_width).weights
        sums, counts = np.zeros((len(votes), 5), np.int64), np.zeros(len(votes), np.int64)
        for turn in (1, -1):  # see_points drops what faces away; scattered voxels take it as well
            seen = see_points(view, cloud.points, turn * cloud.normals, first, settings.voxel_size)
            keep = (mask[seen.rows, seen.columns] > 0) & ((turn == 1) | ~facing[seen.points])
            weight = (
                weights[seen.rows, seen.columns]
                * np.exp(-seen.excess)
                * seen.incidence
                * np.minimum(reference / seen.depth, 1)
            )
            weight = np.floor(np.clip(weight, MIN_WEIGHT, 1) * SCALE + 0.5).astype(np.int64)
            chosen = cells[seen.points[keep]]
            np.add.at(sums, (chosen, mask[seen.rows, seen.columns][keep]), weight[keep])
            np.add.at(counts, chosen, 1)
        votes += sums // np.maximum(counts, 1)[:, None]
        votes[:, 0] += counts > 0
    return votes[cells]


@pytest.mark.parametrize("model", MODELS)
def test_votes_are_those_of_the_slow_twin(model):
    (cloud, surface), views = world(), views_of(model)
    masks = noise_masks(views)
    fused = fuse(cloud, views, lambda view: masks[view.name], surface, 5, SETTINGS)
    expected = slow_votes(cloud, views, masks, surface, SETTINGS)
    found = fused.grid.votes[fused.rows]
    assert (found[:, 0] > 0).mean() > 0.8
    np.testing.assert_array_equal(found[:, 0], expected[:, 0])
    assert np.abs(found - expected).max() <= len(views)  # float32 against float64: one unit of 4096 per view


@pytest.mark.parametrize("model", [model for model in MODELS if "FISHEYE" not in model])
def test_kernel_projects_like_pycolmap(model):
    camera = pycolmap.Camera(
        model=model,
        width=1600,
        height=1200,
        params=[10 * p if k < len(MODELS[model]) and p > 1 else p for k, p in enumerate(MODELS[model])],
    )
    view = View("a", camera, look_at(np.array([4.0, -3, 6]), np.zeros(3)))
    points = np.random.default_rng(0).normal(0, 3, (2000, 3))
    camera = CameraParameters.from_view(view, points)
    assert not camera.pixels.size
    expected, _ = project(view, points)
    known = np.isfinite(expected[:, 0])
    found = np.array(
        [to_pixel.py_func(camera.parameters, *to_camera.py_func(camera, *point)) for point in points[known]]
    )
    assert known.sum() > 1000 and np.abs(found - expected[known]).max() < 1e-9


def labels_of(cloud: Cloud, views: list[View], masks: dict, surface: Surface, settings: Label):
    return fuse(cloud, views, lambda view: masks[view.name], surface, 5, settings).labels


@pytest.mark.parametrize(
    ("scale", "offset"), [(100.0, [0, 0, 0]), (1.0, [512345.25, 5187654.5, 210.125]), (0.01, [-3, 7, 1e3])]
)
def test_scale_and_position_of_the_world_do_not_matter(scale, offset):
    (cloud, surface), views, offset = world(), views_of("OPENCV"), np.array(offset)
    masks, settings = noise_masks(views), replace(Label(), voxel_size=0.25)
    expected = labels_of(cloud, views, masks, surface, settings)
    moved = []
    for view in views:
        pose = view.cam_from_world.copy()
        pose[:3, 3] = -pose[:3, :3] @ (scale * view.center + offset)
        moved.append(replace(view, cam_from_world=pose))
    box = o3d.t.geometry.TriangleMesh.create_box(2, 2, 2)
    vertices = np.concatenate(
        [
            box.vertex.positions.numpy().astype(np.float64) - [1, 1, 0],
            [[-5.0, -5, 0], [5, -5, 0], [5, 5, 0], [-5, 5, 0]],
        ]
    )
    triangles = np.concatenate([box.triangle.indices.numpy(), [[8, 9, 10], [8, 10, 11]]])
    there = Surface.from_mesh(scale * vertices + offset, triangles, offset)
    found = labels_of(
        Cloud(scale * cloud.points + offset, cloud.normals),
        moved,
        masks,
        there,
        replace(settings, voxel_size=0.25 * scale),
    )
    for name in ("label", "state", "num_views"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))


def test_one_or_two_threads_views_and_points_in_any_order_give_the_same_bits():
    (cloud, surface), views = world(), views_of("RADIAL")
    masks, settings, rng = (
        noise_masks(views),
        Label(voxel_size=0.25, mechanisms=PaperMechanisms(reproject=True)),
        np.random.default_rng(5),
    )
    expected = fuse(cloud, views, lambda view: masks[view.name], surface, 5, settings)
    order = rng.permutation(len(cloud.points))
    before = numba.get_num_threads()
    try:
        numba.set_num_threads(1)
        found = fuse(
            Cloud(cloud.points[order], cloud.normals[order]),
            views[::-1],
            lambda view: masks[view.name],
            surface,
            5,
            settings,
        )
    finally:
        numba.set_num_threads(before)
    for name in ("label", "confidence", "state", "num_views"):
        np.testing.assert_array_equal(getattr(found.labels, name), getattr(expected.labels, name)[order])
    np.testing.assert_array_equal(found.grid.votes[found.rows], expected.grid.votes[expected.rows][order])


@pytest.mark.parametrize(
    "switch",
    [
        {"mechanisms": PaperMechanisms()},
        {"mechanisms": PaperMechanisms(incidence=True, range=False)},
        {"mechanisms": PaperMechanisms(incidence=True, depth_excess=False)},
        {"use_confidence": False},
        {"edge_width": 0.0},
    ],
)
def test_every_weight_is_a_switch(switch):
    (cloud, surface), views = world(), views_of("PINHOLE")
    masks = noise_masks(views)
    read = lambda view: masks[view.name]
    on, off = (
        fuse(cloud, views, read, surface, 5, settings) for settings in (SETTINGS, replace(SETTINGS, **switch))
    )
    assert (on.grid.votes[:, 0] == off.grid.votes[:, 0]).all()  # the same sightings
    assert on.grid.votes[:, 1:].sum() < off.grid.votes[:, 1:].sum()  # each factor only takes weight away


def test_grazing_sightings_take_no_part_in_the_second_vote():
    (cloud, surface), views = world(), views_of("PINHOLE", 1)
    accumulator = VoteAccumulator.for_cloud(cloud, 0.25, 5, second=True)
    mask = np.ones((120, 160), np.uint8)
    first = first_surface(surface, views[0])
    accumulator.add_view(
        views[0],
        observe(mask, None, first.range, Label().edge_width),
        VoteWeighting(0.25, 9.0, True, True, True, False, True),
    )
    cosine = np.abs(np.einsum("ij,ij->i", cloud.normals, views[0].center - cloud.points)) / np.linalg.norm(
        views[0].center - cloud.points, axis=1
    )
    steepest = np.zeros(len(accumulator.votes))
    np.maximum.at(steepest, accumulator.to_points(np.arange(len(accumulator.votes))), cosine)
    strict = accumulator.strict[:, 0] > 0
    assert (
        strict.any()
        and (steepest[strict] >= GRAZING).all()
        and (accumulator.votes[:, 0] > accumulator.strict[:, 0]).any()
    )


def test_a_floater_of_low_opacity_has_less_than_a_hundredth_of_the_vote():
    rng = np.random.default_rng(0)
    sheet = np.concatenate([rng.uniform(0.1, 0.9, (20, 2)), np.full((20, 1), 0.3)], axis=1)
    points = np.concatenate([sheet, [[0.5, 0.5, 0.85]]])
    flat = np.tile(np.float32([0.15, 0.15, 0.001]), (21, 1))
    opacities = np.r_[np.full(20, 0.9), 0.01].astype(np.float32)
    gaussians = GaussianField(points, np.tile(np.eye(3, dtype=np.float32), (21, 1, 1)), flat, opacities)
    shares = voxel_shares(
        gaussian_density(points, gaussians, 1.0), sort_by_voxel(points, 1.0, np.zeros(3))
    ).astype(int)
    assert shares.max() == FULL and shares[-1] < 0.01 * shares.sum()
    near = np.argsort(np.linalg.norm(points - points[-1], axis=1))[:12]
    brute = sum(
        opacities[k] * np.exp(-0.5 * (((points[-1] - points[k]) / np.maximum(flat[k], 0.25)) ** 2).sum())
        for k in near
    )
    assert gaussian_density(points, gaussians, 1.0)[-1] == pytest.approx(brute, rel=1e-4)


def test_without_gaussians_points_far_from_the_mean_weigh_less_whatever_their_order():
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.normal(0.3, 0.03, (30, 3)), [[0.9, 0.9, 0.9]]])
    density = kernel_density(points, 2.0)
    mean = points.mean(axis=0)
    np.testing.assert_allclose(density, np.exp(-0.5 * ((points - mean) ** 2).sum(axis=1)), rtol=1e-4)
    order = rng.permutation(31)
    np.testing.assert_array_equal(kernel_density(points[order], 2.0), density[order])


def test_density_decides_between_the_points_of_a_voxel():
    """Two points of one voxel under different mask labels: the vote is their mean, weighted by density."""
    points = np.array([[0.3, 0.5, 0.0], [0.7, 0.5, 0.0]])
    cloud = Cloud(points, np.tile(np.float32([0, 0, 1]), (2, 1)), np.float32([1, 0.25]))
    view = View(
        "a",
        pycolmap.Camera(model="PINHOLE", width=160, height=120, params=[400, 400, 80, 60]),
        look_at(np.array([0.5, 0.5, 4.0]), np.array([0.5, 0.5, 0])),
    )
    mask = np.ones((120, 160), np.uint8)
    mask[:, 80:] = 2
    settings = Label(method="majority", voxel_size=2.0)
    votes = fuse(cloud, [view], lambda _: (mask, None), None, 3, settings)
    shares = votes.grid.votes[votes.rows[0], 1:] / SCALE
    np.testing.assert_allclose(sorted(shares), [0.2, 0.8], atol=2e-3)


def test_the_paper_preset_locks_whatever_the_other_options_say():
    (cloud, surface), views = world(), views_of("PINHOLE")
    masks = noise_masks(views)
    one = labels_of(cloud, views, masks, surface, Label(method="paper", voxel_size=0.25))
    other = labels_of(
        cloud,
        views,
        masks,
        surface,
        Label(
            method="paper",
            voxel_size=0.25,
            consensus=0.5,
            verify="no",
            edge_width=0,
            mechanisms=PaperMechanisms(range=False),
        ),
    )
    np.testing.assert_array_equal(one.state, other.state)
    assert (one.state == LOCKED).mean() > (
        labels_of(cloud, views, masks, surface, SETTINGS).state == LOCKED
    ).mean()
