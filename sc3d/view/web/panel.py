"""The panel of the page: what is shown and how, a photo with its mask, and what is known of a clicked point."""

from __future__ import annotations

import logging
import threading
from dataclasses import dataclass
from functools import partial
from html import escape
from typing import TYPE_CHECKING

import numpy as np

from sc3d.errors import Sc3dError
from sc3d.geometry.cameras import View
from sc3d.io.images import data_uri
from sc3d.scene.scene import Scene
from sc3d.view.colors import Coloring, color_scale, legend_entries
from sc3d.view.display_cloud import DisplayCloud
from sc3d.view.picking import Inspector, PickedPoint, point_on_ray
from sc3d.view.web.layers import CameraLayer, CloudLayer, MarkLayer, SplatLayer
from sc3d.view.web.orbit_camera import OrbitCamera
from sc3d.view.web.photos import PhotoPictures, photo_pictures, thumbnail

if TYPE_CHECKING:
    import viser

logger = logging.getLogger(__name__)

_PHOTO_SIZE, _THUMBNAIL_SIZE = 800, 400  # px
_NO_PHOTO = "none"
_PICK_HINT = "Ctrl + click: what is known of a point, and of the object that it belongs to"
_PICKED_COLOR = (255, 0, 200)
_OBJECT_COLOR, _OBJECT_COVER = (255, 220, 0), 1.2  # of the object that was clicked; in sizes of a shown point


@dataclass(frozen=True)
class Page:
    """All that the panel works on. views: in the frame of `display`; splats: None where there are none"""

    server: viser.ViserServer
    scene: Scene
    display: DisplayCloud
    views: list[View]
    inspector: Inspector
    cloud: CloudLayer
    splats: SplatLayer | None
    cameras: CameraLayer


class ShowPanel:
    """What is shown: cloud or splats, coloring with its legend, classes, number and size of points, cameras."""

    def __init__(self, page: Page, by: Coloring, hidden: set[int], splats_first: bool) -> None:
        self._page, self.hidden, gui = page, set(hidden), page.server.gui
        self._boxes, self._folder = set[int](), gui.add_folder("Show")
        with self._folder:
            if page.splats is not None:
                layers = gui.add_dropdown(
                    "Layers", ("cloud", "splats", "both"), initial_value="splats" if splats_first else "cloud"
                )
                layers.on_update(lambda _: self._choose_layers(layers.value))
                self._choose_layers(layers.value)
            self._by = gui.add_dropdown("Color by", page.display.colorings, initial_value=by)
            self._legend = gui.add_html(legend_html(by, page.display))
            has_relief = page.display.has_relief
            self._relief = gui.add_checkbox(
                "relief",
                has_relief,
                visible=has_relief,
                hint="light from the north-west; not on photo colors",
            )
            for handle in (self._by, self._relief):
                handle.on_update(lambda _: self._color())
            self._add_classes(gui)
            self._add_sliders(gui)
            if page.views:
                cameras = gui.add_checkbox("cameras", True)
                cameras.on_update(lambda _: page.cameras.show(cameras.value))

    @property
    def coloring(self) -> Coloring:
        """What the colors show."""
        return self._by.value

    def relabel(self) -> None:
        """Show the labels that the cloud has now."""
        self._page.cloud.relabel(self.hidden)
        with self._folder:
            self._add_classes(self._page.server.gui)
        self._color()

    def _add_sliders(self, gui: viser.GuiApi) -> None:
        layer, total, chunk = self._page.cloud, len(self._page.display.points), self._page.display.chunk
        if total > chunk:
            points = gui.add_slider(
                "Thousand points",
                _thousands(chunk),
                _thousands(total),
                _thousands(chunk),
                _thousands(layer.count),
            )
            points.on_update(lambda _: layer.show_points(round(1000 * points.value)))
        size = gui.add_slider("Point size", 0.25, 4.0, 0.25, 1.0)
        size.on_update(lambda _: layer.resize(size.value))

    def _add_classes(self, gui: viser.GuiApi) -> None:
        table = self._page.display.class_table
        if table is None:
            return
        counts = self._page.display.class_counts
        labels = [
            *(label for label in counts if label),
            *([0] if 0 in counts or self._page.splats is not None else []),
        ]
        for label in labels:
            if label in self._boxes:
                continue
            self._boxes.add(label)
            box = gui.add_checkbox(
                table.name(label), label not in self.hidden, hint=f"{counts.get(label, 0):,} points"
            )
            box.on_update(partial(self._switch_class, label))

    def _choose_layers(self, name: str) -> None:
        self._page.cloud.show(name != "splats")
        if self._page.splats is None:
            return
        try:
            self._page.splats.show(name != "cloud")
        except Sc3dError as error:  # they are read when they are first shown
            logger.warning("the splats cannot be shown: %s", error)

    def _switch_class(self, label: int, event: viser.GuiEvent) -> None:
        visible = event.target.value
        (self.hidden.discard if visible else self.hidden.add)(label)
        for layer in (self._page.cloud, self._page.splats):
            if layer is not None:
                layer.show_class(label, visible)

    def _color(self) -> None:
        by = self._by.value
        with self._page.server.atomic():
            self._page.cloud.color_by(by, self._relief.value)
            if self._page.splats is not None:
                self._page.splats.color_by(by)
        self._legend.content = legend_html(by, self._page.display)


class PhotoPanel:
    """A photo and its mask, chosen by a click on its camera or by name, and a look through that camera."""

    def __init__(self, page: Page, home: OrbitCamera) -> None:
        """home: where "Overview" returns to"""
        self._page, self._home, self._views = page, home, {view.name: view for view in page.views}
        gui = page.server.gui
        with gui.add_folder("Photo"):
            gui.add_html(note_html("click a camera, or choose by name"))
            self._names = gui.add_dropdown("Photo", (_NO_PHOTO, *self._views), initial_value=_NO_PHOTO)
            self._names.on_update(lambda _: self._show(self._names.value))
            buttons = gui.add_button_group("View", ("Through it", "Overview"))
            buttons.on_click(lambda event: self._look(event.client, buttons.value))
            self._pictures = gui.add_html("")
        page.cameras.on_click(lambda name, _: self.choose(name))

    def choose(self, name: str) -> None:
        """Show a photo."""
        self._names.value = name  # type: ignore[misc]  # calls `_show`; viser types it as read-only

    def _show(self, name: str) -> None:
        self._page.cameras.hide(())
        found = None
        if name != _NO_PHOTO:
            found = photo_pictures(
                self._page.scene, self._views[name], self._page.display.class_table, _PHOTO_SIZE
            )
        self._pictures.content = "" if found is None else pictures_html(found)
        thumbnails = (
            {}
            if found is None or found.photo is None
            else {name: thumbnail(found.photo, self._views[name], _THUMBNAIL_SIZE)}
        )
        self._page.cameras.set_images(thumbnails)

    def _look(self, client: viser.ClientHandle | None, where: str) -> None:
        name = self._names.value
        if client is not None and where == "Overview":
            self._page.cameras.hide(())
            self._home.move(client)
        elif client is not None and name != _NO_PHOTO:
            self._page.cameras.hide((name,))
            OrbitCamera.from_view(self._views[name], self._page.display.middle, upright=False).move(client)


class PointPanel:
    """What is known of a point that was clicked with Ctrl held, and of its object, whose points are
    marked.
    """

    def __init__(self, page: Page, panel: ShowPanel) -> None:
        self._page, self._panel, self._busy = page, panel, threading.Lock()
        self._marked = MarkLayer(page.server, "object", _OBJECT_COVER)
        with page.server.gui.add_folder("Point"):
            self._text = page.server.gui.add_html(note_html(_PICK_HINT))
        page.server.scene.on_click(modifier="cmd/ctrl")(
            lambda event: self._pick(np.array(event.ray_origin), np.array(event.ray_direction))
        )

    def _pick(self, origin: np.ndarray, direction: np.ndarray) -> None:
        display, layer = self._page.display, self._page.cloud
        rows = np.flatnonzero(~np.isin(display.label[: layer.count], sorted(self._panel.hidden)))
        found = point_on_ray(display.points[rows], origin, direction, display.spacing_at(layer.count))
        if found is None:
            return
        with self._busy:  # the surface is made once
            picked = self._page.inspector.look_up(int(display.rows[rows[found]]))
        self._page.cameras.mark(picked.photos)
        radius = max(2 * display.spacing_at(layer.count), 0.004 * display.extent)
        # without light and shadow, which take seconds where there is no GPU
        self._page.server.scene.add_icosphere(
            "/picked",
            radius,
            _PICKED_COLOR,
            material="toon3",
            cast_shadow=False,
            receive_shadow=False,
            position=picked.position - display.origin,
        )
        self._mark_object(picked.object or 0)
        self._text.content = point_html(picked)

    def _mark_object(self, number: int) -> None:
        """Another color for the points of an object, and for no others; 0 = none."""
        display = self._page.display
        rows = display.rows_of_object(number) if number else np.zeros(0, np.int64)
        rows = rows[rows < self._page.cloud.count]
        colors = np.tile(np.array(_OBJECT_COLOR, np.uint8), (len(rows), 1))
        self._marked.show(display.points[rows], colors, display.spacing_at(self._page.cloud.count))


def legend_html(by: Coloring, display: DisplayCloud) -> str:
    """What the colors mean, as HTML: swatches of classes and states, or a color scale; empty for photo
    colors.
    """
    scale = color_scale(by)
    if scale is not None:
        stops = ", ".join(_css(color) for color in scale.colors[::15])
        bar = f"<span style='display:block;height:.8em;background:linear-gradient(90deg, {stops})'></span>"
        return f"<div style='padding:0 .75em;font-size:.8em'>{bar}<span>{escape(scale.low)}</span><span style='float:right'>{escape(scale.high)}</span></div>"
    present = set(display.class_counts) if by == "label" else None
    swatch = (
        "<span style='display:inline-block;width:.8em;height:.8em;margin-right:.4em;background:{}'></span>{}"
    )
    entries = [
        swatch.format(_css(color), escape(name))
        for name, color in legend_entries(by, display.class_table, present)
    ]
    entries = [f"<span style='margin-right:1em'>{entry}</span>" for entry in entries]
    return f"<div style='padding:0 .75em;font-size:.8em'>{' '.join(entries)}</div>" if entries else ""


def pictures_html(found: PhotoPictures) -> str:
    """Photo and mask as HTML that holds them: viser's own pictures are loaded from addresses that it
    withdraws while they load.
    """
    pictures = [
        f"{note_html(label)}<img alt='{label}' style='display:block;width:100%' src='{data_uri(picture)}'>"
        for label, picture in (("photo", found.photo), ("mask", found.mask))
        if picture is not None
    ]
    return f"<div style='padding:.25em .75em'>{''.join(pictures)}</div>{note_html(found.note)}"


def point_html(picked: PickedPoint) -> str:
    """A picked point as HTML."""
    facts = [*picked.facts(), *([("", ", ".join(picked.photos))] if picked.photos else [])]
    cell = "<td style='padding-right:1em;vertical-align:top'>{}</td>"
    rows = "".join(
        f"<tr>{cell.format(escape(name))}{cell.format(escape(value))}</tr>" for name, value in facts
    )
    return f"<div style='padding:0 .75em;font-size:.8em;line-height:1.4'><table>{rows}</table></div>"


def note_html(text: str) -> str:
    """A line of small text, as HTML; nothing for no text."""
    return f"<small style='display:block;padding:0 .75em'>{escape(text)}</small>" if text else ""


def _css(color: tuple[int, int, int] | np.ndarray) -> str:
    return "rgb({},{},{})".format(*(int(value) for value in color))


def _thousands(count: int) -> float:
    return round(count / 1000, 1)
