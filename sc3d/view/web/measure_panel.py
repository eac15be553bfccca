"""The part of the panel that measures: coordinates, distances, areas and profiles between picked points."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from functools import cached_property
from html import escape
from typing import TYPE_CHECKING

import numpy as np

from sc3d.errors import InputError, Sc3dError
from sc3d.georeferencing.georeference import read_georeference
from sc3d.view.measurements import Area, Line, MeasureFrame, Profile
from sc3d.view.picking import point_on_ray
from sc3d.view.web.panel import Page, ShowPanel
from sc3d.view.web.profile_chart import profile_svg

if TYPE_CHECKING:
    import viser

logger = logging.getLogger(__name__)

OFF, COORDINATES, DISTANCE, AREA, PROFILE = "off", "coordinates", "distance", "area", "profile"
TOOLS = (OFF, COORDINATES, DISTANCE, AREA, PROFILE)
LEAST = {COORDINATES: 1, DISTANCE: 2, AREA: 3, PROFILE: 2}  # points of a measurement
HINT = (
    "Shift + click: a point on the first surface; or move the view by keys and take its middle, or type one"
)
MIDDLE, TYPED = "Middle of view", "Typed point"
BACK, CLEAR = "Remove last", "Clear"
_COLOR, _WIDTH = (0, 90, 255), 3.0  # of the line; px
# without a secure address, as from another machine, browsers have no navigator.clipboard
_COPY = (
    "const text=this.dataset.text,say=()=>{const was=this.textContent;this.textContent='copied';"
    "setTimeout(()=>this.textContent=was,1000)};const old=()=>{const area=document.createElement('textarea');"
    "area.value=text;document.body.append(area);area.select();document.execCommand('copy');area.remove();say()};"
    "navigator.clipboard?navigator.clipboard.writeText(text).then(say,old):old()"
)


class MeasurePanel:
    """Points, picked or typed, and what lies between them."""

    def __init__(self, page: Page, show: ShowPanel) -> None:
        self._page, self._show, self._busy = page, show, threading.RLock()
        self._frame = MeasureFrame(read_georeference(page.scene))
        self._corners = list[np.ndarray]()  # world
        self._drawn: list[viser.SceneNodeHandle] = []
        self._on_start: list[Callable[[], None]] = []
        gui, spacing = page.server.gui, page.display.spacing
        meters = 1.0 if self._frame.georeference is None else self._frame.georeference.meters
        with gui.add_folder("Measure"):
            self._tool = gui.add_dropdown("Measure", TOOLS, initial_value=OFF)
            self._half_width = gui.add_number(
                f"Half width, {self._frame.unit}",
                float(f"{3 * spacing * meters:.2g}"),
                min=0.0,
                visible=False,
            )
            self._typed = gui.add_text("Point", "", hint=f"{' '.join(self._frame.axes)}, {self._frame.name}")
            self._add = gui.add_button_group("Add", (MIDDLE, TYPED))
            self._steps = gui.add_button_group("Points", (BACK, CLEAR))
            self._text = gui.add_html("")
        self._tool.on_update(lambda _: self._choose())
        self._half_width.on_update(lambda _: self._try(self._tell))
        self._add.on_click(lambda event: self._try(lambda: self._add_point(event.client)))
        self._steps.on_click(lambda _: self._try(self._remove))
        page.server.scene.on_click(modifier="shift")(lambda event: self._try(lambda: self._point(event)))
        self._choose()

    def on_start(self, action: Callable[[], None]) -> None:
        """Call an action when a tool is chosen: other tools answer the same clicks."""
        self._on_start.append(action)

    def stop(self) -> None:
        """Put the tool away."""
        if self._tool.value != OFF:
            self._tool.value = OFF  # type: ignore[misc]  # viser types it as read-only

    def _try(self, action: Callable[[], None]) -> None:
        """Do one thing at a time, and say why it failed."""
        with self._busy:
            try:
                action()
            except Sc3dError as error:
                self._text.content = _note(str(error))

    def _choose(self) -> None:
        used = self._tool.value != OFF
        self._half_width.visible = self._tool.value == PROFILE
        for handle in (self._typed, self._add, self._steps):
            handle.visible = used
        if used:
            for action in self._on_start:
                action()
        else:
            self._corners = []
        self._try(self._tell)

    def _point(self, event: viser.SceneClickEvent) -> None:
        if self._tool.value != OFF:
            self._pick(np.array(event.ray_origin), np.array(event.ray_direction))

    def _add_point(self, client: viser.ClientHandle | None) -> None:
        if self._add.value == TYPED:
            self._append(self._frame.to_world(self._typed_point()[None])[0])
        elif client is not None:
            camera = client.camera
            eye = np.array(camera.position)
            self._pick(eye, np.array(camera.look_at) - eye)

    def _typed_point(self) -> np.ndarray:
        try:
            point = np.array(self._typed.value.replace(",", " ").replace(";", " ").split(), np.float64)
        except ValueError:
            point = np.zeros(0)
        if point.shape != (3,) or not np.isfinite(point).all():
            raise InputError(f"type three numbers: {' '.join(self._frame.axes)} ({self._frame.name})")
        return point

    def _pick(self, eye: np.ndarray, direction: np.ndarray) -> None:
        """The point on the first surface that a ray meets."""
        display, layer = self._page.display, self._page.cloud
        shown = np.flatnonzero(~np.isin(display.label[: layer.count], sorted(self._show.hidden)))
        found = point_on_ray(display.points[shown], eye, direction, display.spacing_at(layer.count))
        if found is None:
            raise InputError("there is no point: choose a place on the cloud")
        self._append(self._world[display.rows[shown[found]]])

    def _append(self, corner: np.ndarray) -> None:
        self._corners = [] if self._tool.value == COORDINATES else self._corners
        self._corners.append(corner)
        self._tell()

    def _remove(self) -> None:
        self._corners = [] if self._steps.value == CLEAR else self._corners[:-1]
        self._tell()

    @cached_property
    def _world(self) -> np.ndarray:
        """(N, 3) float64 of the cloud, all classes, shown or not."""
        return self._page.inspector.cloud.point.positions.cpu().numpy().astype(np.float64)

    @cached_property
    def _measured(self) -> np.ndarray:
        """The same as lengths are measured."""
        return self._frame.lengths(self._world)

    def _tell(self) -> None:
        """Draw the points, and say what is measured."""
        tool = self._tool.value
        self._draw(closed=tool == AREA)
        if tool == OFF:
            self._text.content = ""
            return
        missing = LEAST[tool] - len(self._corners)
        if missing > 0:
            self._text.content = _note(f"{HINT}; {missing} more") + self._coordinates()
            return
        corners, unit = self._frame.lengths(np.array(self._corners)), self._frame.unit
        found = {COORDINATES: "", DISTANCE: _line_html(corners, unit), AREA: _area_html(corners, unit)}.get(
            tool
        )
        self._text.content = (self._profile(corners) if found is None else found) + self._coordinates()

    def _coordinates(self) -> str:
        """A table of the points so far, to copy."""
        if not self._corners:
            return ""
        rows = [self._frame.tell(row) for row in self._frame.coordinates(np.array(self._corners))]
        text = "\n".join([",".join(self._frame.axes), *(",".join(row) for row in rows)])
        copied = " ".join(rows[0]) if len(rows) == 1 else text
        return _table(
            [(self._frame.name, "")] + [(str(place), " ".join(row)) for place, row in enumerate(rows, 1)]
        ) + (_copy_button("Copy coordinates", copied))

    def _profile(self, corners: np.ndarray) -> str:
        unit, display = self._frame.unit, self._page.display
        place = self._frame.georeference
        spacing = display.spacing * (1.0 if place is None else place.meters)
        profile = Profile.along_line(self._measured, corners, float(self._half_width.value))
        colors = display.colors(self._show.coloring)[self._in_display[profile.rows]]
        facts = [
            ("length on the plan", f"{profile.length:.3f} {unit}"),
            ("half width", f"{profile.half_width:g} {unit}"),
            ("points", f"{len(profile.rows):,} of the whole cloud"),
            ("height", f"{profile.height.min():.3f} to {profile.height.max():.3f} {unit}"),
            ("rows of the CSV", f"each {profile.step(spacing):.3g} {unit}"),
        ]
        return (
            _table(facts)
            + profile_svg(profile, colors, unit)
            + _copy_button("Copy CSV", profile.csv(spacing, unit))
        )

    @cached_property
    def _in_display(self) -> np.ndarray:
        """(N,) where the points of the cloud are in the display."""
        places = np.empty(len(self._page.display.rows), np.int64)
        places[self._page.display.rows] = np.arange(len(places))
        return places

    def _draw(self, closed: bool) -> None:
        for node in self._drawn:
            node.remove()
        self._drawn = []
        if not self._corners:
            return
        scene, display = self._page.server.scene, self._page.display
        corners = (np.array(self._corners) - display.origin).astype(np.float32)
        radius = max(1.5 * display.spacing_at(self._page.cloud.count), 0.003 * display.extent)
        for number, corner in enumerate(corners):
            ball = scene.add_icosphere(
                f"/measure/{number}",
                radius,
                _COLOR,
                material="toon3",
                cast_shadow=False,
                receive_shadow=False,
                position=corner,
            )
            self._drawn.append(ball)
        ends = np.roll(corners, -1, axis=0)
        lines = np.stack([corners, ends], axis=1)[: None if closed and len(corners) > 2 else -1]
        lines = lines + np.array([0, 0, radius], np.float32)  # over the drawn points, not within them
        if len(lines):
            self._drawn.append(
                scene.add_line_segments(
                    "/measure/line", lines, _COLOR, thickness=_WIDTH, thickness_units="screen"
                )
            )


def _line_html(corners: np.ndarray, unit: str) -> str:
    if len(corners) < 2:
        return ""
    line = Line.through(corners)
    slope = f"{100 * line.height / line.horizontal:.1f} %" if line.horizontal else "vertical"
    facts = [
        ("distance", f"{line.length:.3f} {unit}"),
        ("horizontal", f"{line.horizontal:.3f} {unit}"),
        ("height difference", f"{line.height:+.3f} {unit}"),
        ("slope", slope),
    ]
    if len(corners) > 2:
        facts.insert(1, ("first to last, straight", f"{line.direct:.3f} {unit}"))
    return _table(facts) + _copy_button("Copy lengths", "\n".join(f"{name},{value}" for name, value in facts))


def _area_html(corners: np.ndarray, unit: str) -> str:
    if len(corners) < 3:
        return ""
    area = Area.of(corners)
    square = "m\N{SUPERSCRIPT TWO}" if unit == "m" else "square units"
    facts = [
        ("area on the plan (horizontal)", f"{area.horizontal:.3f} {square}"),
        ("area on the best-fit plane", f"{area.on_plane:.3f} {square}"),
        ("tilt of that plane", f"{area.tilt:.1f}\N{DEGREE SIGN}"),
        ("farthest corner from it", f"{area.off:.3f} {unit}"),
        ("perimeter", f"{area.perimeter:.3f} {unit}"),
    ]
    return _table(facts) + _copy_button("Copy area", "\n".join(f"{name},{value}" for name, value in facts))


def _table(facts: list[tuple[str, str]]) -> str:
    cell = "<td style='padding-right:1em;vertical-align:top'>{}</td>"
    rows = "".join(
        f"<tr>{cell.format(escape(name))}{cell.format(escape(value))}</tr>" for name, value in facts
    )
    return f"<div style='padding:0 .75em;font-size:.8em;line-height:1.4'><table>{rows}</table></div>"


def _copy_button(label: str, text: str) -> str:
    return (
        f"<button style='margin:.25em .75em;font-size:.8em' data-text='{escape(text, quote=True)}' "
        f'onclick="{escape(_COPY, quote=True)}">{escape(label)}</button>'
    )


def _note(text: str) -> str:
    return f"<small style='padding:0 .75em'>{escape(text)}</small>"
