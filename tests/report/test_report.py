"""The report shows what the files say, leaves out what is missing, and needs nothing but itself."""

from __future__ import annotations

import base64
import json
import re
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np
import open3d as o3d
import pycolmap
import pytest

from sc3d.errors import InputError, Sc3dError
from sc3d.geometry.cameras import View, look_at
from sc3d.geometry.raycast import Surface, first_surface, surface_points
from sc3d.io.clouds import write_geometry
from sc3d.io.images import write_image
from sc3d.io.json_files import write_json
from sc3d.report import write_report
from sc3d.report.charts import flight_map, histogram, paired_bars, reliability_curve
from sc3d.report.data import ReportData, load_report_data
from sc3d.report.images import comparison, ground_picture
from sc3d.report.sections import (
    certainty_section,
    found_section,
    headline,
    processing_section,
    quality_section,
    summary_line,
)
from sc3d.report.tally import class_areas, distribution
from sc3d.runner import execute
from sc3d.scene.labelled_cloud import LabelledSurface
from sc3d.scene.scene import Scene
from sc3d.settings.outputs import Report
from tests.builders import labelled_scene

UTM = np.array([500_000.0, 4_500_000.0, 100.0])
GRASS, BUILDING = 1, 2
EVIL = "<script>alert(1)</script>"
VOID = {"meta", "img"}


class Page(HTMLParser):
    """Checks that tags are nested, and collects sources, links and texts."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open, self.sources, self.tags, self.text = [], [], [], []
        self.feed(text)
        assert not self.open, self.open

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.sources += [value for name, value in attrs if name in ("src", "href", "srcset", "action")]
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append(tag)
        self.sources += [value for name, value in attrs if name in ("src", "href")]

    def handle_endtag(self, tag):
        assert self.open and self.open[-1] == tag, (tag, self.open)
        self.open.pop()

    def handle_data(self, data):
        self.text.append(data)


def decode(data: str, flags: int = cv2.IMREAD_COLOR) -> np.ndarray:
    return cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), flags)


def make_box() -> o3d.t.geometry.TriangleMesh:
    """A 40 x 30 m ground with a box of 10 x 8 x 6 m in its middle."""
    ground = o3d.geometry.TriangleMesh.create_box(40, 30, 0.01).translate([-20, -15, -0.01])
    box = o3d.geometry.TriangleMesh.create_box(10, 8, 6).translate([-5, -4, 0])
    mesh = (ground + box).translate(UTM)
    mesh.paint_uniform_color([0.5, 0.6, 0.4])
    return o3d.t.geometry.TriangleMesh.from_legacy(mesh, o3d.core.float64)


def make_views() -> list[View]:
    camera = pycolmap.Camera(
        model="SIMPLE_RADIAL", width=160, height=120, params=[140, 80, 60, 0.02], camera_id=1
    )
    centers = [(-12, -12, 35), (12, -12, 35), (12, 12, 35), (-12, 12, 35)]
    return [
        View(f"view{number}.jpg", camera, look_at(UTM + center, UTM)) for number, center in enumerate(centers)
    ]


def label_points(points: np.ndarray) -> np.ndarray:
    local = points - UTM
    return np.where((np.abs(local[..., 0]) < 5.01) & (np.abs(local[..., 1]) < 4.01), BUILDING, GRASS).astype(
        np.uint8
    )


def write_model(path: Path, views: list[View]) -> None:
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(views[0].camera)
    for number, view in enumerate(views, start=1):
        model.add_image_with_trivial_frame(
            pycolmap.Image(name=view.name, camera_id=1, image_id=number),
            pycolmap.Rigid3d(view.cam_from_world[:3]),
        )
    path.mkdir(parents=True)
    model.write(str(path))


def make_cloud(mesh: o3d.t.geometry.TriangleMesh) -> o3d.t.geometry.PointCloud:
    local = mesh.to_legacy().translate(-UTM)
    o3d.utility.random.seed(0)
    sampled = local.sample_points_uniformly(8000)
    points, rng = np.asarray(sampled.points) + UTM, np.random.default_rng(0)
    cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor(points))
    label = label_points(points)
    colors = np.where(label[:, None] == BUILDING, np.uint8([190, 90, 80]), np.uint8([110, 140, 80])).astype(
        np.uint8
    )
    attributes = {
        "colors": colors,
        "normals": np.tile(np.float32([0, 0, 1]), (8000, 1)),
        "label": label[:, None],
        "confidence": rng.uniform(0.4, 1, (8000, 1)).astype(np.float32),
        "state": rng.choice(5, (8000, 1), p=[0.1, 0.6, 0.1, 0.15, 0.05]).astype(np.uint8),
        "num_views": np.full((8000, 1), 3, np.int32),
    }
    for name, values in attributes.items():
        cloud.point[name] = o3d.core.Tensor(np.ascontiguousarray(values))
    return cloud


@pytest.fixture(scope="module")
def toy(tmp_path_factory) -> Scene:
    """A complete small scene at UTM coordinates."""
    scene = Scene(tmp_path_factory.mktemp("scenes") / "A&B <toy>")
    views, mesh = make_views(), make_box()
    write_model(scene.sparse, views)
    surface = Surface.from_mesh(mesh.vertex.positions.numpy(), mesh.triangle.indices.numpy(), UTM)
    for view in views:
        first = first_surface(surface, view)
        rows, columns = np.nonzero(np.isfinite(first.range))
        truth = np.zeros(first.range.shape, np.uint8)
        truth[rows, columns] = label_points(surface_points(first, view, rows, columns))
        mask = truth.copy()
        mask[:40, :40] = 0
        write_image(scene.truth / f"{Path(view.name).stem}.png", truth)
        write_image(scene.masks / f"{Path(view.name).stem}.png", mask)
        write_image(scene.photo(view.name), np.uint8([[0, 0, 0], [110, 140, 80], [190, 90, 80]])[truth])
    write_json(
        scene.classes,
        [
            {"id": 1, "name": "grass", "color": [124, 179, 66]},
            {"id": 2, "name": EVIL, "color": [214, 60, 60]},
        ],
    )
    write_geometry(scene.mesh, mesh)
    write_geometry(scene.labelled, make_cloud(mesh))
    figures = {
        "oa": 0.93125,
        "miou": 0.871,
        "iou": {"grass": 0.95, EVIL: 0.792},
        "coverage": 0.9876,
        "confusion": [[0, 900, 50], [10, 60, 700]],
    }
    masks = figures | {"oa": 0.81, "miou": 0.7, "iou": {"grass": 0.8, EVIL: float("nan")}}
    believed = {"ece": 0.0321, "bins": [None] * 7 + [[0.75, 0.5, 200], [0.85, 0.9, 200], [0.97, 1.0, 600]]}
    write_json(
        scene.metrics,
        {
            "photos": [view.name for view in views],
            "classes": ["grass", EVIL],
            "labels": figures,
            "masks": masks,
            "reliability": believed,
        },
    )
    record = {
        "stage": "label",
        "settings": {"method": EVIL, "consensus": 0.8},
        "versions": {"open3d": "0.20.0"},
        "seconds": 12.34,
        "peak_memory_mb": 2345,
        "summary": {"points": 8000, "note": EVIL},
        "inputs": {"masks": "abc123"},
    }
    for name in ("seeds.ply.json", "votes.npz.json"):
        write_json(scene.path / name, record)
    write_json(scene.path / "sparse" / "0.json", record | {"stage": "reconstruct", "seconds": 3.0})
    return scene


@pytest.fixture(scope="module")
def page(toy) -> str:
    write_report(toy, toy.report)
    return toy.report.read_text(encoding="utf-8")


def test_page_is_well_formed_and_self_contained(page):
    parsed = Page(page)
    assert parsed.sources
    assert all(source.startswith(("data:image/", "#")) for source in parsed.sources)
    assert not re.search(r"https?://|@import|url\(", page)
    assert {source[1:] for source in parsed.sources if source.startswith("#")} == set(
        re.findall(r'<section id="(\w+)"', page)
    )


def test_text_from_files_is_escaped(page):
    assert EVIL not in page
    assert page.count("<script") == 1
    assert "&lt;script&gt;alert(1)&lt;/script&gt;" in page
    assert "<title>A&amp;B &lt;toy&gt;</title>" in page


def test_all_sections_and_figures_are_there(page):
    assert re.findall(r'<section id="(\w+)"', page) == [
        "cloud",
        "found",
        "quality",
        "photos",
        "certainty",
        "flight",
        "processing",
    ]
    text = " ".join(Page(page).text)
    for figure in (
        "93.1%",
        "given masks 81.0%",
        "0.871",
        "98.8%",
        "8,000 points",
        "4 photos",
        "0.950",
        "0.792",
        "12.3",
        "2,345",
        "abc123",
        "0.20.0",
        "error 0.032",
    ):
        assert figure in text, figure
    assert "nan" not in text.lower().replace("alert", "")


def test_images_decode_and_show_the_scene(page):
    images = [decode(data) for data in re.findall(r'<img[^>]* src="data:image/\w+;base64,([^"]+)"', page)]
    assert len(images) == 2 * 5 + 4 * 4  # four colorings and the mesh, twice; four panels of four photos
    assert all(image is not None and image.std() > 3 for image in images)
    labels_from_above = images[1]
    height, width = labels_from_above.shape[:2]
    middle = labels_from_above[height // 2, width // 2, ::-1].astype(int)
    assert middle[0] > 2.5 * middle[1:].max()  # the red building, possibly shaded


def test_fused_labels_match_the_truth_in_the_photo(toy):
    data = load_report_data(toy)
    view = data.views[0]
    labelled = LabelledSurface.build(data.cloud, data.views, toy.surface)
    panels = dict(comparison(data, view, labelled))
    assert list(panels) == ["photo", "given mask", "fused labels", "truth"]
    fused, truth = (decode(panels[name].split(",")[1]) for name in ("fused labels", "truth"))
    assert (fused == truth).all(axis=2).mean() > 0.95


def test_same_stage_run_counts_once(toy):
    records = load_report_data(toy).records
    assert [record["stage"] for record in records] == ["reconstruct", "label"]
    assert records[1]["outputs"] == ["seeds.ply", "votes.npz"]


def test_missing_parts_are_left_out(tmp_path):
    scene = Scene(tmp_path / "bare")
    scene.path.mkdir()
    write_report(scene, scene.report)
    page = scene.report.read_text(encoding="utf-8")
    Page(page)
    assert "<section" not in page and "An empty scene" in page

    write_model(scene.sparse, make_views())
    write_report(scene, scene.report)
    page = scene.report.read_text(encoding="utf-8")
    assert re.findall(r'<section id="(\w+)"', page) == ["flight"]
    assert "%" not in " ".join(Page(page).text).split("looks.")[1]


def test_training_sheet_is_shown(tmp_path):
    sheet = np.random.default_rng(0).integers(0, 255, (60, 160, 3)).astype(np.uint8)
    write_image(tmp_path / "train.jpg", cv2.blur(sheet, (9, 9)))
    write_report(Scene(tmp_path), tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text()
    Page(page)
    assert re.findall(r'<section id="(\w+)"', page) == ["training"]
    data, text = re.search(r'<img src="data:image/jpeg;base64,([^"]+)" alt="([^"]+)"', page).groups()
    assert (
        np.abs(decode(data).astype(int) - cv2.imread(str(tmp_path / "train.jpg"))).mean() < 5
        and "depth and normals" in text
    )
    (tmp_path / "train.jpg").write_bytes(b"nonsense")
    with pytest.raises(InputError, match="train.jpg"):
        write_report(Scene(tmp_path), tmp_path / "report.html")


def test_held_out_photos_have_a_row_for_each_kind(tmp_path):
    summary = {"held_out_photos": 3, "held_out_psnr": 21.456, "held_out_seen": 0.98765}
    summary |= {"held_out_sector_photos": 8, "held_out_sector_psnr": 17.0, "held_out_sector_seen_depth": 0.5}
    record = {"stage": "train", "settings": {"test_every": 8, "test_sector": 0.2}, "summary": summary}
    for chosen, expected in ((summary, 2), ({"held_out_photos": 3}, 1), ({"psnr": 20}, 0), ("broken", 0)):
        write_json(tmp_path / "gaussians.ply.json", record | {"summary": chosen})
        write_report(Scene(tmp_path), tmp_path / "report.html")
        text = " ".join(Page((tmp_path / "report.html").read_text()).text)
        assert ("one of every 8" in text) + ("a sector of 20%" in text) == expected
        if expected == 2:
            for name, row in (
                ("one of every 8", ["3", "21.46", "–", "98.8%", "–", "–", "–"]),
                ("a sector of 20%", ["8", "17.00", "–", "–", "–", "–", "50.0%"]),
            ):
                assert text.split(name)[1].split()[:7] == row


def test_labels_without_truth_give_no_accuracy(toy, tmp_path):
    scene = Scene(tmp_path)
    for path in (toy.labelled, toy.classes):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    data = load_report_data(scene)
    assert "accuracy" not in headline(data).lower() and "IoU" not in headline(data)
    assert "100.0%" in headline(data)
    assert quality_section(data) == "" and processing_section(data) == ""
    assert "IoU" not in found_section(data) and "8,000 points in 2 classes." in summary_line(data)
    assert "seed" in certainty_section(data)


@pytest.mark.parametrize(
    ("counts", "told"),
    [
        ({"pixels": 2000, "right": 1950}, "nothing is hit: &lt;sky&gt; 97.5% of 2,000 pixels."),
        ({"pixels": 0, "right": 0}, ""),
        ({"pixels": "many"}, ""),
        ([1], ""),
    ],
)
def test_truth_without_surface_is_told_of(tmp_path, counts, told):
    metrics = {"labels": {"iou": {"grass": 0.5}}, "without_surface": {"<sky>": counts}}
    write_json(tmp_path / "metrics.json", metrics)
    section = quality_section(load_report_data(Scene(tmp_path)))
    assert "nothing is hit" in section and told in section if told else "nothing is hit" not in section


def without_pictures(monkeypatch) -> None:
    """No page gets pictures of the cloud, which take the longest."""

    def fail(*_):
        raise Sc3dError("no renderer")

    monkeypatch.setattr("sc3d.report.images.draw_points", fail)


def test_page_is_made_again_when_objects_were_exported_since(toy, tmp_path, monkeypatch):
    without_pictures(monkeypatch)
    scene = Scene(tmp_path)
    for path in (toy.labelled, toy.classes):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    execute("report", scene, Report())
    scene.report.unlink()
    scene.report.write_text("finished")
    execute("report", scene, Report())
    assert scene.report.read_text() == "finished"  # up to date
    scene.export.mkdir()
    (scene.export / "buildings.geojson").write_text('{"type": "FeatureCollection", "features": []}')
    execute("report", scene, Report())
    assert "<html" in scene.report.read_text(encoding="utf-8")


def test_scene_that_does_not_exist(tmp_path):
    with pytest.raises(InputError, match="does not exist"):
        write_report(Scene(tmp_path / "nowhere"), tmp_path / "report.html")
    assert not (tmp_path / "report.html").exists()


@pytest.mark.parametrize("content", ["{", "[1, 2]"])
def test_broken_metrics_are_an_input_error(tmp_path, content):
    (tmp_path / "metrics.json").write_text(content)
    with pytest.raises(InputError, match="metrics.json"):
        write_report(Scene(tmp_path), tmp_path / "report.html")


@pytest.mark.parametrize(
    "metrics",
    [
        {},
        {"labels": None},
        {"labels": {"oa": "high", "iou": [1], "confusion": "x"}},
        {"photos": 3, "labels": {"oa": True}},
        {"labels": {"iou": {"a": None}, "confusion": [[1], [2, 3]]}, "per_photo": [1]},
        {"reliability": {"bins": [[1, 2], None]}},
        {"reliability": {"ece": EVIL, "bins": [["x", None, EVIL]]}},
        {"reliability": {"bins": [None]}},
    ],
)
def test_odd_metrics_do_not_fail(tmp_path, metrics):
    write_json(tmp_path / "metrics.json", metrics)
    (tmp_path / "broken.ply.json").write_text("{")
    write_json(
        tmp_path / "odd.ply.json",
        {"stage": "x", "settings": [1, EVIL], "versions": None, "seconds": "long", "summary": 3},
    )
    write_report(Scene(tmp_path), tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text()
    Page(page)
    assert EVIL not in page and "Overall accuracy" not in page


def test_bars_are_as_long_as_their_values():
    chart = paired_bars([("tree", (0, 128, 0), 0.25, 0.5), ("road", (9, 9, 9), None, 2.0)])
    assert re.findall(r'<rect[^>]*width="([\d.]+)%"', chart) == ["100", "25.00", "50.00", "100", "100.00"]
    assert "0.250" in chart and "masks 0.500" in chart and "None" not in chart


def test_histogram_counts_every_value_once():
    chart = histogram(distribution(np.array([0.0, 0.05, 0.95, 1.0, np.nan]), 10), np.zeros((10, 3), np.uint8))
    assert re.findall(r": ([\d.]+)%</title>", chart) == ["60.0", *["0.0"] * 8, "40.0"]


def test_reliability_curve_has_its_dots_where_the_figures_say():
    chart = reliability_curve([(None, None, 0.0), (0.4, 0.25, 0.1), (0.6, 0.5, 0.3), (0.9, 1.0, 0.6)])
    places = np.array(re.findall(r'cx="([\d.]+)%" cy="([\d.]+)"', chart), float)
    assert np.allclose(places[:, 0], [40, 60, 90]) and np.allclose(
        1 - places[:, 1] / 190, [0.25, 0.5, 1.0], atol=1e-3
    )
    bars = np.array(re.findall(r'class="track" x="([\d.]+)%"[^>]*height="([\d.]+)"', chart), float)
    assert (
        np.allclose(bars[:, 1] / bars[-1, 1], [1 / 6, 0.5, 1], atol=0.01)
        and (np.diff(bars[:, 0]) == 25).all()
    )
    assert reliability_curve([(None, None, None)]).count("circle") == 0


def test_flight_map_has_north_up_and_east_right():
    centers = np.array([[0.0, 0], [100, 0], [0, 50]]) + UTM[:2]
    chart = flight_map(centers, np.zeros((3, 2)), ["a", "b", EVIL], None)
    places = np.array(re.findall(r'cx="([\d.]+)" cy="([\d.]+)"', chart), float)
    assert places[1, 0] > places[0, 0] and places[2, 1] < places[0, 1]
    pixels_per_meter = (places[1, 0] - places[0, 0]) / 100
    length = float(re.search(r"v6h([\d.]+)v-6", chart)[1])
    assert np.isclose(length / pixels_per_meter, float(re.search(r">(\d+) m<", chart)[1]), rtol=0.01)
    assert EVIL not in chart


def test_ground_picture_lies_where_the_points_are():
    grid = np.stack(np.meshgrid(np.linspace(0, 40, 200), np.linspace(0, 20, 100)), axis=-1).reshape(-1, 2)
    points = np.c_[grid, np.zeros(len(grid))] + UTM
    # red in the north-east
    colors = np.where(
        grid[:, :1] + 2 * grid[:, 1:] > 70, np.uint8([255, 0, 0]), np.uint8([0, 0, 255])
    ).astype(np.uint8)
    uri, (x_low, y_low, x_high, y_high) = ground_picture(points, colors)
    picture = decode(uri.split(",")[1], cv2.IMREAD_UNCHANGED)
    assert np.allclose([x_low, y_low, x_high, y_high], [UTM[0], UTM[1], UTM[0] + 40, UTM[1] + 20], atol=1)
    assert picture[3, -4, 2] == 255 and picture[-4, 3, 0] == 255 and picture[3, 3, 0] == 255
    assert (picture[..., 3] == 255).mean() > 0.97


def test_no_renderer_leaves_out_the_pictures(toy, tmp_path, monkeypatch):
    without_pictures(monkeypatch)
    write_report(toy, tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text()
    assert '<section id="cloud"' not in page and '<section id="photos"' in page


def test_sidecar_floats_and_paths_are_readable(toy):
    assert json.dumps(load_report_data(toy).records[1]["settings"])
    assert "<dd>0.8</dd>" in processing_section(load_report_data(toy))


def test_areas_are_those_of_the_highest_surface():
    x, y = np.meshgrid(np.arange(0, 40, 0.25), np.arange(0, 20, 0.25))
    ground = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    roof = ground[(ground[:, 0] < 10) & (ground[:, 1] < 10)] + [0, 0, 5]
    points, labels = np.concatenate([ground, roof]), np.repeat(np.uint8([3, 1]), [len(ground), len(roof)])
    areas = class_areas(points + [500000, 5200000, 0], labels)
    assert (
        areas[1] == pytest.approx(100, rel=0.06)
        and areas[3] == pytest.approx(700, rel=0.06)
        and areas.sum() == pytest.approx(800, rel=0.06)
    )


def test_counted_objects_are_in_the_report(tmp_path):
    (tmp_path / "export").mkdir()
    features = [
        {"type": "Feature", "properties": {"area_m2": area, "height_m": height}, "geometry": None}
        for area, height in ((100, 4), (60, 6), (20, 9))
    ]
    (tmp_path / "export" / "trees_local.geojson").write_text(
        json.dumps({"type": "FeatureCollection", "features": features})
    )
    (tmp_path / "export" / "buildings.geojson").write_text("[1]")
    table = found_section(ReportData(Scene(tmp_path)))
    assert "buildings" not in table and all(
        f"<td>{value}</td>" in table for value in ("3", "180", "60", "6.0", "9.0")
    )


def test_objects_are_listed_one_by_one_the_largest_first(tmp_path):
    scene = labelled_scene(tmp_path / "scene")
    scene.export.mkdir()
    rows = [
        {"id": number, "class": "a < b", "area_m2": float(number), "height_m": 4.25, "volume_m3": 1234.5}
        for number in range(1, 46)
    ]
    features = [{"properties": row | {"confidence": 0.5, "best_photo": "photo_0.jpg"}} for row in rows]
    (scene.export / "objects_local.geojson").write_text(json.dumps({"features": features}))
    page = found_section(load_report_data(scene))
    assert "The 40 largest of 45" in page and "a &lt; b" in page and "1,234" in page
    assert page.index(">45.0<") < page.index(">44.0<") < page.index(">6.0<") and ">5.0<" not in page
    (scene.export / "objects_local.geojson").write_text(json.dumps({"features": []}))
    assert "One by one" not in found_section(load_report_data(scene))
