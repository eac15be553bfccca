"""The page in headless Chromium: loads, hides a class, answers clicks on a camera and on a point, turns, and
talks to this machine only.
"""

from __future__ import annotations

import base64
import os
import re
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import NamedTuple
from urllib.parse import urlsplit

import cv2
import numpy as np
import pytest
import torch

from sc3d.cli import main
from sc3d.geometry.cameras import View, look_at, pinhole_view, project, rays, undistorted
from sc3d.scene.scene import Scene
from sc3d.splatting.gaussians import Gaussians
from sc3d.view.colors import STATES
from sc3d.view.display_cloud import DisplayCloud
from sc3d.view.display_splats import DisplaySplats
from sc3d.view.picking import Inspector
from sc3d.view.viewpoints import frustum_depth, overview, without_outliers
from sc3d.view.web.orbit_camera import OrbitCamera, field_of_view
from sc3d.view.web.photos import photo_pictures
from tests.builders import CLASSES, ORIGIN, ground, inspector_of, labelled_scene, views

ROAD, GRASS = CLASSES[0]["color"], CLASSES[1]["color"]
SIZE = (900, 600)  # px of the browser's window
LEFT = (slice(None), slice(0, SIZE[0] // 2))  # where the panel is not
OPTIONS = [
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1",
]
LOCAL = {("http", "127.0.0.1"), ("ws", "127.0.0.1"), ("blob", None), ("data", None), ("file", None)}


class Visit(NamedTuple):
    """A page that is open, and what it asked for and complained about."""

    page: object
    requests: list[str]
    errors: list[str]

    @property
    def picture(self) -> np.ndarray:
        """(H, W, 3) uint8 RGB of the whole page."""
        return decoded(self.page.screenshot())

    def share(self, color: list[int]) -> float:
        """Of the pixels at the left that have exactly this color."""
        return share_of(self.picture, color)

    def is_still_with(self, least: float, *colors: list[int]) -> bool:
        """Whether each color has a larger share than `least`, and the page is still."""
        picture = self.picture
        return all(share_of(picture, color) > least for color in colors) and self.is_still(picture)

    def is_still(self, before: np.ndarray | None = None) -> bool:
        """Whether pictures over half a second are the same: a loaded machine pauses within a movement."""
        before = self.picture if before is None else before
        for _ in range(2):
            self.page.wait_for_timeout(250)
            if not np.array_equal(before, self.picture):
                return False
        return True

    def wait_for(self, condition: Callable[[], bool], what: str) -> None:
        """Until a condition on this visit holds; software rendering takes its time."""
        for _ in range(300):
            if condition():
                return
            self.page.wait_for_timeout(100)
        pytest.fail(f"waited in vain for {what}; errors: {self.errors}")


def share_of(picture: np.ndarray, color: list[int]) -> float:
    """Of the pixels at the left of an (H, W, 3) picture that have exactly this color."""
    return float((picture[LEFT] == color).all(axis=-1).mean())


def decoded(file: bytes) -> np.ndarray:
    """(H, W, 3) uint8 RGB of a PNG or JPEG."""
    return cv2.imdecode(np.frombuffer(file, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return labelled_scene(tmp_path_factory.mktemp("web") / "scene")


@pytest.fixture(scope="module")
def browser() -> Iterator[object]:
    pytest.importorskip("viser", reason="the viewer in the browser needs viser: pip install 'sc3d[web]'")
    api = pytest.importorskip(
        "playwright.sync_api", reason="the page is tested with playwright: pip install playwright"
    )
    program = next(
        (
            found
            for name in ("chromium", "chromium-browser", "google-chrome")
            if (found := shutil.which(name))
        ),
        None,
    )
    if program is None:
        pytest.skip("the page is tested in Chromium: apt install chromium")
    with api.sync_playwright() as playwright:
        # with a display that does not answer there is no WebGL
        headless = {name: value for name, value in os.environ.items() if name != "DISPLAY"}
        started = playwright.chromium.launch(executable_path=program, args=OPTIONS, env=headless)
        yield started
        started.close()


@contextmanager
def visit(browser: object, address: str, size: tuple[int, int] = SIZE) -> Iterator[Visit]:
    """Open a page and leave it; it must not have asked anybody but this machine for anything."""
    page = browser.new_page(viewport={"width": size[0], "height": size[1]})
    page.set_default_timeout(60_000)
    found = Visit(page, [], [])
    page.on("request", lambda request: found.requests.append(request.url))
    page.on("websocket", lambda socket: found.requests.append(socket.url))
    page.on("console", lambda message: found.errors.append(message.text) if message.type == "error" else None)
    page.on("pageerror", lambda error: found.errors.append(str(error)))
    page.goto(address)
    try:
        yield found
    finally:
        page.close()
    assert {(parts.scheme, parts.hostname) for parts in map(urlsplit, found.requests)} <= LOCAL, (
        found.requests
    )


@pytest.fixture(scope="module")
def served(scene: Scene, browser: object) -> Iterator[Visit]:
    """The page of the scene, served and drawn."""
    from sc3d.view.web.page import WebView, serving

    with serving(WebView(scene, inspector_of(scene))) as address, visit(browser, address) as found:
        found.page.get_by_text("Color by", exact=True).wait_for()
        # viser's remark on software rendering lies over the cameras
        found.page.locator(".mantine-Notification-closeButton").click()
        yield found
        assert any(url.startswith("ws://") for url in found.requests)


@pytest.fixture
def opened(served: Visit) -> Iterator[Visit]:
    """The page as it looks at the start; at the end, nothing may have gone wrong in the browser."""
    served.page.get_by_role("button", name="Overview").click()
    served.wait_for(lambda: served.is_still_with(0.05, ROAD, GRASS), "road and grass in their own colors")
    yield served
    assert served.errors == []


def in_canvas(page: object, pose: OrbitCamera, fov: float | None = None) -> tuple[View, np.ndarray]:
    """What the page shows when it looks from a pose of the viewer's frame: a view of the canvas' size, and
    (2,) its corner in the page, px.
    """
    box = page.locator("canvas").last.bounding_box()
    focal = box["height"] / 2 / np.tan((fov or pose.fov) / 2)
    calibration = (focal, focal, box["width"] / 2, box["height"] / 2)
    size = (int(box["width"]), int(box["height"]))
    return pinhole_view(
        "canvas", size, calibration, look_at(pose.position, pose.look_at, tuple(pose.up))
    ), np.array([box["x"], box["y"]])


def home_of(scene: Scene) -> tuple[OrbitCamera, DisplayCloud]:
    """The pose that the page starts with, and the cloud in its frame."""
    centers = np.array([view.center for view in views()])
    display = DisplayCloud.from_cloud(
        inspector_of(scene).cloud, np.round(np.median(centers, axis=0)), scene.class_table()
    )
    points = np.concatenate([without_outliers(display.points.astype(np.float64)), centers - display.origin])
    return OrbitCamera.from_view(overview(points, (1600, 1000)), display.middle, upright=True), display


def click_camera(page: object, scene: Scene, name: str) -> None:
    """Click into the pyramid of a photo's camera, seen from the pose that the page starts with."""
    home, display = home_of(scene)
    local = [view.shifted(display.origin) for view in scene.model.views]
    window, corner = in_canvas(page, home)
    view = next(one for one in local if one.name == name)
    target = view.center + 0.6 * frustum_depth(local, display.points) * view.cam_from_world[2, :3]
    page.mouse.click(*(corner + project(window, target[None])[0][0]))


def test_class_is_switched_off_and_on(opened):
    before = opened.picture
    box = opened.page.get_by_role("checkbox", name="grass")
    box.click()
    opened.wait_for(lambda: opened.share(GRASS) == 0, "grass to go")
    hidden = opened.picture
    road = (before == ROAD).all(axis=-1)
    road[:, LEFT[1].stop :] = False  # the panel has a swatch of it
    assert (hidden[road] == ROAD).all() and opened.share(ROAD) > 0.05  # and nothing but grass went
    box.click()
    opened.wait_for(
        lambda: (opened.picture[LEFT] != before[LEFT]).any(axis=-1).mean() < 1e-3,
        "the same picture as before but for points as far as others, drawn in another order",
    )


def test_clicked_camera_shows_its_photo_and_mask_and_is_looked_through(scene, opened):
    page, view = opened.page, views()[3]
    click_camera(page, scene, view.name)
    opened.wait_for(
        lambda: view.name in page.evaluate("[...document.querySelectorAll('input')].map(box => box.value)"),
        "the clicked camera's name",
    )
    expected = photo_pictures(scene, view, scene.class_table(), 800)
    for label, picture in (("photo", expected.photo), ("mask", expected.mask)):
        image = page.locator(f"img[alt={label}]")
        image.wait_for()
        drawn = decoded(base64.b64decode(image.get_attribute("src").split(",")[1])).astype(int)
        assert (
            image.evaluate("one => one.complete && one.naturalWidth") == view.width
            and np.abs(drawn - picture).mean() < 2
        )
    page.get_by_role("button", name="Through it").click()
    opened.wait_for(lambda: agreement(opened.picture, page, view) > 0.97, "what the photo's camera sees")
    page.get_by_role("button", name="Overview").click()
    opened.wait_for(lambda: agreement(opened.picture, page, view) < 0.9, "the way back")


def agreement(picture: np.ndarray, page: object, view: View) -> float:
    """Share of the pixels of road and grass that show what a photo's camera sees there, with its center in
    the middle; 0 if there are few.
    """
    forward = view.cam_from_world[2, :3]
    pose = OrbitCamera(
        view.center, view.center + forward, -view.cam_from_world[1, :3], field_of_view(undistorted(view))[0]
    )
    window, corner = in_canvas(page, pose)
    left, top = corner.astype(int)
    directions, _ = rays(window)
    hits = view.center + directions * (-(view.center[2] - ORIGIN[2]) / directions[:, 2])[:, None] - ORIGIN
    part = picture[top : top + window.height, left : left + window.width].reshape(-1, 3)
    is_road, is_grass = ((part == color).all(axis=1) for color in (ROAD, GRASS))
    right = np.where(hits[:, 0] < 0, is_road, is_grass) & (np.abs(hits[:, :2]).max(axis=1) < 4.2)
    count = np.count_nonzero(is_road | is_grass)
    return float(np.count_nonzero(right) / count) if count > 0.2 * len(part) else 0.0


def test_drag_turns_around_the_scene(opened):
    def middles() -> list[float]:
        """Mean columns of road and of grass."""
        picture = opened.picture[LEFT]
        return [float(np.nonzero((picture == color).all(axis=-1))[1].mean()) for color in (ROAD, GRASS)]

    road, grass = middles()
    assert road < grass  # from the south: road in the west
    mouse, height = opened.page.mouse, opened.page.locator("canvas").last.bounding_box()["height"]
    mouse.move(100, SIZE[1] - 40)
    mouse.down()
    mouse.move(100 + height / 2, SIZE[1] - 40, steps=5)  # the height of the canvas is a full turn
    mouse.up()
    opened.wait_for(lambda: middles()[0] > middles()[1], "the view from the north")


def test_what_is_known_of_a_picked_point(scene, opened):
    page = opened.page
    home, display = home_of(scene)
    window, corner = in_canvas(page, home)
    cloud, points = inspector_of(scene).cloud, ground()
    for target in ([-2.03, -2.02, 0], [2.51, -1.02, 0]):
        page.keyboard.down("Control")
        page.mouse.click(*(corner + project(window, ORIGIN + [target] - display.origin)[0][0]))
        page.keyboard.up("Control")
        rows = page.locator("tr", has_text="position")
        opened.wait_for(
            lambda: rows.count() == 1 and np.linalg.norm(position_in(rows) - ORIGIN - target) < 0.2,
            "a point near the click",
        )
        row = int(np.argmin(np.linalg.norm(points - position_in(rows), axis=1)))
        facts = dict(
            cells.all_inner_texts() for cells in (line.locator("td") for line in page.locator("tr").all())
        )
        label, confidence, state = (
            cloud.point[name][row].item() for name in ("label", "confidence", "state")
        )
        assert (facts["class"], facts["confidence"], facts["state"]) == (
            scene.class_table().name(label),
            f"{confidence:.2f}",
            STATES[state].name,
        )
        assert (
            label == (1 if target[0] < 0 else 3)
            and facts["seen by"] == "5 photos"
            and facts["votes"].startswith(facts["class"])
        )


def position_in(rows: object) -> np.ndarray:
    """(3,) of a point, as the panel shows it."""
    return np.array([float(number) for number in re.findall(r"\d+\.\d+", rows.inner_text())])


def two_layers(table) -> DisplaySplats:
    """Splats of class 1 above splats of class 3, given front to back: drawn in that order, the ones below
    would cover the ones above.
    """
    x, y = np.meshgrid(np.linspace(-4, 4, 25), np.linspace(-4, 4, 25))
    means = np.concatenate(
        [np.stack([x.ravel(), y.ravel(), np.full(x.size, height)], axis=1) for height in (3.0, 0.0)]
    )
    count = len(means)
    gaussians = Gaussians(
        torch.from_numpy(means).float(),
        torch.full((count, 3), float(np.log(0.3))),
        torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
        torch.full((count,), 6.0),
        torch.zeros(count, 3),
    )
    return DisplaySplats(
        gaussians,
        np.round(ORIGIN),
        np.repeat(np.uint8([1, 3]), x.size),
        np.ones(count, np.float32),
        table,
    )


def test_file_opens_from_disk_and_sorts_splats_by_depth(scene, browser, tmp_path):
    from sc3d.view.web.page import WebView, write_page

    splats = two_layers(scene.class_table())
    view = WebView(
        scene,
        Inspector(splats.centers(), scene.model.views, scene.class_table(), scene.surface),
        lambda: splats,
        splats_first=True,
        cameras=False,
        from_above=True,
    )
    write_page(tmp_path / "page.html", view)
    with visit(browser, f"file://{tmp_path}/page.html", (500, 500)) as found:
        middle = (slice(220, 280), slice(220, 280))  # below the remark on software rendering
        found.wait_for(
            lambda: np.abs(np.median(found.picture[middle].reshape(-1, 3), axis=0) - ROAD).max() < 12,
            "the upper splats to cover the lower ones",
        )
        assert found.page.get_by_text("road", exact=True).count() == 1  # the legend
        assert not [url for url in found.requests if urlsplit(url).hostname]  # not even this machine
        # viser's splats have flat corners, of which three.js complains
        assert not [text for text in found.errors if "computeBoundingSphere" not in text]


def test_file_holds_every_coloring(scene, tmp_path):
    pytest.importorskip("viser", reason="the viewer in the browser needs viser: pip install 'sc3d[web]'")
    main(
        [
            "view",
            str(scene.path),
            "--html",
            str(tmp_path / "page.html"),
            "--points",
            "3000",
            "--classes",
            "road",
        ]
    )
    page = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert (
        "__VISER_EMBED_DATA__" in page
        and page.index("URL.createObjectURL=blob") < page.index("__VISER_EMBED_DATA__")
        and "rgb(150,150,160)" in page
    )
    messages = embedded_messages(page)
    names = {
        message["name"]: message["props"]
        for message in messages
        if message.get("type") == "PointCloudMessage"
    }
    assert {name.split("/")[1] for name in names} == {
        f"cloud by {by}" for by in ("label", "confidence", "state", "disagreement")
    }
    hidden = {
        message["name"]
        for message in messages
        if message.get("type") == "SetSceneNodeVisibilityMessage" and not message["visible"]
    }
    assert {
        "/cloud by label/grass",
        "/cloud by confidence",
        "/cloud by state",
        "/cloud by disagreement",
    } <= hidden and "/cloud by label" not in hidden


def embedded_messages(page: str) -> list[dict]:
    """The messages in a page's scene, by the format that viser documents in `StateSerializer.serialize`."""
    import msgspec
    import zstandard

    start = page.index('__VISER_EMBED_DATA__="') + len('__VISER_EMBED_DATA__="')
    packed = base64.b64decode(page[start : page.index('"', start)])
    inner = zstandard.ZstdDecompressor().decompress(
        packed[8:], max_output_size=int.from_bytes(packed[:8], "little")
    )
    length = int.from_bytes(inner[:8], "little")
    return [message for _, message in msgspec.msgpack.decode(inner[8 : 8 + length])["messages"]]
