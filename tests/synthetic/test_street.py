"""The synthetic street: exact depth of relief, sky told apart, photos that overlap, with and without GPS."""

from __future__ import annotations

import numpy as np
import pycolmap
import pytest
from PIL import ExifTags, Image

from sc3d.errors import InputError
from sc3d.geometry.cameras import View, in_image, pinhole_view, project, rays
from sc3d.io.mask_images import read_index_image
from sc3d.scene import class_table
from sc3d.scene.scene import read_sparse_model
from sc3d.settings.synthesize import Synthesize
from sc3d.synthetic.facades import RECESS, Opening, _add_opening, _add_wall, choose_style
from sc3d.synthetic.generate import synthesize
from sc3d.synthetic.ground import HALF_PAVED, plan_street
from sc3d.synthetic.mesh import BUILDING, GRASS, NO_CLASS, PLASTER, ROAD, TREE, MeshBuilder
from sc3d.synthetic.photos import photograph
from sc3d.synthetic.street import FRONT, build_street
from sc3d.synthetic.walk import REACH, walk
from sc3d.synthetic.world import finish_world

SETTINGS = Synthesize(kind="street", seed=3, views=8, width=120, extent=40.0, num_points=3000, gps=False)


@pytest.fixture(scope="module")
def street():
    return build_street(SETTINGS)


@pytest.fixture(scope="module")
def photos(street):
    world, views = street
    return [photograph(world, view) for view in views]


@pytest.fixture(scope="module")
def scene(tmp_path_factory, street):
    path = tmp_path_factory.mktemp("street")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sc3d.synthetic.generate.build_street", lambda settings: street)
        summary = synthesize(path, SETTINGS)
    return path, summary


def surface_points(view: View, depth: np.ndarray) -> np.ndarray:
    """(H * W, 3) world positions of all pixels."""
    directions, cosines = rays(view)
    return view.center + directions * (depth.ravel() / cosines)[:, None]


def test_depth_of_a_recessed_window_is_exact():
    builder, hole = MeshBuilder(), Opening(2.0, 3.2, 1.0, 2.6)
    style = choose_style(np.random.default_rng(0))
    kind = (PLASTER, BUILDING, builder.new_object())
    _add_wall(builder, np.eye(4), (5.0, 4.0), [hole], kind, style.tint)
    _add_opening(builder, np.eye(4), hole, style, 1, np.random.default_rng(0))
    world = finish_world(0, plan_street(40.0, np.random.default_rng(0)), [], builder, street=True)
    forwards = np.array([[1.0, 0, 0, -2.6], [0, 0, -1, 1.8], [0, 1, 0, 6.0], [0, 0, 0, 1]])  # at y = -6
    depth = photograph(world, pinhole_view("a.jpg", (240, 160), (160, 160, 120, 80), forwards)).depth
    x = 2.6 + (np.arange(240) + 0.5 - 120) / 160 * 6.0  # of the wall, along a row half a meter below the lens
    row = depth[80 + 13]
    assert np.allclose(row[((x > 0.1) & (x < 1.0)) | ((x > 4.1) & (x < 4.8))], 6.0, atol=1e-5)
    assert np.isclose(row, 6.0 + RECESS, atol=1e-5).sum() >= 20
    assert row[row > 0].max() < 6.0 + RECESS + 1e-5


def test_walk_is_at_eye_height_and_low_above_the_street_and_looks_at_one_row(street):
    world, views = street
    centers = np.stack([view.center for view in views])
    height = centers[:, 2] - world.ground.height(centers[:, :2])
    assert np.allclose(height[:6], 1.6, atol=0.25) and ((height[6:] >= 5) & (height[6:] <= 8)).all()
    assert (np.abs(centers[:, 1]) < HALF_PAVED).all()
    assert all(view.cam_from_world[2, 1] > 0.5 for view in views)


def test_default_walk_shows_every_place_of_the_facades_to_three_photos():
    settings = Synthesize(kind="street")
    ground = plan_street(settings.side, np.random.default_rng(0))
    views, reach = walk(settings, ground), REACH * settings.side
    x, z = np.meshgrid(np.linspace(-reach, reach, 60), np.linspace(0.2, 6.0, 20))
    points = np.column_stack([x.ravel(), np.full(x.size, FRONT), z.ravel()])
    seen = sum(in_image(view, project(view, points)[0]).astype(int) for view in views)
    assert len(views) == 24 and seen.min() >= 3 and np.median(seen) >= 6


def test_every_class_cars_sky_and_the_ground_at_the_feet_are_in_sight(street, photos):
    counts = (
        np.bincount(np.concatenate([photo.label.ravel() for photo in photos]), minlength=5)
        / photos[0].label.size
    )
    assert (counts[[BUILDING, TREE, ROAD, GRASS]] > 0.1).all()
    depth = np.stack([photo.depth for photo in photos])
    label = np.stack([photo.label for photo in photos])
    assert (depth == 0).mean() > 0.02 and (label[depth == 0] == NO_CLASS).all()
    truth = np.stack([photo.truth for photo in photos])
    assert (truth[depth == 0] == class_table.OTHER).all() and (truth[depth > 0] == class_table.OTHER).any()
    on_ground = np.isin(label[:6], (ROAD, GRASS))
    assert depth[:6][on_ground].min() < 3.0
    boughs = [(photo.depth[photo.label == TREE] < 2.5).sum() for photo in photos[:6]]
    assert max(boughs) > 20


def test_depth_lands_on_the_same_surface_in_the_next_photo(street, photos):
    view, other = street[1][3], street[1][5]
    points = surface_points(view, photos[3].depth)[(photos[3].label == BUILDING).ravel()]
    pixels, depth = project(other, points)
    inside = in_image(other, pixels)
    columns, rows = np.floor(pixels[inside]).astype(int).T
    agrees = np.abs(photos[5].depth[rows, columns] - depth[inside]) < 0.1
    assert agrees.sum() > 200 and (photos[5].label[rows, columns] == BUILDING)[agrees].mean() > 0.98


def test_sky_is_bright_has_clouds_and_differs_from_houses(street, photos):
    sky = np.concatenate([photo.color[photo.depth == 0] for photo in photos])
    house = np.concatenate([photo.color[photo.label == BUILDING] for photo in photos])
    assert sky[:, 2].mean() > house[:, 2].mean() + 60 and 2 < sky[:, 0].std() < 45


def test_scene_folder_is_complete(scene):
    path, summary = scene
    stems = {f"view_{i:03d}" for i in range(8)}
    for folder in ("images", "truth_depth", "truth", "truth_sky", "masks", "confidence"):
        assert {file.stem for file in (path / folder).iterdir()} == stems
    for stem in stems:
        sky = read_index_image(path / "truth_sky" / f"{stem}.png")
        assert np.array_equal(sky == 255, np.load(path / "truth_depth" / f"{stem}.npy") == 0)
        assert set(np.unique(sky)) <= {0, 255}
    assert summary["num_views"] == 8 and 0.5 < summary["mask_accuracy"] < 0.95
    assert len(read_sparse_model(path / "sparse" / "0").points) > 300


def test_photos_without_gps_still_tell_the_focal_length(scene, street):
    file = scene[0] / "images" / "view_000.jpg"
    assert not Image.open(file).getexif().get_ifd(ExifTags.IFD.GPSInfo)
    focal = pycolmap.infer_camera_from_image(file).mean_focal_length()
    assert focal == pytest.approx(street[1][0].focal, rel=1e-6)


@pytest.mark.slow
def test_the_same_seed_gives_the_same_street(street, photos):
    world, views = build_street(SETTINGS)
    assert np.array_equal(world.corners, street[0].corners)
    assert np.array_equal(photograph(world, views[7]).color, photos[7].color)


def test_altitude_of_a_street_is_refused():
    with pytest.raises(InputError, match="aerial"):
        Synthesize(kind="street", altitude=30.0)
