"""The synthetic scene: exact truth, plausible masks, the same bytes every time."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np
import open3d as o3d
import pycolmap
import pytest
from PIL import ExifTags, Image
from scipy.ndimage import maximum_filter, minimum_filter
from scipy.spatial import cKDTree

from sc3d.errors import InputError
from sc3d.geometry.cameras import in_image, project, rays
from sc3d.scene import class_table
from sc3d.scene.scene import read_sparse_model
from sc3d.settings.synthesize import Synthesize
from sc3d.synthetic.cloud import truth_cloud
from sc3d.synthetic.exif import REFERENCE
from sc3d.synthetic.flight import fly
from sc3d.synthetic.generate import synthesize
from sc3d.synthetic.ground import rect_distance
from sc3d.synthetic.masks import noisy_mask
from sc3d.synthetic.mesh import BUILDING, GRASS, NO_CLASS, ROAD, TREE
from sc3d.synthetic.objects import FLAT
from sc3d.synthetic.photos import photograph
from sc3d.synthetic.world import build_world

SETTINGS = Synthesize(views=10, width=300, extent=80.0, altitude=40.0, num_points=40_000)


@pytest.fixture(scope="module")
def world():
    return build_world(SETTINGS)


@pytest.fixture(scope="module")
def views():
    return fly(SETTINGS)


@pytest.fixture(scope="module")
def photos(world, views):
    return [photograph(world, view) for view in views]


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    path = tmp_path_factory.mktemp("scene")
    settings = Synthesize(seed=5, views=4, width=120, extent=60.0, altitude=40.0, num_points=3000)
    return path, settings, synthesize(path, settings)


def surface_points(view, depth):
    """(H * W, 3) world positions of all pixels."""
    directions, cosines = rays(view)
    return view.center + directions * (depth.ravel() / cosines)[:, None]


def plain(label):
    """(H, W) bool: pixels whose 3 x 3 neighborhood has one label."""
    return maximum_filter(label, 3) == minimum_filter(label, 3)


def test_the_flight_has_the_views_asked_for_and_several_angles(views):
    assert len({view.name for view in views}) == len(views) == SETTINGS.views
    tilt = np.degrees([np.arccos(-view.cam_from_world[2, 2]) for view in views])
    assert (tilt[:6] < 8).all() and (tilt[6:] > 25).all()


def test_every_class_is_in_sight(photos):
    counts = np.bincount(np.concatenate([photo.label.ravel() for photo in photos]), minlength=5)
    assert len(counts) == 5
    assert (counts[[BUILDING, TREE, ROAD, GRASS]] > 0.03 * counts.sum()).all() and counts[NO_CLASS] > 0


@pytest.mark.parametrize("pair", [(0, 1), (1, 7), (6, 8)])
def test_depth_lands_on_the_same_class_in_another_view(views, photos, pair):
    (view, other), (photo, seen) = (views[i] for i in pair), (photos[i] for i in pair)
    points = surface_points(view, photo.depth)[(plain(photo.label) & (photo.depth > 0)).ravel()]
    labels = photo.label[plain(photo.label) & (photo.depth > 0)]
    pixels, depth = project(other, points)
    inside = in_image(other, pixels)
    columns, rows = np.floor(pixels[inside]).astype(int).T
    agrees = (np.abs(seen.depth[rows, columns] - depth[inside]) < 0.03) & plain(seen.label)[rows, columns]
    assert agrees.mean() > 0.1 and agrees.sum() > 1000
    assert (seen.label[rows, columns] == labels[inside])[agrees].mean() > 0.998


def test_depth_and_label_of_a_flat_roof_are_exact(world, views, photos):
    hall = next(building for building in world.buildings if building.roof == FLAT)
    roof = hall.base + hall.wall - 0.4  # below the parapet
    rect = (*hall.center, np.cos(hall.yaw), np.sin(hall.yaw), hall.half[0] - 0.35, hall.half[1] - 0.35)
    num_seen = 0
    for view, photo in zip(views, photos):
        points = surface_points(view, photo.depth)
        inside = (rect_distance(points[:, :2], rect) < 0) & (photo.depth.ravel() > 0)
        on_roof = inside & (np.abs(points[:, 2] - roof) < 1e-3)
        assert (points[inside, 2] > roof - 1e-3).all()
        assert (photo.label.ravel()[on_roof] == BUILDING).all()
        num_seen += on_roof.sum()
    assert num_seen > 500


def test_road_labels_follow_the_center_lines(world, views, photos):
    view, photo = views[2], photos[2]
    points = surface_points(view, photo.depth)
    label = photo.label.ravel()
    distance = np.min([cKDTree(line).query(points[:, :2])[0] for line in world.ground.center_lines], axis=0)
    paved = np.min([rect_distance(points[:, :2], rect) for rect in world.ground.rects], axis=0) < 0.05
    on_ground = np.isin(label, (ROAD, GRASS))
    assert (label[on_ground & (distance < 4.35)] == ROAD).all()
    assert (label[on_ground & (distance > 4.65) & ~paved] == GRASS).all()


def test_truth_ends_at_the_border_of_the_site(views, photos):
    for view, photo in zip(views, photos):
        outside = np.abs(surface_points(view, photo.depth)[:, :2]).max(1) > SETTINGS.extent / 2 + 0.01
        assert (photo.label.ravel()[outside] == NO_CLASS).all()


def test_other_is_what_stands_on_the_site_and_is_no_class(world, views, photos):
    for view, photo in zip(views, photos):
        truth, sky = photo.truth.ravel(), photo.depth.ravel() == 0
        outside = ~sky & (np.abs(surface_points(view, photo.depth)[:, :2]).max(1) > SETTINGS.extent / 2)
        assert np.array_equal(
            truth[truth != class_table.OTHER], photo.label.ravel()[truth != class_table.OTHER]
        )
        assert (truth[sky] == class_table.OTHER).all()
        at_border = np.isclose(np.abs(surface_points(view, photo.depth)[:, :2]).max(1), SETTINGS.extent / 2)
        assert ((truth == 0) == outside)[~at_border].all()
    cars = np.concatenate([photo.truth[photo.depth > 0] for photo in photos]) == class_table.OTHER
    assert 0.001 < cars.mean() < 0.1
    objects = world.ints[:, 1] == NO_CLASS  # cars and garden walls
    middles = world.corners.mean(axis=1)
    inside = np.abs(middles[:, :2]).max(axis=1) < SETTINGS.extent / 2
    told = world.truth(middles[objects], np.flatnonzero(objects))
    assert np.array_equal(told, np.where(inside[objects], class_table.OTHER, 0))


def test_masks_do_not_know_other(scene):
    path, settings, _ = scene
    for number in range(settings.views):
        truth, mask, confidence = (
            np.array(Image.open(path / folder / f"view_{number:03d}.png"))
            for folder in ("truth", "masks", "confidence")
        )
        rng = np.random.default_rng([settings.seed, 4, number])
        expected = noisy_mask(np.where(truth == class_table.OTHER, 0, truth), settings.mask_noise, rng)
        assert np.array_equal(mask, expected[0]) and np.array_equal(confidence, expected[1])
    assert (truth == class_table.OTHER).any()


def test_crowns_let_the_ground_shine_through(photos):
    label = photos[2].label
    tree_share = np.stack(
        [np.roll(label == TREE, (dy, dx), (0, 1)) for dy in (-2, 0, 2) for dx in (-2, 0, 2)]
    ).mean(0)
    assert ((tree_share > 0.7) & (label != TREE)).sum() > 20


def test_photos_are_the_same_every_time(world, views, photos):
    again = photograph(build_world(SETTINGS), views[7])
    assert np.array_equal(again.color, photos[7].color)
    assert np.array_equal(again.depth, photos[7].depth) and np.array_equal(again.label, photos[7].label)


def test_mask_noise_is_tuned_and_grows_with_strength(photos):
    accuracy = [
        [
            (noisy_mask(photo.label, strength, np.random.default_rng([1, i]))[0] == photo.label)[
                photo.label != NO_CLASS
            ].mean()
            for i, photo in enumerate(photos)
        ]
        for strength in (0.0, 0.25, 0.5, 1.0, 2.0)
    ]
    mean = np.mean(accuracy, axis=1)
    assert mean[0] == 1.0 and 0.70 < mean[3] < 0.84
    assert (np.diff(mean) < -0.02).all()


def test_perfect_masks_are_sure(photos):
    mask, confidence = noisy_mask(photos[0].label, 0.0, np.random.default_rng(0))
    assert np.array_equal(mask, photos[0].label) and (confidence == 255).all()


def test_mask_errors_of_two_views_are_unrelated(photos):
    wrong = []
    for seed in (0, 1):
        masks = [
            noisy_mask(photo.label, 1.0, np.random.default_rng([seed, i]))[0]
            for i, photo in enumerate(photos)
        ]
        wrong.append(
            np.concatenate(
                [
                    (mask != photo.label)[plain(photo.label) & (photo.label > 0)]
                    for mask, photo in zip(masks, photos)
                ]
            )
        )
    assert np.corrcoef(wrong[0], wrong[1])[0, 1] < 0.3


def test_confidence_hints_at_errors_but_overlaps(photos):
    right, wrong = [], []
    for i, photo in enumerate(photos):
        mask, confidence = noisy_mask(photo.label, 1.0, np.random.default_rng([2, i]))
        right.append(confidence[(mask == photo.label) & (mask > 0)])
        wrong.append(confidence[(mask != photo.label) & (mask > 0)])
    right, wrong = np.concatenate(right), np.concatenate(wrong)
    assert right.mean() > wrong.mean() + 20
    assert np.percentile(wrong, 90) > np.percentile(right, 50)


def test_truth_cloud_agrees_with_truth_masks(world, views, photos):
    cloud = truth_cloud(world, SETTINGS.num_points, np.random.default_rng(0))
    points, label = cloud.point.positions.numpy(), cloud.point.label.numpy()[:, 0]
    assert points.shape == (SETTINGS.num_points, 3) and points.dtype == np.float64
    assert cloud.point.colors.dtype == o3d.core.uint8 and label.dtype == np.uint8
    assert np.allclose(np.linalg.norm(cloud.point.normals.numpy(), axis=1), 1, atol=1e-5)
    right = total = 0
    for view, photo in zip(views, photos):
        pixels, depth = project(view, points)
        inside = np.flatnonzero(in_image(view, pixels))
        columns, rows = np.floor(pixels[inside]).astype(int).T
        visible = (np.abs(photo.depth[rows, columns] - depth[inside]) < 0.05) & plain(photo.label)[
            rows, columns
        ]
        right += (photo.truth[rows, columns] == label[inside])[visible].sum()
        total += visible.sum()
    assert total > 20_000 and right / total > 0.99


def test_true_objects_are_buildings_and_what_is_tall(world):
    cloud = truth_cloud(world, 60_000, np.random.default_rng(0))
    points, label, instance = (
        cloud.point[name].numpy().squeeze() for name in ("positions", "label", "instance")
    )
    assert instance.dtype == np.int32 and len(set(instance[label == 1])) == len(world.buildings)
    assert (instance[label == 1] > 0).all() and not instance[np.isin(label, [3, 4, class_table.OTHER])].any()
    assert 0 < (instance[label == 2] == 0).mean() < 0.5  # bushes and hedges
    for number in set(instance) - {0}:
        corners = world.corners[world.ints[:, 2] == number]
        assert np.ptp(corners[..., 2]) >= 2.0 and len(set(label[instance == number])) == 1
        assert (points[instance == number] >= corners.min(axis=(0, 1)) - 1e-3).all()


def test_truth_cloud_has_only_outer_surfaces(world):
    cloud = truth_cloud(world, 20_000, np.random.default_rng(1))
    points = cloud.point.positions.numpy()
    for building in world.buildings:
        rect = (
            *building.center,
            np.cos(building.yaw),
            np.sin(building.yaw),
            building.half[0] - 0.05,
            building.half[1] - 0.05,
        )
        inside = rect_distance(points[:, :2], rect) < 0
        assert (points[inside, 2] > building.base + building.wall - 0.7).all()


def test_scene_folder_is_complete_and_readable(scene):
    path, settings, summary = scene
    stems = {f"view_{i:03d}" for i in range(settings.views)}
    for folder in ("images", "truth_depth", "truth", "masks", "confidence"):
        assert {file.stem for file in (path / folder).iterdir()} == stems
    assert [entry["id"] for entry in json.loads((path / "classes.json").read_text())] == [1, 2, 3, 4]
    cloud = o3d.t.io.read_point_cloud(str(path / "truth.ply"))
    assert cloud.point.positions.dtype == o3d.core.float64 and cloud.point.label.dtype == o3d.core.uint8
    assert len(cloud.point.positions) == settings.num_points
    assert summary["num_views"] == settings.views and 0.5 < summary["mask_accuracy"] < 0.95


def test_sparse_model_holds_the_true_cameras_and_exact_tracks(scene):
    path, settings, summary = scene
    model = read_sparse_model(path / "sparse" / "0")
    assert len(model.points) == summary["num_sparse_points"] > 300
    for view, true_view in zip(model.views, fly(settings)):
        assert view.name == true_view.name and np.allclose(
            view.cam_from_world, true_view.cam_from_world, atol=1e-9
        )
    reconstruction = pycolmap.Reconstruction(str(path / "sparse" / "0"))
    assert min(point.track.length() for point in reconstruction.points3D.values()) >= 3
    reconstruction.update_point_3d_errors()
    assert reconstruction.compute_mean_reprojection_error() < 1e-3


def test_exif_gives_focal_length_and_position(scene):
    path, settings, _ = scene
    views = fly(settings)
    for view in views[:2]:
        file = path / "images" / view.name
        assert pycolmap.infer_camera_from_image(file).mean_focal_length() == pytest.approx(
            view.focal, rel=1e-6
        )
        gps = Image.open(file).getexif().get_ifd(ExifTags.IFD.GPSInfo)
        latitude, longitude = (sum(float(part) / 60**i for i, part in enumerate(gps[tag])) for tag in (2, 4))
        assert gps[1] == "S" and gps[3] == "E"
        position = [-latitude, longitude, float(gps[ExifTags.GPS.GPSAltitude])]
        center = pycolmap.GPSTransform().ellipsoid_to_enu(np.array([position]), *REFERENCE)[0]
        assert np.allclose(center, view.center, atol=0.002)


def test_a_second_run_writes_the_same_bytes(scene, tmp_path):
    path, settings, _ = scene
    synthesize(tmp_path, settings)
    assert _digests(path) == _digests(tmp_path)


def test_photos_of_somebody_else_are_not_touched(tmp_path):
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "DJI_0001.JPG").write_bytes(b"photo")
    with pytest.raises(InputError, match="choose an empty folder"):
        synthesize(tmp_path, Synthesize(views=1, width=64))
    assert (tmp_path / "images" / "DJI_0001.JPG").read_bytes() == b"photo"


@pytest.mark.parametrize("wrong", [{"views": 0}, {"width": 8}, {"extent": 5.0}, {"mask_noise": -1.0}])
def test_impossible_settings_are_refused(wrong):
    with pytest.raises(InputError):
        Synthesize(**wrong)


def _digests(path: Path) -> dict[str, str]:
    return {
        str(file.relative_to(path)): hashlib.sha256(file.read_bytes()).hexdigest()
        for file in sorted(path.rglob("*"))
        if file.is_file()
    }
