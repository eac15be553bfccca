"""The annotation page: what it refuses, what it writes, and drawing on it in a real browser."""

import http.client
import io
import json
import re
import shutil
import socket
import threading
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import sc3d.annotate
from sc3d.annotate.server import LARGEST_BODY, AnnotationServer
from sc3d.annotate.session import Session
from sc3d.cli import main
from sc3d.errors import InputError
from sc3d.scene.scene import Scene
from sc3d.segmentation.strokes.backend import StrokesSettings
from sc3d.segmentation.strokes.files import read_strokes

pytestmark = pytest.mark.usefixtures("one_thread")
CLASSES = [
    {"id": 2, "name": "road", "color": [150, 150, 160]},
    {"id": 5, "name": "grass", "color": [170, 220, 110]},
]
SIZE = (240, 160)
TINY = StrokesSettings(members=2, trees=4, steps=60, require_all=False)
ROAD = {"label": "road", "shape_type": "linestrip", "points": [[20, 10], [20.5, 150]], "width": 9}
GRASS = {"label": "grass", "shape_type": "polygon", "points": [[150, 20], [220, 20], [220, 140]]}


@pytest.fixture
def scene(tmp_path):
    (tmp_path / "images" / "flight").mkdir(parents=True)
    random = np.random.default_rng(0)
    for name in ("a.png", "flight/b c+ä.png"):
        image = np.full((*SIZE[::-1], 3), [100, 140, 60]) + random.normal(0, 6, (*SIZE[::-1], 3))
        image[:, :120] = np.array([150, 150, 158]) + random.normal(0, 3, (SIZE[1], 120, 3))
        Image.fromarray(np.clip(image, 0, 255).astype(np.uint8)).save(tmp_path / "images" / name)
    (tmp_path / "classes.json").write_text(json.dumps(CLASSES))
    return Scene(tmp_path)


@pytest.fixture
def server(scene):
    with AnnotationServer(Session(scene, settings=TINY), 0) as running:
        thread = threading.Thread(target=running.serve_forever, args=(0.02,))
        thread.start()
        yield running
        running.shutdown()
        thread.join()


def ask(
    server, path: str, content: object = None, **headers: str | None
) -> tuple[int, bytes, http.client.HTTPMessage]:
    """GET, or POST of JSON (or bytes) as the page does it; headers of None are left out, underscores are
    dashes.
    """
    own = {"Host": f"127.0.0.1:{server.server_port}"}
    body = None
    if content is not None:
        body = content if isinstance(content, bytes) else json.dumps(content).encode()
        own |= {
            "Origin": f"http://127.0.0.1:{server.server_port}",
            "X-Token": server.token,
            "Content-Type": "application/json",
            "Content-Length": str(len(body)),
        }
    own |= {name.replace("_", "-"): value for name, value in headers.items()}
    connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=30)
    connection.putrequest(
        "GET" if content is None else "POST", path, skip_host=True, skip_accept_encoding=True
    )
    for name, value in own.items():
        if value is not None:
            connection.putheader(name, value)
    connection.endheaders(body)
    answer = connection.getresponse()
    found = answer.status, answer.read(), answer.msg
    connection.close()
    return found


def test_strokes_are_saved_as_the_backend_reads_them(server, scene):
    status, body, _ = ask(
        server,
        "/strokes/a",
        {"shapes": [ROAD | {"other": "x"}, GRASS], "imageWidth": SIZE[0], "imageHeight": SIZE[1]},
    )
    assert status == 200 and json.loads(body) == {"saved": 2}
    written = json.loads((scene.strokes / "a.json").read_text())
    assert (written["imagePath"], written["imageWidth"], written["imageHeight"], written["imageData"]) == (
        "a.png",
        *SIZE,
        None,
    )
    assert "other" not in written["shapes"][0] and [path.name for path in scene.strokes.iterdir()] == [
        "a.json"
    ]
    assert json.loads(ask(server, "/strokes/a")[1])["shapes"] == [ROAD, GRASS]
    (drawn,) = read_strokes(scene.strokes, scene.images, scene.class_table())
    assert [shape.label for shape in drawn.shapes] == [2, 5] and drawn.shapes[0].width == 9
    assert json.loads(ask(server, "/scene")[1])["photos"][0]["strokes"] == 2
    assert ask(server, "/strokes/a", {"shapes": []})[0] == 200 and not list(scene.strokes.iterdir())


def test_coordinates_of_a_reduced_photo_are_scaled_and_windows_may_save_at_once(server, scene):
    half = {"shapes": [ROAD], "imageWidth": SIZE[0] // 2, "imageHeight": SIZE[1] // 2}
    statuses = []
    threads = [
        threading.Thread(target=lambda: statuses.append(ask(server, "/strokes/a", half)[0])) for _ in range(8)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert statuses == [200] * 8 and [path.name for path in scene.strokes.iterdir()] == ["a.json"]
    (shape,) = json.loads(ask(server, "/strokes/a")[1])["shapes"]
    assert shape == ROAD | {"points": [[40, 20], [41, 300]], "width": 18}


def test_photos_with_any_name_are_found(server, scene):
    listed = json.loads(ask(server, "/scene")[1])
    assert [photo["stem"] for photo in listed["photos"]] == ["a", "b c+ä"] and [
        entry["name"] for entry in listed["classes"]
    ] == ["road", "grass", "_background_"]
    status, body, headers = ask(server, "/photo/b%20c%2B%C3%A4")
    assert (
        status == 200
        and headers["Content-Type"] == "image/jpeg"
        and Image.open(io.BytesIO(body)).size == SIZE
    )
    assert (
        ask(server, "/strokes/b%20c%2B%C3%A4", {"shapes": [ROAD]})[0] == 200
        and (scene.strokes / "b c+ä.json").exists()
    )


def test_run_shows_a_mask_in_the_colors_of_the_classes(server):
    assert ask(server, "/try/a", {})[0] == 422  # nothing is drawn yet
    ask(server, "/strokes/a", {"shapes": [ROAD, GRASS]})
    status, body, headers = ask(server, "/try/b%20c%2B%C3%A4", {})
    assert status == 200 and headers["Content-Type"] == "image/png"
    mask = np.array(Image.open(io.BytesIO(body)))
    for columns, color in ((slice(0, 85), [150, 150, 160, 255]), (slice(155, 240), [170, 220, 110, 255])):
        assert (mask[:, columns] == color).all(axis=-1).mean() > 0.95
    assert (mask[mask[..., 3] < 255][:, 3] == 0).all()
    server.session._trying.acquire()
    assert ask(server, "/try/a", {})[0] == 409
    server.session._trying.release()


@pytest.mark.parametrize(
    "headers",
    [
        {"Host": "evil.example"},
        {"Host": "127.0.0.1"},
        {"Host": None},
        {"Sec_Fetch_Site": "cross-site"},
        {"Sec_Fetch_Site": "same-site"},
    ],
)
@pytest.mark.parametrize("path", ["/", "/scene", "/photo/a", "/strokes/a"])
def test_other_hosts_and_sites_are_refused(server, path, headers):
    assert ask(server, path)[0] == 200
    status, body, _ = ask(server, path, **headers)
    assert status == 403 and server.token.encode() not in body


@pytest.mark.parametrize(
    ("status", "headers"),
    [
        (403, {"Origin": None}),
        (403, {"Origin": "null"}),
        (403, {"Origin": "http://evil.example"}),
        (403, {"Origin": "http://127.0.0.1:1"}),
        (403, {"Host": "evil.example"}),
        (403, {"X_Token": None}),
        (403, {"X_Token": "x" * 43}),
        (403, {"X_Token": "ä"}),
        (403, {"Sec_Fetch_Site": "cross-site"}),
        (415, {"Content_Type": "text/plain"}),
        (415, {"Content_Type": None}),
        (411, {"Content_Length": None}),
        (411, {"Content_Length": "-1"}),
        (413, {"Content_Length": str(LARGEST_BODY + 1)}),
    ],
)
def test_posts_of_others_and_wrong_ones_write_nothing(server, scene, status, headers):
    assert ask(server, "/strokes/a", {"shapes": [ROAD]}, **headers)[0] == status
    assert not scene.strokes.exists()


@pytest.mark.parametrize(
    "stem",
    [
        "../a",
        "..%2Fa",
        "%2e%2e%2fa",
        "..%5Ca",
        "/etc/passwd",
        "%2Fetc%2Fpasswd",
        "a/../a",
        "a.png",
        "a%00",
        "",
        "unknown",
        "flight%2Fb c",
    ],
)
@pytest.mark.parametrize("kind", ["photo", "strokes", "try", "images"])
def test_only_photos_of_the_scene_have_addresses(server, scene, kind, stem):
    address = f"/{kind}/{stem}".replace(" ", "%20")
    assert ask(server, address)[0] == 404 and ask(server, address, {"shapes": [ROAD]})[0] == 404
    assert not scene.strokes.exists()


@pytest.mark.parametrize(
    ("status", "content"),
    [
        (400, b"{"),
        (400, b"[" * 100_000),
        (422, []),
        (422, {"shapes": {}}),
        (422, {"shapes": [1]}),
        (422, {"shapes": [ROAD | {"label": "roof"}]}),
        (422, {"shapes": [ROAD | {"points": [[1]]}]}),
        (422, {"shapes": [ROAD | {"points": [[1, "2"]]}]}),
        (422, b'{"shapes": [{"label": "road", "shape_type": "point", "points": [[NaN, 1]]}]}'),
        (422, {"shapes": [ROAD | {"width": -1}]}),
        (422, {"shapes": [ROAD | {"shape_type": "mask"}]}),
        (422, {"shapes": [ROAD], "imageWidth": 10, "imageHeight": 500}),
        (422, {"shapes": [ROAD], "imageWidth": "9", "imageHeight": 5}),
    ],
)
def test_drawings_are_checked_before_they_replace_others(server, scene, status, content):
    ask(server, "/strokes/a", {"shapes": [GRASS]})
    before = (scene.strokes / "a.json").read_bytes()
    found, body, _ = ask(server, "/strokes/a", content)
    assert found == status and json.loads(body)["error"]
    assert (scene.strokes / "a.json").read_bytes() == before


def test_pages_forbid_everything_from_elsewhere(server):
    for path in ("/", "/page.js", "/scene", "/photo/a", "/nothing"):
        headers = ask(server, path)[2]
        assert headers["Content-Security-Policy"].startswith(
            "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; connect-src 'self'"
        )
        assert (
            headers["Cross-Origin-Resource-Policy"] == "same-origin"
            and headers["X-Content-Type-Options"] == "nosniff"
            and headers["Access-Control-Allow-Origin"] is None
        )
    assert (
        server.token.encode() in ask(server, "/")[1]
        and server.token.encode() not in ask(server, "/page.js")[1]
    )
    for file in Path(sc3d.annotate.__file__).parent.iterdir():
        if file.suffix in (".html", ".css", ".js"):
            assert not re.search(r"(https?:)?//[a-z0-9]+\.[a-z]|@import|url\(", file.read_text()), file
    for method in ("PUT", "DELETE", "OPTIONS", "HEAD"):
        connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=30)
        connection.request(method, "/strokes/a")
        assert connection.getresponse().status == 501


def test_only_the_loopback_address_and_a_free_port(server, scene):
    assert server.server_address[0] == "127.0.0.1"
    with AnnotationServer(server.session, server.server_port) as other:
        assert server.server_port < other.server_port < server.server_port + 20
    with pytest.raises(InputError, match="no free port"):
        AnnotationServer(server.session, 70_000)
    with socket.socket() as probe:
        addresses = {
            info[4][0] for info in socket.getaddrinfo(socket.gethostname(), None, socket.AF_INET)
        } - {"127.0.0.1"}
        probe.settimeout(2)
        for address in list(addresses)[:1]:
            assert probe.connect_ex((address, server.server_port)) != 0


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda scene: (["--photo", "z.jpg"]), "no photo 'z.jpg'"),
        (lambda scene: scene.classes.unlink() or [], "classes.json"),
        (lambda scene: shutil.rmtree(scene.images) or [], "images"),
        (
            lambda scene: scene.strokes.mkdir() or (scene.strokes / "a.json").write_text("[]") and [],
            "not a LabelMe file",
        ),
    ],
)
def test_errors_come_before_the_page(scene, capsys, change, words):
    options = change(scene)
    with pytest.raises(SystemExit) as stopped:
        main(["annotate", str(scene.path), "--port", "0", *options])
    assert stopped.value.code == 2 and words in capsys.readouterr().err


# ---- in a browser


@pytest.fixture(scope="module")
def browser():
    api = pytest.importorskip(
        "playwright.sync_api", reason="the page is tested with playwright: pip install playwright"
    )
    program = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if program is None:
        pytest.skip("the page is tested in Chromium: apt install chromium")
    with api.sync_playwright() as playwright:
        started = playwright.chromium.launch(executable_path=program, args=["--no-sandbox"])
        yield started
        started.close()


@pytest.fixture
def page(browser, server):
    opened = browser.new_page(viewport={"width": 1000, "height": 700})
    opened.set_default_timeout(60_000)
    opened.wrong, opened.hosts = [], set()
    opened.on(
        "console",
        lambda message: opened.wrong.append(message.text) if message.type in ("error", "warning") else None,
    )
    opened.on("pageerror", lambda error: opened.wrong.append(str(error)))
    opened.on(
        "request",
        lambda request: (
            opened.hosts.add(request.url.split("/")[2]) if request.url.startswith("http") else None
        ),
    )
    load(opened, server)
    yield opened
    opened.close()


def load(page, server) -> None:
    page.goto(server.url)
    page.wait_for_selector("#photos [aria-pressed=true]")
    page.wait_for_selector("#run:enabled")


def on_screen(page, x: float, y: float) -> tuple[float, float]:
    """Where a place of the photo is shown, as long as all of it is in view."""
    box = page.locator("#canvas").bounding_box()
    scale = 0.97 * min(box["width"] / SIZE[0], box["height"] / SIZE[1])
    return box["x"] + box["width"] / 2 + (x - SIZE[0] / 2) * scale, box["y"] + box["height"] / 2 + (
        y - SIZE[1] / 2
    ) * scale


def drag(page, *places: tuple[float, float]) -> None:
    page.mouse.move(*on_screen(page, *places[0]))
    page.mouse.down()
    for place in places[1:]:
        page.mouse.move(*on_screen(page, *place), steps=8)
    page.mouse.up()


def saved(page, scene) -> list[dict]:
    page.keyboard.press("Control+s")
    page.wait_for_selector("#status:has-text('aved')")
    file = scene.strokes / "a.json"
    return json.loads(file.read_text())["shapes"] if file.exists() else []


def test_draws_saves_reloads_and_finds_it(page, server, scene):
    page.keyboard.press("1")
    drag(page, (20, 20), (20, 140), (60, 140))
    page.keyboard.press("2")
    page.keyboard.press("p")
    for place in ((150, 20), (220, 20), (220, 100), (150, 20)):  # the first corner again closes it
        page.mouse.click(*on_screen(page, *place))
    page.wait_for_selector("#photos [aria-pressed=true] small.dirty")
    first = saved(page, scene)
    assert [(shape["label"], shape["shape_type"]) for shape in first] == [
        ("road", "linestrip"),
        ("grass", "polygon"),
    ]
    assert np.allclose(first[0]["points"], [[20, 20], [20, 140], [60, 140]], atol=1) and np.allclose(
        first[1]["points"], [[150, 20], [220, 20], [220, 100]], atol=1
    )
    before = page.locator("#canvas").screenshot()
    load(page, server)
    assert page.inner_text("#photos [aria-pressed=true] small") == "2"
    page.mouse.move(5, 5)
    page.wait_for_timeout(100)
    colors = [
        np.array(Image.open(io.BytesIO(picture)).convert("RGB"))[row, column].astype(int)
        for picture in (before, page.locator("#canvas").screenshot())
        for column, row in [np.subtract(on_screen(page, 200, 40), on_screen_corner(page)).astype(int)]
    ]
    # the polygon is there again
    assert np.abs(colors[0] - colors[1]).max() < 12 and colors[1][1] > colors[1][0] + 15
    assert not page.wrong and page.hosts == {f"127.0.0.1:{server.server_port}"}


def on_screen_corner(page) -> tuple[float, float]:
    box = page.locator("#canvas").bounding_box()
    return box["x"], box["y"]


def test_undo_redo_and_erase(page, scene):
    drag(page, (20, 20), (60, 20))
    drag(page, (20, 80), (60, 80))
    drag(page, (20, 140), (60, 140))
    page.keyboard.press("Control+z")
    page.click("#undo")
    page.keyboard.press("Control+Shift+Z")
    assert [round(shape["points"][0][1]) for shape in saved(page, scene)] == [20, 80]
    page.keyboard.press("e")
    page.mouse.click(*on_screen(page, 40, 20))
    assert [round(shape["points"][0][1]) for shape in saved(page, scene)] == [80]
    page.keyboard.press("Control+z")
    page.mouse.click(*on_screen(page, 100, 120))  # nothing there
    assert len(saved(page, scene)) == 2


def test_keys_alone_are_enough(page, scene):
    page.keyboard.press("2")
    page.focus("#canvas")
    for key in ("ArrowLeft", "Enter", "Shift+ArrowRight", "Shift+ArrowDown", "Enter"):
        page.keyboard.press(key)
    page.keyboard.press("p")
    for key in ("Enter", "Shift+ArrowLeft", "Enter", "Shift+ArrowUp", "Enter", "Enter"):
        page.keyboard.press(key)
    stroke, polygon = saved(page, scene)
    assert stroke["label"] == "grass" and len(stroke["points"]) == 3 and len(polygon["points"]) == 3
    scale = 40 / (stroke["points"][1][0] - stroke["points"][0][0])
    assert np.allclose(np.diff(stroke["points"], axis=0) * scale, [[40, 0], [0, 40]], atol=1)


def test_zoom_keeps_the_place_under_the_mouse(page, scene):
    at = on_screen(page, 60, 50)
    page.mouse.move(*at)
    page.mouse.wheel(0, -300)
    page.mouse.down()
    page.mouse.up()
    page.keyboard.press("f")
    (shape,) = saved(page, scene)
    assert np.allclose(shape["points"], [[60, 50]], atol=1)


def test_run_lays_the_mask_over_the_photo(page, scene):
    drag(page, (20, 20), (20, 140))
    page.keyboard.press("2")
    drag(page, (200, 20), (200, 140))
    page.keyboard.press("r")
    page.wait_for_selector("#status:has-text('Done')")
    page.evaluate(
        "() => { const slider = document.getElementById('opacity'); slider.value = 100; slider.dispatchEvent(new Event('input')); }"
    )
    page.wait_for_timeout(100)
    column, row = np.subtract(on_screen(page, 45, 80), on_screen_corner(page)).astype(int)
    shown = lambda: np.array(Image.open(io.BytesIO(page.locator("#canvas").screenshot())).convert("RGB"))[
        row - 5 : row + 6, column - 5 : column + 6
    ].reshape(-1, 3)
    assert (shown() == [150, 150, 160]).all()
    page.keyboard.press("m")
    page.wait_for_timeout(100)
    assert shown().std(axis=0).max() > 1  # the photo's noise
    assert not page.wrong and (scene.strokes / "a.json").exists() and not scene.masks.exists()


def test_what_goes_wrong_is_said_on_the_page(page):
    drag(page, (20, 20), (20, 140))
    page.click("#run")
    page.wait_for_selector("#status.bad:has-text('one class only')")
    assert page.is_enabled("#run")
