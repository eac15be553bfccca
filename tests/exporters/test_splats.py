"""Labelled splats as files: what is on the ground gets the ground's class, and other programs read back what
was written.
"""

import json

import numpy as np
import open3d as o3d
import pytest
import torch

from sc3d.cli import main
from sc3d.exporters.splats import distance_to_class
from sc3d.geometry.cameras import local_origin
from sc3d.io.images import read_image
from sc3d.io.splats import origin_comment, read_splat_ply, write_splat_ply
from sc3d.runner import sidecar
from sc3d.scene.scene import Scene
from sc3d.splatting.dataset import load_gaussians
from sc3d.splatting.gaussians import Gaussians
from sc3d.view.display_splats import read_splats
from tests.builders import ORIGIN, views, write_bare_scene

pytestmark = pytest.mark.usefixtures("one_thread")

ROAD, GRASS = 1, 3
COLORS = {ROAD: (150, 150, 160), GRASS: (170, 220, 110)}


def run(*arguments) -> None:
    main([str(argument) for argument in arguments])


def site() -> Gaussians:
    """Opaque flat Gaussians on the ground of `scenes`, with random colors and odd quaternions, and 30 small
    floaters 6 m above it; local frame.
    """
    generator = torch.Generator().manual_seed(0)
    x, y = np.meshgrid(np.arange(-3.9, 4, 0.2), np.arange(-3.9, 4, 0.2))
    ground = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], 1)
    high = np.random.default_rng(0).uniform([-1, -1, 6], [1, 1, 6.5], (30, 3))
    means = torch.from_numpy(np.concatenate([ground, high]) + ORIGIN - local_origin(views())).float()
    count = len(means)
    scales = torch.tensor([0.13, 0.13, 2e-3]).log().repeat(count, 1) + 0.05 * torch.randn(
        count, 3, generator=generator
    )
    scales[len(ground) :] = np.log(0.03)
    quats = torch.tensor([1.0, 0, 0, 0]) + 0.02 * torch.randn(count, 4, generator=generator)
    logits = 4 + 0.5 * torch.randn(count, generator=generator)
    sh = 0.3 * torch.randn(count, 9, 3, generator=generator)
    return Gaussians(means, scales, 1.7 * quats, logits, sh[:, 0].clone(), sh[:, 1:].clone())


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    path = write_bare_scene(tmp_path_factory.mktemp("splats") / "scene")
    run("label", path)
    run("propagate", path)
    origin = local_origin(views())
    write_splat_ply(path / "gaussians.ply", site().arrays(), [origin_comment(origin)])
    run("export", path, "--format", "splats", "spz")
    return path


@pytest.fixture(scope="module")
def splats(scene):
    return read_splats(scene / "export" / "splats.ply", Scene(scene).class_table())


def world(gaussians: Gaussians) -> np.ndarray:
    return gaussians.means.numpy().astype(np.float64) + local_origin(views()) - ORIGIN


def test_splats_take_the_class_of_the_ground_and_floaters_none(splats):
    points = world(splats.gaussians)
    high = points[:, 2] > 1
    assert high.sum() == 30 and not splats.label[high].any() and not splats.confidence[high].any()
    clear = ~high & (np.abs(points[:, 0]) > 0.35) & (np.abs(points[:, :2]).max(axis=1) < 3.5)
    expected = np.where(points[:, 0] < 0, ROAD, GRASS)
    assert clear.sum() > 800 and (splats.label[clear] == expected[clear]).all()
    assert splats.confidence[clear].min() > 0.7 and np.median(splats.confidence[clear]) > 0.99


def test_a_gaussian_between_two_classes_is_less_sure(splats):
    points = world(splats.gaussians)
    inside = (np.abs(points[:, 1]) < 3.3) & (points[:, 2] < 1)
    border = inside & (np.abs(points[:, 0]) < 0.15)
    away = inside & (np.abs(points[:, 0]) > 0.8)
    assert splats.confidence[border].mean() < splats.confidence[away].mean() - 0.1


def test_ply_loses_nothing(scene, splats):
    for name, values in site().parameters().items():
        assert torch.equal(splats.gaussians.parameters()[name], values), name
    for name, values in load_gaussians(Scene(scene))[0].parameters().items():
        assert torch.equal(splats.gaussians.parameters()[name], values), name
    header = (scene / "export" / "splats.ply").read_bytes().partition(b"end_header")[0].decode()
    assert (
        "property uchar label" in header
        and "property float confidence" in header
        and "comment sc3d label 1 road" in header
    )
    np.testing.assert_array_equal(splats.origin, local_origin(views()))


def test_world_positions_keep_millimeters_at_utm_size(splats):
    expected = site().means.double().numpy() + local_origin(views())
    found = splats.gaussians.means.numpy().astype(np.float64) + splats.origin
    assert np.abs(found).max() > 5e6 and np.abs(found - expected).max() < 1e-3


def test_open3d_reads_labelled_splats(scene, splats):
    cloud = o3d.t.io.read_point_cloud(str(scene / "export" / "splats.ply")).point
    gaussians = splats.gaussians
    np.testing.assert_array_equal(cloud["label"].numpy().ravel(), splats.label)
    assert cloud["label"].dtype == o3d.core.uint8
    np.testing.assert_array_equal(cloud["confidence"].numpy().ravel(), splats.confidence)
    np.testing.assert_array_equal(cloud["positions"].numpy(), gaussians.means.numpy())
    np.testing.assert_array_equal(cloud["f_dc"].numpy(), gaussians.sh_dc.numpy())
    np.testing.assert_array_equal(cloud["f_rest"].numpy(), gaussians.sh_rest.numpy())
    np.testing.assert_array_equal(cloud["opacity"].numpy().ravel(), gaussians.opacity_logits.numpy())
    np.testing.assert_allclose(cloud["scale"].numpy(), gaussians.scales.numpy(), rtol=1e-6)
    np.testing.assert_array_equal(cloud["rot"].numpy(), gaussians.quats.numpy())


def test_spz_keeps_what_it_can_hold(scene, splats):
    cloud = o3d.t.io.read_point_cloud(str(scene / "export" / "splats.spz")).point
    gaussians = splats.gaussians
    assert np.abs(cloud["positions"].numpy() - gaussians.means.numpy()).max() <= 1 / 8192 + 1e-6
    assert np.abs(np.log(cloud["scale"].numpy()) - gaussians.log_scales.numpy()).max() <= 1 / 32 + 1e-5
    opacity = 1 / (1 + np.exp(-cloud["opacity"].numpy().ravel()))
    assert np.abs(opacity - gaussians.opacities.numpy()).max() <= 1 / 510 + 1e-6
    assert np.abs(cloud["f_dc"].numpy() - gaussians.sh_dc.numpy()).max() <= 1 / (2 * 255 * 0.15) + 1e-5
    rest = gaussians.sh_rest.numpy().clip(-1, 127 / 128)
    assert (
        np.abs(cloud["f_rest"].numpy() - rest).max() <= 17 / 256 + 1e-6
        and np.abs(cloud["f_rest"].numpy() - rest)[:, :3].max() <= 9 / 256 + 1e-6
    )
    unit = torch.nn.functional.normalize(gaussians.quats, dim=1).numpy()
    assert (1 - np.abs((cloud["rot"].numpy() * unit).sum(axis=1))).max() < 1e-5
    assert (scene / "export" / "splats.spz").stat().st_size < 0.25 * (
        scene / "export" / "splats.ply"
    ).stat().st_size


def test_only_the_chosen_classes_and_both_formats_alike(scene, tmp_path, splats):
    run("export", scene, "--format", "spz", "splats", "--classes", "grass")
    alone = (scene / "export" / "splats.spz").read_bytes()
    grass = read_splats(scene / "export" / "splats.ply", splats.table)
    kept = splats.label == GRASS
    assert 0 < kept.sum() < len(kept) and (grass.label == GRASS).all()
    assert torch.equal(grass.gaussians.means, splats.gaussians.means[torch.from_numpy(kept)])
    np.testing.assert_array_equal(grass.confidence, splats.confidence[kept])
    summary = json.loads(sidecar(scene / "export" / "splats.ply").read_text())["summary"]
    assert summary["splats_splats_by_class"] == {"grass": int(kept.sum())} and summary["spz_origin"] == list(
        local_origin(views())
    )
    run("export", scene, "--format", "splats", "spz", "--classes", "grass")  # SPZ now from the PLY
    assert (scene / "export" / "splats.spz").read_bytes() == alone
    run("export", scene, "--format", "splats", "spz")


def test_the_comment_says_where_the_origin_lies(scene):
    before = (scene / "export" / "splats.ply").read_bytes()
    run("export", scene, "--format", "splats", "--epsg", "32615")
    comments = read_splat_ply(scene / "export" / "splats.ply")[1]
    easting, northing, height = local_origin(views())
    assert f"sc3d EPSG:32615 origin {easting:.3f} {northing:.3f} {height:.3f}" in comments
    run("export", scene, "--format", "splats", "--overwrite")
    assert (scene / "export" / "splats.ply").read_bytes() == before  # a second run writes the same bytes
    run("export", scene, "--format", "splats", "spz")


def test_pictures_in_class_colors(scene, tmp_path):
    def picture(*options) -> np.ndarray:
        run(
            "view",
            scene,
            "--splats",
            "--screenshot",
            tmp_path / "a.png",
            "--size",
            320,
            240,
            "--from-above",
            *options,
        )
        return read_image(tmp_path / "a.png")[:240].astype(int)

    image = picture("--by", "label")
    for label, columns in ((ROAD, slice(90, 140)), (GRASS, slice(180, 230))):
        assert np.abs(np.median(image[80:160, columns].reshape(-1, 3), axis=0) - COLORS[label]).max() < 12
    assert np.abs(picture("--by", "photo") - image).mean() > 10
    sure = picture("--by", "confidence")[80:160, 90:140].reshape(-1, 3)
    assert np.median(sure, axis=0)[2] < 80 < np.median(sure, axis=0)[1]  # the yellow end of viridis


class TestBadInput:
    def check(self, capsys, words: list[str], *arguments: object) -> None:
        with pytest.raises(SystemExit) as stopped:
            run(*arguments)
        lines = [line for line in capsys.readouterr().err.strip().splitlines() if line.startswith("sc3d: ")]
        assert stopped.value.code == 2 and len(lines) == 1 and all(word in lines[0] for word in words), lines

    def test_classes_that_are_not_there(self, capsys, scene):
        before = (scene / "export" / "splats.ply").read_bytes()
        self.check(
            capsys,
            ["no class 'tree'", "road, grass"],
            "export",
            scene,
            "--format",
            "splats",
            "--classes",
            "tree",
        )
        assert (scene / "export" / "splats.ply").read_bytes() == before

    def test_missing_files(self, capsys, tmp_path):
        path = write_bare_scene(tmp_path / "scene")
        self.check(capsys, ["labelled.ply is missing", "propagate"], "export", path, "--format", "splats")
        run("label", path)
        self.check(
            capsys,
            ["gaussians.ply is missing", "train"],
            "export",
            path,
            "--format",
            "spz",
            "--labelled",
            path / "seeds.ply",
        )
        self.check(
            capsys,
            ["splats.ply is missing", "--format splats"],
            "view",
            path,
            "--splats",
            "--by",
            "confidence",
            "--screenshot",
            tmp_path / "a.png",
        )
        self.check(
            capsys,
            ["state", "confidence"],
            "view",
            path,
            "--splats",
            "--by",
            "state",
            "--screenshot",
            tmp_path / "a.png",
        )
        assert not (path / "export").exists()

    def test_a_cloud_without_labels(self, capsys, scene, tmp_path):
        cloud = o3d.t.io.read_point_cloud(str(scene / "labelled.ply"))
        cloud.point["label"] = o3d.core.Tensor(np.zeros((len(cloud.point.positions), 1), np.uint8))
        o3d.t.io.write_point_cloud(str(tmp_path / "bare.ply"), cloud)
        self.check(
            capsys,
            ["no splat shows a label", "bare.ply"],
            "export",
            scene,
            "--format",
            "splats",
            "--labelled",
            tmp_path / "bare.ply",
        )

    def test_splats_of_other_cameras_and_without_labels(self, capsys, scene, tmp_path, splats):
        written = scene / "export" / "splats.ply"
        before = written.read_bytes()
        view = ("view", scene, "--splats", "--screenshot", tmp_path / "a.png")
        try:
            written.write_bytes(before.replace(b"sc3d origin 5", b"sc3d origin 6"))
            self.check(capsys, ["other cameras", "--overwrite"], *view)
            written.write_bytes((scene / "gaussians.ply").read_bytes())
            self.check(capsys, ["no labels", "--format splats"], *view)
        finally:
            written.write_bytes(before)


def test_further_properties_are_written_behind_the_known_ones(tmp_path):
    gaussians = site()[torch.arange(7)]
    values = np.random.default_rng(0).random(7).astype("<f4")
    extra = {"label": np.arange(7, dtype=np.uint8) + 249, "sure": values}
    write_splat_ply(tmp_path / "a.ply", gaussians.arrays(), ["a comment", "end_header"], extra)
    cloud = o3d.t.io.read_point_cloud(str(tmp_path / "a.ply")).point
    assert cloud["label"].numpy().ravel().tolist() == [249, 250, 251, 252, 253, 254, 255]
    np.testing.assert_array_equal(cloud["sure"].numpy().ravel(), values)
    assert read_splat_ply(tmp_path / "a.ply")[1] == ["a comment", "end_header"]


def test_distance_to_class_equals_brute_force():
    random = np.random.default_rng(0)
    points, point_label = random.normal(size=(300, 3)) + ORIGIN, random.integers(0, 4, 300).astype(np.uint8)
    positions, label = random.normal(size=(50, 3)) + ORIGIN, random.integers(0, 6, 50).astype(np.uint8)
    found = distance_to_class(positions, label, points, point_label)
    for distance, position, own in zip(found, positions, label, strict=True):
        same = points[point_label == own]
        expected = 0 if own == 0 else np.linalg.norm(same - position, axis=1).min() if len(same) else np.inf
        assert distance == expected or abs(distance - expected) < 1e-4
