"""`sc3d depth` and `sc3d extract --from depth` on a small synthetic flight with exact depth."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import open3d as o3d
import pycolmap
import pytest

from sc3d.errors import InputError
from sc3d.geometry.cameras import resample, undistorted
from sc3d.io.images import write_image
from sc3d.runner import execute
from sc3d.scene.depth_map import DepthMap, depth_file, depth_map_size, read_depth_map, write_depth_map
from sc3d.scene.scene import Scene
from sc3d.settings.reconstruction import Depth, Extract
from sc3d.settings.synthesize import Synthesize
from sc3d.stages import depth
from sc3d.stereo import multi_view
from sc3d.stereo.given_sky import SKY, SURFACE


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Scene:
    scene = Scene(tmp_path_factory.mktemp("site"))
    execute("synthesize", scene, Synthesize(views=8, width=320, num_points=20_000, altitude=60, extent=60))
    return scene


@pytest.fixture(scope="module")
def scene(site, tmp_path_factory) -> Scene:
    scene = copy_of(site, tmp_path_factory.mktemp("scene"))
    execute("depth", scene, Depth(max_size=160))
    return scene


@pytest.fixture(scope="module")
def small(site, tmp_path_factory) -> Scene:
    """Depth of small photos, made without masks and without interruption."""
    scene = copy_of(site, tmp_path_factory.mktemp("small"))
    assert "sky_masks" not in execute("depth", scene, Depth(max_size=64))
    return scene


def copy_of(site: Scene, folder: Path) -> Scene:
    folder.mkdir(exist_ok=True)
    (folder / "images").symlink_to(site.images)
    shutil.copytree(site.path / "sparse", folder / "sparse")
    return Scene(folder)


def test_confirmed_depth_is_right(scene, site):
    errors, shares = [], []
    for view in scene.model.views:
        found = read_depth_map(depth_file(scene.depth, view.name))
        target = undistorted(view, max(found.depth.shape))
        true = np.load(site.path / "truth_depth" / f"{Path(view.name).stem}.npy")
        true = resample(true.astype(np.float32), view, target, labels=True)
        sure = (found.num_views >= 2) & (true > 0)
        errors.append(np.abs(found.depth / np.maximum(true, 1e-6) - 1)[sure])
        shares.append(sure.mean())
    errors = np.concatenate(errors)
    assert np.median(errors) < 0.002 and np.quantile(errors, 0.9) < 0.01
    assert np.mean(shares) > 0.5


def test_surface_from_depth_lies_on_the_true_one(scene, site):
    figures = execute("extract", scene, Extract(method="depth"))
    mesh = o3d.t.io.read_triangle_mesh(str(scene.mesh))
    true = o3d.t.io.read_triangle_mesh(str(site.path / "truth_mesh.ply"))
    rays = o3d.t.geometry.RaycastingScene()
    true.vertex.positions = true.vertex.positions.to(o3d.core.float32)
    rays.add_triangles(true)
    points = mesh.vertex.positions.to(o3d.core.float32)
    distance = rays.compute_distance(points).numpy() / figures["voxel_size"]
    assert np.quantile(distance, 0.9) < 2 and (distance > 5).mean() < 0.01
    assert len(points) > 5000 and scene.cloud.exists()


def test_second_run_is_up_to_date_and_previews_are_there(scene, caplog):
    with caplog.at_level("INFO"):
        execute("depth", scene, Depth(max_size=160))
    assert "up to date" in caplog.text
    assert len(list(scene.depth.glob("*.png"))) == len(list(scene.depth.glob("*.npz"))) == 8
    assert not list(scene.path.glob(".depth.*.parts"))


def test_an_interrupted_run_goes_on_and_gives_the_same(small, site, tmp_path, monkeypatch):
    again, calls = copy_of(site, tmp_path), []
    run_pass = multi_view.run_pass

    def dying(job, number, row):
        calls.append((number, row))
        if number == 1 and row == 3 and calls.count((1, 3)) == 1:
            raise KeyboardInterrupt
        run_pass(job, number, row)

    monkeypatch.setattr(multi_view, "run_pass", dying)
    with pytest.raises(KeyboardInterrupt):
        execute("depth", again, Depth(max_size=64))
    assert not again.depth.exists()
    kept = {file.name: file.stat().st_mtime_ns for file in again.path.glob(".depth.*.parts/passes/1-*.npy")}
    assert len(kept) == 3
    execute("depth", again, Depth(max_size=64))
    for view in small.model.views:
        one, other = (read_depth_map(depth_file(each.depth, view.name)) for each in (small, again))
        np.testing.assert_array_equal(one.depth, other.depth)
        np.testing.assert_array_equal(one.num_views, other.num_views)


def test_photos_that_see_no_sparse_points_are_named(site, tmp_path):
    scene = copy_of(site, tmp_path)
    model = pycolmap.Reconstruction(str(scene.sparse))
    image = next(iter(model.images.values()))
    for point in {p.point3D_id for p in image.points2D if p.has_point3D()}:
        model.delete_point3D(point)
    model.write_binary(str(scene.sparse))
    figures = execute("depth", scene, Depth(max_size=64))
    assert figures["left_out"] == [image.name] and figures["photos"] == 7


def test_what_is_missing_or_damaged_is_said(site, tmp_path):
    scene = copy_of(site, tmp_path)
    with pytest.raises(InputError, match="sc3d depth"):
        execute("extract", scene, Extract(method="depth"))
    file = tmp_path / "a.npz"
    write_depth_map(
        file, DepthMap(*(np.ones(shape, np.uint8) for shape in ((9, 9), (9, 9, 3), (9, 9), (9, 9))))
    )
    whole = file.read_bytes()
    for content in (b"nothing", whole[:200], whole[:-50], b""):
        file.write_bytes(content)
        for read in (read_depth_map, depth_map_size):
            with pytest.raises(InputError, match="damaged"):
                read(file)
    file.write_bytes(whole)
    with np.load(file) as found:
        before = {name: found[name] for name in ("depth", "normals", "num_views")}
    np.savez(file, **before)  # as the version before wrote them
    with pytest.raises(InputError, match="damaged .*sky.*: run `sc3d depth --overwrite`"):
        read_depth_map(file)
    with pytest.raises(InputError, match="at least 32"):
        Depth(max_size=3)


def test_without_any_confirmed_depth_the_command_fails_and_little_of_it_is_told(
    site, tmp_path, monkeypatch, caplog
):
    scene, shares = copy_of(site, tmp_path), [(0.0, 0.0, 0.4, 0.1)] * 8
    monkeypatch.setattr(depth, "estimate_depths", lambda job, tasks: shares)
    with pytest.raises(InputError, match="no depth of the 8 photos is confirmed"):
        execute("depth", scene, Depth(max_size=64))
    assert not scene.depth.exists()
    shares[3:] = [(0.6, 0.5, 0.8, 0.1)] * 5
    names = [view.name for view in scene.model.views]
    execute("depth", scene, Depth(max_size=64))
    assert f"3 of 8 photos have under 5% confirmed depth: {', '.join(names[:3])}" in caplog.text


CLASSES = [
    {"id": 1, "name": "ground", "color": [9, 9, 9]},
    {"id": 7, "name": "people", "color": [8, 8, 8], "surface": False},
]


def with_masks(site: Scene, folder: Path, classes: list[dict], photos: int = 7) -> Scene:
    """The site with masks: people in the middle, ground above, below nothing."""
    scene = copy_of(site, folder)
    scene.classes.write_text(json.dumps(classes))
    scene.masks.mkdir()
    for view in scene.model.views[:photos]:
        mask = np.zeros((view.height, view.width), np.uint8)
        mask[: view.height // 2] = 1
        mask[view.height // 3 : -view.height // 3, view.width // 3 : -view.width // 3] = 7
        write_image(scene.masks / f"{Path(view.name).stem}.png", mask)
    return scene


def test_what_masks_say_has_no_surface_is_sky(site, small, tmp_path, caplog):
    scene = with_masks(site, tmp_path / "masks", CLASSES)
    with caplog.at_level("INFO"):
        figures = execute("depth", scene, Depth(max_size=64))
    assert figures["sky_masks"] == "of 7 photos"
    assert f"1 of 8 photos have no mask in {scene.masks}" in caplog.text
    for row, view in enumerate(scene.model.views):
        found, before = (read_depth_map(depth_file(each.depth, view.name)) for each in (scene, small))
        if row == 7:
            np.testing.assert_array_equal(found.sky, before.sky)
            continue
        mask = scene.read_mask(scene.masks / f"{Path(view.name).stem}.png", view.name)
        told = resample(mask, view, undistorted(view, 64), labels=True)
        np.testing.assert_array_equal(found.sky, (told == 7) | before.sky & (told != 1))
        assert before.depth[told == 7].mean() > 10 and (before.num_views[told == 7] > 0).mean() > 0.3
        assert not found.depth[told == 7].any() and not found.num_views[told == 7].any()
        assert (found.depth[told == 1] > 0).mean() > 0.3
    assert execute("extract", scene, Extract(method="depth", crop=2))["cropped"].endswith(
        "fewer than 2 photos, is left out"
    )
    with pytest.raises(InputError, match="only 8 photos have a camera"):
        execute("extract", scene, Extract(method="depth", crop=9))


def test_masks_count_only_where_a_class_has_no_surface(site, tmp_path):
    scene = with_masks(site, tmp_path, [CLASSES[0], CLASSES[1] | {"surface": True}])
    always = [scene.images, scene.sparse]
    assert depth.inputs(scene, Depth()) == always
    given = Depth(sky_masks=tmp_path / "sky")
    assert depth.inputs(scene, given) == [*always, tmp_path / "sky", scene.classes]
    scene.classes.write_text(json.dumps(CLASSES))
    assert depth.inputs(scene, Depth()) == [*always, scene.masks, scene.classes]
    assert depth.inputs(scene, given) == [*always, tmp_path / "sky", scene.classes]
    assert depth.inputs(scene, Depth(ignore_masks=True)) == always
    shutil.rmtree(scene.masks)
    assert depth.inputs(scene, Depth()) == always
    scene.classes.unlink()
    assert depth.inputs(scene, given) == [*always, tmp_path / "sky"]


def test_given_masks_of_sky_are_used(site, tmp_path, monkeypatch):
    scene = copy_of(site, tmp_path)
    view, folder = scene.model.views[3], tmp_path / "sky"
    folder.mkdir()
    mask = np.zeros((view.height, view.width), np.uint8)
    mask[:, : view.width // 2] = 255
    write_image(folder / f"{Path(view.name).stem}.png", mask)
    told = {}

    def estimated(job, tasks):
        told.update({row: (job.told(row, SKY), job.told(row, SURFACE)) for row in range(8)})
        return [(0.5, 0.4, 0.6, 0.1)] * 8

    monkeypatch.setattr(depth, "estimate_depths", estimated)
    assert execute("depth", scene, Depth(max_size=64, sky_masks=folder))["sky_masks"] == "of 1 photos"
    assert [row for row in told if np.any(told[row])] == [3]
    sky, surface = told[3]
    assert sky[:, :31].all() and surface[:, 33:].all() and not (sky & surface).any()


def small_map() -> DepthMap:
    depth = np.arange(1, 7, dtype=np.float32).reshape(2, 3)
    counts = np.uint8([[0, 1, 2], [0, 3, 0]])
    normals = np.tile(np.int8([0, 0, -127]), (2, 3, 1))
    sky = np.zeros((2, 3), bool)
    depth[1, 2], sky[1, 2] = 0, True
    return DepthMap(depth, normals, counts, sky)


def test_depth_maps_tell_confirmed_from_continued_and_are_never_averaged(tmp_path):
    found = small_map()
    np.testing.assert_array_equal(found.confirmed(1), [[0, 2, 3], [0, 5, 0]])
    np.testing.assert_array_equal(found.confirmed(2), [[0, 0, 3], [0, 5, 0]])
    np.testing.assert_array_equal(found.continued, [[1, 0, 0], [4, 0, 0]])
    assert found.resized((2, 3)) is found
    for name, values in vars(found.resized((4, 6))).items():
        np.testing.assert_array_equal(values, vars(found)[name].repeat(2, axis=0).repeat(2, axis=1))
    one = found.resized((1, 1))
    assert one.depth.shape == (1, 1) and one.depth[0, 0] in found.depth
    nothing = DepthMap.nothing((4, 5))
    for each in (nothing.depth, nothing.confirmed(1), nothing.continued, nothing.sky):
        assert each.shape == (4, 5) and not each.any()
    write_depth_map(tmp_path / "a.npz", found)
    for name, values in vars(read_depth_map(tmp_path / "a.npz")).items():
        np.testing.assert_array_equal(values, vars(found)[name])
