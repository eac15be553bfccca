"""A page in the browser that shows a scene (viser): served on this machine, or written into one file that
opens from disk.
"""

from __future__ import annotations

import contextlib
import io
import logging
import signal
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

import numpy as np

from sc3d.errors import MissingPackageError
from sc3d.geometry.cameras import View
from sc3d.io.atomic import atomic_path
from sc3d.io.local_page import LOOPBACK, LocalPage
from sc3d.scene.scene import Scene
from sc3d.view.colors import Coloring
from sc3d.view.display_cloud import DisplayCloud
from sc3d.view.display_splats import DisplaySplats
from sc3d.view.picking import Inspector
from sc3d.view.viewpoints import frustum_depth, overview, without_outliers
from sc3d.view.web.correction_panel import CorrectionPanel
from sc3d.view.web.guard import guarding
from sc3d.view.web.layers import CameraLayer, CloudLayer, SplatLayer
from sc3d.view.web.measure_panel import MeasurePanel
from sc3d.view.web.orbit_camera import OrbitCamera
from sc3d.view.web.panel import Page, PhotoPanel, PointPanel, ShowPanel, legend_html
from sc3d.view.web.question_panel import QuestionPanel

if TYPE_CHECKING:
    import viser

logger = logging.getLogger(__name__)

LOCAL = "127.0.0.1"
PAGE_POINTS, FILE_POINTS, FILE_SPLATS = 1_000_000, 300_000, 200_000  # shown at the start; at most in a file
_TITLE = "sc3d"
_START_SIZE = (1600, 1000)  # px; the start holds the whole scene in a window of this shape

# Chromium starts no worker of viser's from a blob: address in a page from disk; without that address viser
# uses a data: address, which works.
_WORKER_FROM_DISK = (
    "if(location.protocol==='file:'){const make=URL.createObjectURL.bind(URL);"
    "URL.createObjectURL=blob=>blob instanceof Blob&&blob.type.startsWith('text/javascript')?'':make(blob)}"
)


@dataclass(frozen=True)
class WebView:
    """What a page shows.

    inspector: has the cloud, the class table and all views
    load_splats: reads the Gaussians, None = there are none; splats_first: they are shown instead of the cloud
        at the start, and in a file
    by: coloring at the start; classes: ids shown at the start, None = all; cameras: draw them
    photo: name of the photo to look at and through at the start; from_above: straight down at the start;
        num_points: 0 = a default
    """

    scene: Scene
    inspector: Inspector
    load_splats: Callable[[], DisplaySplats] | None = None
    splats_first: bool = False
    by: Coloring = "label"
    classes: set[int] | None = None
    cameras: bool = True
    photo: str | None = None
    from_above: bool = False
    num_points: int = 0

    @property
    def drawn_views(self) -> list[View]:
        return self.inspector.views if self.cameras else []


@contextlib.contextmanager
def serving(view: WebView, host: str = LOCAL, port: int = 0) -> Iterator[str]:
    """Serve the page as long as the context lasts; yields its address. port: 0 = any; the next free one if it
    is taken.

    Raises MissingPackageError without viser.
    """
    display = _display_cloud(view)
    with _server(host, port) as server, contextlib.ExitStack() as ending:
        hidden = _hidden(view, display)
        cloud = CloudLayer(server, display, "cloud", view.by, hidden)
        cloud.show_points(view.num_points or PAGE_POINTS)
        splats = (
            None
            if view.load_splats is None
            else SplatLayer(server, view.load_splats, display, view.by, hidden)
        )
        views = [one.shifted(display.origin) for one in view.drawn_views]
        cameras = CameraLayer(server, views, frustum_depth(views, display.points) if views else 1.0)
        page = Page(server, view.scene, display, views, view.inspector, cloud, splats, cameras)
        home = _start(server, view, display, views)
        show = ShowPanel(page, view.by, hidden, view.splats_first)
        PointPanel(page, show)
        measure = MeasurePanel(page, show)
        if display.class_table is not None and host in LOOPBACK:
            correct = CorrectionPanel(page, show)
            measure.on_start(correct.stop)
            correct.on_start(measure.stop)
            if view.scene.labelled.exists() and view.inspector.views:
                ending.callback(_ask(page, correct).close)
        if views:
            photos = PhotoPanel(page, home)
            if view.photo is not None:
                photos.choose(view.photo)
        yield f"http://{'localhost' if host in ('0.0.0.0', '::') else host}:{server.get_port()}"


def serve(view: WebView, host: str, port: int) -> None:
    """Serve the page until Ctrl + C or SIGTERM."""
    ended = threading.Event()
    before = {
        number: signal.signal(number, lambda *_: ended.set()) for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        with serving(view, host, port) as address:
            if host not in LOOPBACK:
                logger.warning("everybody who can reach this machine can see the scene: there is no password")
            logger.info("open %s in a browser; Ctrl + C ends", address)
            ended.wait()
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def write_page(path: Path, view: WebView) -> None:
    """Write a page that opens from disk, without a server: every coloring of the cloud as a node of its own
    that can be switched on and off.
    """
    display = _display_cloud(view)
    with _server(LOCAL, 0) as server:
        hidden = _hidden(view, display)
        for by in (view.by, *(other for other in display.colorings if other != view.by)):
            layer = CloudLayer(server, display, f"cloud by {by}", by, hidden)
            layer.show_points(min(len(display.points), view.num_points or FILE_POINTS))
            layer.show(by == view.by and not view.splats_first)
        load = view.load_splats
        if view.splats_first and load is not None:
            few = SplatLayer(server, lambda: load().most_visible(FILE_SPLATS), display, view.by, hidden)
            few.show(True)
        views = [one.shifted(display.origin) for one in view.drawn_views]
        CameraLayer(server, views, frustum_depth(views, display.points) if views else 1.0)
        _start(server, view, display, views)
        page = server.scene.as_html()
    with atomic_path(path) as temporary:
        temporary.write_text(_for_disk(page, legend_html(view.by, display)), encoding="utf-8")


def _for_disk(page: str, legend: str) -> str:
    """viser's page with a legend, and with a worker that starts in pages from disk too: without it splats are
    not sorted by depth.
    """
    style = "position:fixed;left:0;bottom:0;padding:.5em;background:rgba(255,255,255,.85);font-family:sans-serif;z-index:10"
    head, body = page.index("<head>") + len("<head>"), page.rindex("</body>")
    added = f"<div style='{style}'>{legend}</div>" if legend else ""
    return f"{page[:head]}<script>{_WORKER_FROM_DISK}</script>{page[head:body]}{added}{page[body:]}"


def load_viser() -> ModuleType:
    """Import viser; MissingPackageError says how to install it."""
    try:
        import viser
    except ModuleNotFoundError:
        raise MissingPackageError("the viewer in the browser needs viser: pip install 'sc3d[web]'") from None
    return viser


@contextlib.contextmanager
def _server(host: str, port: int) -> Iterator[viser.ViserServer]:
    """A server that talks to nobody else: other web pages are refused, and its offer to share the page
    through the makers' server is off.
    """
    viser = load_viser()
    logging.getLogger("websockets").setLevel(logging.CRITICAL)  # browsers that leave at once are no error
    with contextlib.redirect_stdout(io.StringIO()), guarding(LocalPage.at(host)):  # it announces itself
        server = viser.ViserServer(host=host, port=port, label=_TITLE, verbose=False)
    server.request_share_url = lambda *_, **__: None
    try:
        server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="large")
        server.gui.main_panel.dock_right()
        yield server
    finally:
        with contextlib.redirect_stdout(io.StringIO()):
            server.stop()


def _display_cloud(view: WebView) -> DisplayCloud:
    points = view.inspector.cloud.point.positions
    views = view.inspector.views
    middle = (
        np.median([one.center for one in views], axis=0)
        if views
        else points[: max(1, len(points) // 2)].cpu().numpy().mean(axis=0)
    )
    return DisplayCloud.from_cloud(view.inspector.cloud, np.round(middle), view.inspector.class_table)


def _hidden(view: WebView, display: DisplayCloud) -> set[int]:
    return set() if view.classes is None else ({0} | set(display.class_counts)) - view.classes


def _ask(page: Page, correct: CorrectionPanel) -> QuestionPanel:
    """Questions whose answers are corrections: what one panel does, the other shows."""
    questions = QuestionPanel(page)
    questions.on_done(correct.follow)
    correct.on_done(questions.follow)
    return questions


def _start(server: viser.ViserServer, view: WebView, display: DisplayCloud, views: list[View]) -> OrbitCamera:
    """Set the camera that a browser starts with; returns the pose that shows the whole scene, in the frame of
    `display`.
    """
    points = without_outliers(display.points.astype(np.float64))
    above = overview(
        np.concatenate([points, *(one.center[None] for one in views)]), _START_SIZE, view.from_above
    )
    home = OrbitCamera.from_view(above, display.middle, upright=True)
    photo = next((one for one in views if one.name == view.photo), None)
    (home if photo is None else OrbitCamera.from_view(photo, display.middle, upright=False)).start(
        server.initial_camera
    )
    return home
