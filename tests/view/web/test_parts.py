"""The parts of the page in the browser, without a browser: poses, layers, texts, pictures, options, and who
can reach it.
"""

from __future__ import annotations

import logging
import re
import signal
import socket
import struct
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import open3d as o3d
import pytest

from sc3d.cli import main
from sc3d.errors import MissingPackageError
from sc3d.geometry.cameras import look_at, pinhole_view
from sc3d.scene.class_table import parse_classes
from sc3d.scene.scene import Scene
from sc3d.view.display_cloud import DisplayCloud
from sc3d.view.picking import PickedPoint
from sc3d.view.web.layers import CameraLayer, CloudLayer, half_precision, node_name
from sc3d.view.web.orbit_camera import OrbitCamera, orientation
from sc3d.view.web.panel import legend_html, point_html
from sc3d.view.web.photos import overlay, photo_pictures, thumbnail
from tests.builders import CLASSES, ORIGIN, inspector_of, labelled_scene, truth_mask, views

ROAD = CLASSES[0]["color"]
linux = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc/net/tcp")


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return labelled_scene(tmp_path_factory.mktemp("web") / "scene")


@contextmanager
def layer_server() -> Iterator[object]:
    pytest.importorskip("viser", reason="the viewer in the browser needs viser: pip install 'sc3d[web]'")
    from sc3d.view.web import page as web

    with web._server("127.0.0.1", 0) as server:
        yield server


def test_pose_is_that_of_the_view():
    middle = np.array([2.0, 1.0, 0.0])
    view = pinhole_view("a", (400, 300), (500, 500, 200, 150), look_at(np.array([5.0, -30, 20]), middle))
    pose = OrbitCamera.from_view(view, middle, upright=True)
    assert (
        np.allclose(pose.position, [5, -30, 20])
        and np.allclose(pose.look_at, middle)
        and np.allclose(pose.up, [0, 0, 1])
    )
    assert np.isclose(np.tan(pose.fov / 2), 150 / 500)
    assert OrbitCamera.from_view(view, middle, upright=False).up @ [0, 0, 1] > 0.5  # the top of the photo
    down = pinhole_view("b", (400, 300), (500, 500, 200, 150), look_at(np.array([0.0, 0, 20]), np.zeros(3)))
    assert np.allclose(OrbitCamera.from_view(down, np.zeros(3), upright=True).up, [0, 1, 0])
    turned = orientation(view)  # wxyz
    w, x, y, z = turned
    assert np.allclose(
        [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)],
        (middle - pose.position) / np.linalg.norm(middle - pose.position),
    )


def test_covariances_fit_into_half_precision():
    rng = np.random.default_rng(0)
    axes = np.linalg.qr(rng.normal(size=(500, 3, 3)))[0] * (1e-3 * 10 ** rng.uniform(-1, 1, (500, 1, 3)))
    covariances = (axes @ axes.transpose(0, 2, 1)).astype(np.float32)
    covariances[7] *= 1e12  # a splat as large as the sky
    sent, unit = half_precision(covariances)
    half = sent.astype(np.float16).astype(np.float64)
    assert np.isfinite(half).all()
    error = np.abs(half * unit**2 - covariances).max(axis=(1, 2)) / np.trace(covariances, axis1=1, axis2=2)
    assert error[np.arange(500) != 7].max() < 2e-3  # half of the last of 11 bits, and the smallest number
    # smaller, but of the same shape
    assert np.allclose(sent[7] / sent[7, 0, 0], covariances[7] / covariances[7, 0, 0], rtol=1e-4)


def test_photo_and_mask_are_laid_over_one_another(scene, tmp_path):
    view, table = views()[0], scene.class_table()
    found = photo_pictures(scene, view, table, 80)
    labels = cv2.resize(truth_mask(view), (80, 60), interpolation=cv2.INTER_NEAREST)
    expected = np.where(labels[..., None] > 0, np.round(0.4 * 128 + 0.6 * table.palette[labels]), 128)
    assert found.photo.shape == (60, 80, 3) and np.abs(found.mask - expected).max() <= 1 and not found.note
    assert np.array_equal(overlay(None, np.uint8([[0, 1]]), table)[0, 0], [255, 255, 255])
    lost = photo_pictures(Scene(tmp_path), view, table, 80)
    assert lost.photo is None and lost.mask is None and lost.note == "no photo and no mask"
    assert thumbnail(found.photo, view, 40).max(initial=0) == 128


def test_texts_are_escaped_and_paths_have_no_slash():
    picked = PickedPoint(3, np.zeros(3), "<b>", 0.5, "seed", {"a & b": 2.0}, ("x<y>.jpg",))
    text = point_html(picked)
    assert "<b>" not in text and "&lt;b&gt;" in text and "a &amp; b" in text and "x&lt;y&gt;.jpg" in text
    odd = parse_classes([{"id": 1, "name": "grass / <lawn>", "color": [1, 2, 3]}], "test")
    assert "/" not in node_name(odd, 1) and node_name(None, 0) == "points"
    cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor(np.zeros((2, 3))))
    cloud.point["label"] = o3d.core.Tensor(np.uint8([[1], [1]]))
    legend = legend_html("label", DisplayCloud.from_cloud(cloud, np.zeros(3), odd))
    assert "&lt;lawn&gt;" in legend and "<lawn>" not in legend and "rgb(1,2,3)" in legend


def test_layers_send_each_point_once_in_its_class(scene):
    display = DisplayCloud.from_cloud(inspector_of(scene).cloud, np.round(ORIGIN), scene.class_table())
    with layer_server() as server:
        layer = CloudLayer(server, display, "cloud", "label", hidden={3})
        layer.show_points(10**9)
        sent = {
            name: handle
            for name, handle in server.scene._handle_from_node_name.items()
            if name.count("/") == 3
        }
        points = np.concatenate([handle.points for handle in sent.values()])
        assert layer.count == len(points) == len(display.points) and np.array_equal(
            np.unique(points, axis=0), np.unique(display.points, axis=0)
        )
        assert all((handle.colors == ROAD).all() == ("/road/" in name) for name, handle in sent.items())
        assert points.dtype == np.float32 and np.abs(points).max() < 20  # local, not UTM
        parents = {
            name: handle.visible
            for name, handle in server.scene._handle_from_node_name.items()
            if name.count("/") == 2
        }
        assert parents == {"/cloud/road": True, "/cloud/grass": False}
        layer.show_class(3, True)
        layer.color_by("confidence")
        assert server.scene._handle_from_node_name["/cloud/grass"].visible
        assert sum((handle.colors == ROAD).all(axis=1).sum() for handle in sent.values()) == 0


def test_fewer_points_are_a_thinner_cloud(scene, monkeypatch):
    monkeypatch.setattr("sc3d.view.display_cloud._SMALLEST_CHUNK", 500)
    display = DisplayCloud.from_cloud(inspector_of(scene).cloud, np.round(ORIGIN), scene.class_table())
    with layer_server() as server:
        layer = CloudLayer(server, display, "cloud", "label")
        for wanted, chunks in (
            (2000, 4),
            (500, 1),
            (0, 1),
            (1010, 2),
            (10**9, -(-len(display.points) // 500)),
        ):
            layer.show_points(wanted)
            nodes = [
                handle for name, handle in server.scene._handle_from_node_name.items() if name.count("/") == 3
            ]
            assert (
                sum(len(handle.points) for handle in nodes)
                == layer.count
                == min(500 * chunks, len(display.points))
            )
            assert len({handle.point_size for handle in nodes}) == 1 and np.isclose(
                nodes[0].point_size, 0.9 * display.spacing_at(layer.count)
            )


def test_frusta_lie_where_the_cameras_are(scene):
    with layer_server() as server:
        layer = CameraLayer(server, [view.shifted(ORIGIN) for view in views()], 2.0)
        layer.mark(["photo_1.jpg"])
        for view in views():
            handle = server.scene._handle_from_node_name[f"/cameras/{Path(view.name).stem}"]
            assert np.allclose(handle.position, view.center - ORIGIN, atol=1e-6) and np.allclose(
                np.abs(handle.wxyz @ orientation(view)), 1
            )
            assert np.isclose(handle.scale * handle.compute_canonical_frustum_size()[2], 2.0)
            assert (handle.color == (0, 158, 115)) == (view.name == "photo_1.jpg")


def listening(address: str) -> set[str]:
    """Addresses of this machine on which somebody listens at the port of a page's address."""
    port, found = int(address.rsplit(":", 1)[1]), set()
    for file, family, words in (("tcp", socket.AF_INET, 1), ("tcp6", socket.AF_INET6, 4)):
        rows = [line.split() for line in Path(f"/proc/net/{file}").read_text().splitlines()[1:]]
        for host, its_port in (row[1].split(":") for row in rows if row[3] == "0A"):
            if int(its_port, 16) == port:
                found.add(
                    socket.inet_ntop(
                        family,
                        struct.pack(
                            f"={words}I", *(int(host[8 * word : 8 * word + 8], 16) for word in range(words))
                        ),
                    )
                )
    return found


@linux
@pytest.mark.parametrize(
    ("host", "expected"), [(None, "127.0.0.1"), ("127.0.0.2", "127.0.0.2"), ("0.0.0.0", "0.0.0.0")]
)
def test_page_is_served_to_this_machine_only_unless_told_otherwise(scene, host, expected):
    pytest.importorskip("viser", reason="the viewer in the browser needs viser: pip install 'sc3d[web]'")
    from sc3d.view.web.page import WebView, serving

    with serving(WebView(scene, inspector_of(scene)), *([host] if host else [])) as address:
        assert address.startswith(f"http://{'localhost' if host == '0.0.0.0' else expected}:") and listening(
            address
        ) == {expected}
    assert listening(address) == set()


@linux
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_command_serves_this_machine_until_it_is_ended(scene, number):
    pytest.importorskip("viser", reason="the viewer in the browser needs viser: pip install 'sc3d[web]'")
    command = [
        sys.executable,
        "-c",
        "from sc3d.cli import main; main()",
        "view",
        str(scene.path),
        "--web",
        "--port",
        "0",
    ]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as running:
        try:
            lines = iter(running.stderr.readline, "")
            address = next(
                found[1]
                for line in lines
                if (found := re.match(r"open (http://127\.0\.0\.1:\d+) in a browser", line))
            )
            assert listening(address) == {"127.0.0.1"}
            running.send_signal(number)
            rest = running.stderr.read()
            assert running.wait(30) == 0 and "Traceback" not in rest
        finally:
            running.kill()


def test_a_page_for_everybody_comes_with_a_warning(scene, caplog, monkeypatch):
    pytest.importorskip("viser", reason="the viewer in the browser needs viser: pip install 'sc3d[web]'")
    from sc3d.view.web import page as web

    ended = threading.Event()
    ended.set()
    monkeypatch.setattr(web, "threading", SimpleNamespace(Event=lambda: ended))
    with caplog.at_level(logging.WARNING):
        web.serve(web.WebView(scene, inspector_of(scene)), "127.0.0.1", 0)
        assert not caplog.records
        web.serve(web.WebView(scene, inspector_of(scene)), "0.0.0.0", 0)
    assert "no password" in caplog.text


def test_missing_viser_says_how_to_install_it(scene, monkeypatch, capfd):
    monkeypatch.setitem(sys.modules, "viser", None)
    from sc3d.view.web.page import load_viser

    with pytest.raises(MissingPackageError, match=r"pip install 'sc3d\[web\]'"):
        load_viser()
    with pytest.raises(SystemExit) as ended:
        main(["view", str(scene.path), "--web"])
    assert ended.value.code == 1 and "pip install 'sc3d[web]'" in capfd.readouterr().err


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--web", "--html", "a.html"], "choose one of"),
        (["--html", "a.txt"], "ends in .html"),
        (["--web", "--screenshot", "a.png"], "choose one of"),
        (["--splats"], "--web"),
        (["--web", "--classes", "house"], "choose from road, grass"),
        (["--web", "--port", "70000"], "65535"),
        (["--web", "--splats", "--by", "disagreement"], "splats have no disagreement"),
        (["--web", "--by", "photo"], "no photo colors"),
    ],
)
def test_options_that_do_not_fit_are_one_line(scene, options, message, capfd):
    pytest.importorskip("viser", reason="the viewer in the browser needs viser: pip install 'sc3d[web]'")
    with pytest.raises(SystemExit) as ended:
        main(["view", str(scene.path), *options])
    error = capfd.readouterr().err
    assert ended.value.code == 2 and message in error and "Traceback" not in error
