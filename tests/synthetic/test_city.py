"""The synthetic city: sites that meet, one at a time in memory, files that Open3D reads, masks that say what
the cloud says.
"""

from __future__ import annotations

import gc
import json
import weakref
from pathlib import Path

import numpy as np
import open3d as o3d
import pytest
from scipy.spatial import cKDTree

from sc3d.geometry.cameras import View, in_image, local_origin, pixel_centers, project
from sc3d.geometry.raycast import Surface, first_surface, surface_points
from sc3d.io.clouds import read_cloud, read_mesh
from sc3d.io.mask_images import read_index_image
from sc3d.scene.class_table import OTHER
from sc3d.scene.scene import Scene
from sc3d.settings.synthesize import SynthesizeCity
from sc3d.synthetic import city
from sc3d.synthetic.city_files import open_cloud, open_mesh
from sc3d.synthetic.city_flight import fly_over
from sc3d.synthetic.mesh import GRASS, ROAD
from tests.test_cli import fails as command_fails
from tools.benchmark.__main__ import main

EXTENT, SITES, POINTS = 60.0, (2, 1), 20_000
OPTIONS = ["--sites", "2", "1", "--points-per-site", str(POINTS), "--views", "4", "--width", "160"]


def fails(capsys, *arguments) -> str:
    return command_fails(capsys, *arguments, command=main)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A small city, and how many worlds were in memory after each was built."""
    path, worlds, alive = tmp_path_factory.mktemp("city") / "scene", [], []
    build = city.build_world

    def watched(*args, **kwargs):
        world = build(*args, **kwargs)
        worlds.append(weakref.ref(world))
        gc.collect()
        alive.append(sum(kept() is not None for kept in worlds))
        return world

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(city, "EXTENT", EXTENT)
        patch.setattr(city, "build_world", watched)
        main(["city", str(path), *OPTIONS])
    return Scene(path), alive


@pytest.fixture(scope="module")
def surface(made):
    scene, _ = made
    mesh = read_mesh(scene.mesh)
    return Surface.from_mesh(mesh.vertex.positions.numpy(), mesh.triangle.indices.numpy(), city.OFFSET)


def truth_of(scene: Scene, view: View) -> np.ndarray:
    return read_index_image(scene.truth / f"{Path(view.name).stem}.png")


def test_cloud_and_mesh(made):
    scene, _ = made
    cloud, mesh, record = (
        read_cloud(scene.cloud),
        read_mesh(scene.mesh),
        json.loads((scene.path / "city.json").read_text()),
    )
    points, middle = cloud.point.positions.numpy(), city.OFFSET
    assert (
        len(points) == SITES[0] * SITES[1] * POINTS == record["points"]
        and len(mesh.triangle.indices) == record["triangles"] > 20_000
    )
    assert {name: str(cloud.point[name].dtype) for name in cloud.point} == {
        "positions": "Float64",
        "normals": "Float32",
        "colors": "UInt8",
        "label": "UInt8",
        "instance": "Int32",
    }
    instance, east = cloud.point["instance"].numpy().ravel(), points[:, 0] > middle[0]
    assert not set(instance[east & (instance > 0)]) & set(instance[~east & (instance > 0)])  # each its own
    assert mesh.vertex.positions.dtype == o3d.core.float64 and np.array_equal(
        mesh.triangle.indices.numpy().ravel(), np.arange(3 * record["triangles"])
    )
    assert (np.abs(points[:, :2] - middle[:2]) <= [60, 30]).all()
    assert (np.ptp(points[:, :2], axis=0) > [119, 59]).all() and np.allclose(
        np.linalg.norm(cloud.point.normals.numpy(), axis=1), 1, atol=1e-5
    )
    left = points[:, 0] < middle[0]
    assert left.sum() == POINTS and set(np.unique(cloud.point.label.numpy())) == {1, 2, 3, 4, OTHER}
    assert not np.allclose(points[left][:100, 2], points[~left][:100, 2])  # each site has a seed of its own


def test_header_is_that_of_open3d(made, tmp_path):
    scene, _ = made
    o3d.t.io.write_point_cloud(str(tmp_path / "again.ply"), read_cloud(scene.cloud))
    again, own = (tmp_path / "again.ply").read_bytes(), scene.cloud.read_bytes()
    parts = [
        [line for line in file.partition(b"end_header\n")[0].splitlines() if not line.startswith(b"comment")]
        for file in (again, own)
    ]
    assert parts[0] == parts[1] and again.partition(b"end_header\n")[2] == own.partition(b"end_header\n")[2]


def test_points_lie_on_the_mesh(made, surface):
    scene, _ = made
    points = read_cloud(scene.cloud).point.positions.numpy() - city.OFFSET
    distance = surface.scene.compute_distance(o3d.core.Tensor(points.astype(np.float32))).numpy()
    assert np.quantile(distance, 0.999) < 1e-3


def test_every_truth_mask_agrees_with_the_cloud(made, surface):
    """At points in the middle of a pixel and on its first surface, and for all pixels with the nearest point."""
    scene, _ = made
    cloud = read_cloud(scene.cloud)
    points, label = cloud.point.positions.numpy(), cloud.point.label.numpy().ravel()
    tree, checked = cKDTree(points - city.OFFSET), []
    for view in scene.model.views:
        truth, first = truth_of(scene, view), first_surface(surface, view)
        rows, columns = np.nonzero(np.isfinite(first.range))
        assert len(rows) > 2000 and (truth[~np.isfinite(first.range)] == OTHER).mean() > 0.999
        near, nearest = tree.query(surface_points(first, view, rows, columns) - city.OFFSET)
        assert (label[nearest] == truth[rows, columns])[near < 0.2].mean() > 0.97
        pixels, _ = project(view, points)
        inside = np.flatnonzero(in_image(view, pixels))
        cell = pixels[inside].astype(int)
        central = np.abs(pixels[inside] - cell - 0.5).max(1) < 0.1
        seen = (
            np.abs(np.linalg.norm(points[inside] - view.center, axis=1) - first.range[cell[:, 1], cell[:, 0]])
            < 0.3
        )
        rows = inside[central & seen]
        checked.append(len(rows))
        assert (label[rows] == truth[cell[central & seen, 1], cell[central & seen, 0]]).mean() > 0.97, (
            view.name
        )
    assert min(checked) > 100


def test_sites_meet(made, surface):
    """Straight down beside the seam: no hole, and no step in grass and roads."""
    scene, _ = made
    cloud = read_cloud(scene.cloud)
    y = np.linspace(-29.5, 29.5, 400)
    heights = []
    for x in (-0.02, 0.0, 0.02):
        rays = np.zeros((len(y), 6), np.float32)
        rays[:, 0], rays[:, 1], rays[:, 2], rays[:, 5] = x, y, 100, -1
        heights.append(100 - surface.scene.cast_rays(o3d.core.Tensor(rays))["t_hit"].numpy())
    assert np.isfinite(heights).all()
    points, label = cloud.point.positions.numpy() - city.OFFSET, cloud.point.label.numpy().ravel()
    flat = np.isin(label, (ROAD, GRASS))
    clear = cKDTree(points[~flat, :2]).query(np.c_[np.zeros_like(y), y])[0] > 1.0
    assert clear.sum() > 200 and np.abs(heights[0] - heights[2])[clear].max() < 0.02
    assert np.ptp(points[flat, 2]) > 1.0  # although there are hills


def test_one_site_at_a_time(made):
    _, alive = made
    assert alive[:2] == [1, 2] and max(alive) == 2  # the last one is there while the next is built


def test_sites_are_built_when_asked_for(monkeypatch):
    built = []
    monkeypatch.setattr(city, "build_world", lambda settings, level_edges: built.append(settings.seed))
    sites = city.make_sites(SynthesizeCity(Path("x"), sites=(3, 2), seed=4))
    first = next(sites)
    assert built == [4000] and np.allclose(first.middle, [-120, -60, 0])
    assert [site.number for site in sites] == [1, 2, 3, 4, 5] and built == [
        4000 + number for number in range(6)
    ]


def test_masks_err_and_flight_covers_the_city(made):
    scene, _ = made
    views = scene.model.views
    assert [view.name for view in views] == [f"view_{i:03d}.jpg" for i in range(4)] and {
        (view.width, view.height) for view in views
    } == {(160, 107)}
    assert 0.6 < json.loads((scene.path / "city.json").read_text())["mask_accuracy"] < 0.9
    assert (
        len(scene.mask_files(scene.masks, scene.class_table()))
        == len(scene.mask_files(scene.confidence))
        == 4
    )
    assert np.abs(local_origin(views)[:2] - city.OFFSET[:2]).max() < 150
    flown = fly_over((720.0, 600.0), SynthesizeCity(Path("x")))
    ground = pixel_centers(72, 60) * 10 - [360, 300]
    seen = sum(
        in_image(view, project(view, np.c_[ground, np.zeros(len(ground))])[0]).astype(int) for view in flown
    )
    assert len(flown) == 200 and seen.min() >= 3 and 7 < np.median(seen) < 25


def test_unfinished_files_get_no_name(tmp_path):
    with pytest.raises(ValueError, match="0 records instead of 5"), open_cloud(tmp_path / "cloud.ply", 5):
        pass
    with pytest.raises(KeyError), open_mesh(tmp_path / "mesh.ply"):
        raise KeyError
    assert not list(tmp_path.iterdir())


def test_bad_input(tmp_path, capsys):
    assert "choose a new or empty folder" in fails(capsys, "city", tmp_path.parent)
    assert "at least 1" in fails(capsys, "city", tmp_path / "new", "--sites", "0", "2")
    assert not (tmp_path / "new").exists()
