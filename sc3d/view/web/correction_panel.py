"""The part of the panel that corrects labels in 3D; what it does is saved at once."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import fields
from typing import TYPE_CHECKING, Any

import numpy as np

from sc3d.errors import InputError, Sc3dError
from sc3d.io.atomic import file_state
from sc3d.io.json_files import read_json
from sc3d.io.python_process import run_python
from sc3d.runner import sidecar
from sc3d.scene.corrections import Balls, Corrections, add_correction, redo, undo
from sc3d.scene.labelled_cloud import read_labelled
from sc3d.scene.scene import Scene
from sc3d.scene.selection import balls_around, region_around, seen_in_lasso
from sc3d.settings.labels import Propagate
from sc3d.view.picking import point_on_ray
from sc3d.view.web.layers import MarkLayer
from sc3d.view.web.panel import Page, ShowPanel, note_html

if TYPE_CHECKING:
    import viser

logger = logging.getLogger(__name__)

NONE = "(none of the classes)"
OFF, REGION, BRUSH, LASSO = "off", "region", "brush", "lasso"
HINTS = {
    OFF: "choose a tool",
    REGION: "Shift + click: what hangs together with the point and looks like it",
    BRUSH: "Shift + click: a ball around the point",
    LASSO: "Shift + click: a corner; Close lasso: what is seen in it",
}
COVER = 1.6  # of a marked point, in spacings of the shown ones
_LASSO_COLOR, _LASSO_WIDTH = (255, 0, 200), 3.0  # px
_DAY = 24 * 3600.0


class CorrectionPanel:
    """Region, brush and lasso, the class that they give, undo and redo, and labels made anew."""

    def __init__(self, page: Page, show: ShowPanel) -> None:
        self._page, self._show, self._busy = page, show, threading.RLock()
        self._eye, self._corners = np.zeros(3), list[np.ndarray]()
        self._lasso: viser.SceneNodeHandle | None = None
        self._marked = MarkLayer(page.server, "corrected", COVER)
        self._applying = threading.Lock()
        self._on_start: list[Callable[[], None]] = []
        self._on_done: list[Callable[[], None]] = []
        self._read: tuple[int, ...] | None = None  # state of corrections.json when it was shown
        self._inside = dict[str, np.ndarray]()  # rows of the display, by correction
        self._world = page.inspector.cloud.point.positions.cpu().numpy().astype(np.float64)[page.display.rows]
        table, gui, spacing = page.display.class_table, page.server.gui, page.display.spacing
        names = [] if table is None else [entry.name for entry in table if entry.surface]
        with gui.add_folder("Correct"):
            self._tool = gui.add_dropdown("Tool", tuple(HINTS), initial_value=OFF)
            self._class = gui.add_dropdown("Class", (*names, NONE), initial_value=names[0])
            self._radius = gui.add_number("Brush radius", float(f"{4 * spacing:.2g}"), min=0.0)
            self._close = gui.add_button("Close lasso", visible=False)
            steps = gui.add_button_group("Steps", ("Undo", "Redo"))
            apply = gui.add_button("Apply", hint="sc3d propagate with these corrections")
            self._text = gui.add_html("")
        self._tool.on_update(lambda _: self._choose())
        self._close.on_click(lambda _: self._try(self._close_lasso))
        steps.on_click(lambda _: self._try(lambda: self._step(steps.value)))
        apply.on_click(lambda _: self._try(self._apply, self._applying))
        page.server.scene.on_click(modifier="shift")(lambda event: self._try(lambda: self._point(event)))
        self._choose()
        self._try(self._mark)

    def on_start(self, action: Callable[[], None]) -> None:
        """Call an action when a tool is chosen: other tools answer the same clicks."""
        self._on_start.append(action)

    def on_done(self, action: Callable[[], None]) -> None:
        """Call an action after whatever was done here: corrections or labels may have changed."""
        self._on_done.append(action)

    def follow(self) -> None:
        """Show corrections that were made or taken back elsewhere."""
        if file_state(self._page.scene.corrections) != self._read:
            self._try(self._mark)

    def stop(self) -> None:
        """Put the tool away."""
        if self._tool.value != OFF:
            self._tool.value = OFF  # type: ignore[misc]  # viser types it as read-only

    def _try(self, action: Callable[[], None], lock: AbstractContextManager | None = None) -> None:
        """Do one thing at a time, and say why it failed."""
        with lock or self._busy:
            try:
                action()
            except (Sc3dError, OSError) as error:
                logger.warning("%s", error)
                self._say(str(error))
        for follow in self._on_done:  # without the lock: they may wait for what waits for it
            follow()

    def _say(self, text: str) -> None:
        self._text.content = note_html(text)

    def _choose(self) -> None:
        self._close.visible, self._radius.visible = self._tool.value == LASSO, self._tool.value == BRUSH
        if self._tool.value != OFF:
            for action in self._on_start:
                action()
        self._draw([])
        self._say(HINTS[self._tool.value])

    def _point(self, event: viser.SceneClickEvent) -> None:
        if self._tool.value == OFF:
            return
        eye, direction = np.array(event.ray_origin), np.array(event.ray_direction)
        if self._tool.value == LASSO:
            same = np.linalg.norm(eye - self._eye) < self._page.display.spacing
            self._eye = eye
            self._draw([*(self._corners if same else []), direction / np.linalg.norm(direction)])
            return
        display, layer = self._page.display, self._page.cloud
        shown = self._shown()
        shown = shown[shown < layer.count]
        found = point_on_ray(display.points[shown], eye, direction, display.spacing_at(layer.count))
        if found is None:
            raise InputError("there is no point: click on one")
        if self._tool.value == BRUSH:
            if self._radius.value <= 0:
                raise InputError("the brush needs a radius above 0")
            self._add(Balls(((self._world[shown[found]][None], float(self._radius.value)),)))
        else:
            self._add_region(int(shown[found]))

    def _add_region(self, row: int) -> None:
        display = self._page.display
        colors = display.colors("photo") if "photo" in display.colorings else None
        rows = region_around(self._world, display.label, colors, row, display.spacing)
        self._add(balls_around(self._world, rows, display.spacing))

    def _close_lasso(self) -> None:
        if len(self._corners) < 3:
            raise InputError("a lasso needs three corners")
        display, shown = self._page.display, self._shown()
        points = display.points[shown].astype(np.float64)
        rows = shown[seen_in_lasso(points, self._eye, np.array(self._corners), display.spacing)]
        self._draw([])
        if not len(rows):
            raise InputError("there is no point in the lasso")
        self._add(balls_around(self._world, rows, display.spacing))

    def _shown(self) -> np.ndarray:
        """Rows of the display whose class is shown."""
        return np.flatnonzero(~np.isin(self._page.display.label, sorted(self._show.hidden)))

    def _draw(self, corners: list[np.ndarray]) -> None:
        """Show the corners of the lasso so far, at the distance of the middle of the scene."""
        self._corners, scene = corners, self._page.server.scene
        if not corners:
            if self._lasso is not None:
                self._lasso.remove()
            self._lasso = None
            return
        far = float(np.linalg.norm(self._page.display.middle - self._eye)) / 2
        ends = self._eye + far * np.array(corners)
        lines = np.stack([ends, np.roll(ends, -1, axis=0)], axis=1).astype(np.float32)
        self._lasso = scene.add_line_segments(
            "/lasso", lines, _LASSO_COLOR, thickness=_LASSO_WIDTH, thickness_units="screen"
        )
        self._say(f"corners: {len(corners)}")

    def _add(self, shape: Balls) -> None:
        name = self._class.value
        add_correction(self._page.scene, None if name == NONE else name, shape)
        self._mark(f"to {name}")

    def _step(self, name: str) -> None:
        found = undo(self._page.scene) if name == "Undo" else redo(self._page.scene)
        self._mark(
            "undone" if name == "Undo" and found else "redone" if found else f"nothing to {name.lower()}"
        )

    def _mark(self, done: str = "") -> None:
        """Show what is corrected and not yet in the labels."""
        self._read = file_state(self._page.scene.corrections)
        found, display = Corrections.of_scene(self._page.scene), self._page.display
        label = display.label.astype(np.int16)
        for row, given in enumerate(found.ids):
            label[self._rows_in(found, row)] = given
        rows = np.flatnonzero(label != display.label)
        if display.class_table is not None:
            colors, spacing = (
                display.class_table.palette[label[rows]],
                display.spacing_at(self._page.cloud.count),
            )
            self._marked.show(display.points[rows], colors, spacing)
        count = f"corrections: {len(found.ids)}; points that wait for Apply: {len(rows)}"
        self._say(f"{done}: {count}" if done else count if found.ids else HINTS[self._tool.value])

    def _rows_in(self, found: Corrections, row: int) -> np.ndarray:
        key = found.corrections[row].key
        if key not in self._inside:
            self._inside[key] = np.flatnonzero(found.contain(row, self._world))
        return self._inside[key]

    def _apply(self) -> None:
        self._say("labels are made ...")
        propagate_again(self._page.scene)
        labelled, _ = read_labelled(self._page.scene.labelled, "propagate")
        with self._busy:
            self._page.display.relabel(labelled)
            self._show.relabel()
            self._mark("applied")


def propagate_again(scene: Scene) -> None:
    """`sc3d propagate` with the settings that `labelled.ply` was made with, in a process of its own:
    the page goes on.

    Raises InputError with the reason if it fails.
    """
    code = (
        "from pathlib import Path\nfrom sc3d.cli import reporting_errors, start_logging\n"
        "from sc3d.runner import execute\nfrom sc3d.scene.scene import Scene\n"
        "from sc3d.view.web.correction_panel import made_with\nstart_logging()\n"
        f"scene = Scene(Path({str(scene.path.absolute())!r}))\n"
        "with reporting_errors():\n execute('propagate', scene, made_with(scene))"
    )
    ended = run_python(code, _DAY)
    if ended.returncode:
        raise InputError((ended.stderr.strip() or "propagate failed").splitlines()[-1])


def made_with(scene: Scene) -> Propagate:
    """The settings of `labelled.ply`, as far as the record beside it has them."""
    record: Any = read_json(sidecar(scene.labelled)) if sidecar(scene.labelled).exists() else {}
    known = record.get("settings", {}) if isinstance(record, dict) else {}
    paths = ("seeds", "model")  # what it also wrote is not written again
    names = {field.name for field in fields(Propagate)} - {*paths, "output", "save_model"}
    settings = {name: known[name] for name in names if isinstance(known.get(name), str | int | float)}
    given = {name: scene.path / known[name] for name in paths if isinstance(known.get(name), str)}
    return Propagate(**settings, **given)
