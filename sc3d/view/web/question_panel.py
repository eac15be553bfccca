"""The part of the panel that asks about doubtful places: flies to one, marks it, and writes the answer
down.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from functools import partial
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from sc3d.annotate.asking import Asked, Asking, StaleError
from sc3d.errors import InputError, Sc3dError
from sc3d.tiling.memory import num_points
from sc3d.view.web.correction_panel import COVER
from sc3d.view.web.layers import MarkLayer
from sc3d.view.web.orbit_camera import OrbitCamera, fly
from sc3d.view.web.panel import Page, note_html

if TYPE_CHECKING:
    import viser

logger = logging.getLogger(__name__)

NONE = "none of the classes"
KEYS = "123456789"  # of the first classes; 0: none of them
SKIP, LOOK, STOP = "Skip", "Look again", "Stop"
SKIP_KEY, LOOK_KEY = "N", "L"  # W A S D Q E move the camera
_HINT = "Start: places where an answer changes most are shown one by one, to be told their class"
_DONE, _NOTHING = "Nothing is left to ask. Apply, in Correct, uses the answers.", "No label is doubtful."
_KEYS_HINT = f"keys: 1 ... 9 class, 0 none, {SKIP_KEY} skip, {LOOK_KEY} look again"
# of a point of the labelled cloud while places are looked for: 400 to 730 were measured with 8 classes
_ASKED_BYTES = 900
_COLOR, _TINT = (255, 0, 200), 0.6  # of the mark, and how much of it covers the colors of the photos
_MOST = 200_000  # points that are marked, evenly of more
_LEAST = 40.0  # height of the window around a small place, in point spacings
WATCHER = "questions"  # name of a thread
_PAUSE = 1.0  # s between looks at whether others answered


class QuestionPanel:
    """One question at a time, the same in all tabs. Nothing is read or computed before Start.

    While something is done, and in the flight to the next place, what is pressed says nothing: nobody
    answers what
    they have not seen.
    """

    def __init__(self, page: Page) -> None:
        self._page, self._busy, self._ended = page, threading.Lock(), threading.Event()
        self._asking: Asking | None = None
        self._asked: Asked | None = None
        self._browsers = set[int]()  # those that take part: they fly along
        self._marked = MarkLayer(page.server, "question", COVER)
        self._commands: list[viser.CommandHandle] = []
        self._on_done: list[Callable[[], None]] = []
        self._shown: list[viser.GuiButtonHandle | viser.GuiInputHandle] = []  # while there is a question
        # label, key and what is done
        self._actions: list[tuple[str, Any, Callable[[], None]]] = [
            (SKIP, SKIP_KEY, self._skip),
            (LOOK, LOOK_KEY, self._look),
        ]
        gui = page.server.gui
        with gui.add_folder("Questions"):
            self._text = gui.add_html(note_html(_HINT))
            self._start = gui.add_button("Start", hint="ask about doubtful places of the labelled cloud")
            self._add_answers(gui)
            self._mark = gui.add_checkbox("mark the place", True, visible=False)
            self._shown.append(self._mark)
            self._steps = gui.add_button_group("Question", (SKIP, LOOK, STOP), visible=False)
            self._line = gui.add_html("")
        steps = {SKIP: self._skip, LOOK: self._look, STOP: self._stop}
        self._start.on_click(partial(self._press, self._begin))
        self._mark.on_update(lambda _: self._redraw())
        self._steps.on_click(lambda event: self._press(steps[self._steps.value], event))

    def _add_answers(self, gui: viser.GuiApi) -> None:
        """A button for each class that a point can be of, and for none of them."""
        table = self._page.display.class_table
        names = [] if table is None else [entry.name for entry in table if entry.surface]
        keys = [*KEYS[: len(names)], *[""] * (len(names) - len(KEYS)), "0"]
        for name, key in zip([*names, None], keys, strict=True):
            action = partial(self._answer, name)
            self._actions.append((name or NONE, key, action))
            button = gui.add_button(f"{key} {name or NONE}".strip(), visible=False)
            button.on_click(partial(self._press, action))
            self._shown.append(button)

    def on_done(self, action: Callable[[], None]) -> None:
        """Call an action after whatever was done here: corrections may have changed."""
        self._on_done.append(action)

    def follow(self) -> None:
        """Take in corrections and labels that were changed elsewhere."""
        asking = self._asking
        if asking is None or asking.is_current:
            return
        with self._busy:
            if self._asking is asking:
                self._try(self._next)

    def close(self) -> None:
        """End all that runs beside the page, which ends."""
        self._ended.set()
        with self._busy:
            self._asking = None

    def _press(self, action: Callable[[], None], event: viser.GuiEvent | viser.CommandEvent) -> None:
        """Do what a button or key of a browser means, if nothing else is being done."""
        if not self._busy.acquire(blocking=False):
            return
        try:
            if event.client is not None:
                self._browsers.add(event.client.client_id)
            self._try(action)
        finally:
            self._busy.release()
        for follow in self._on_done:  # without the lock: they may wait for what waits for it
            follow()

    def _try(self, action: Callable[[], None]) -> None:
        """Do something, and say why it failed; of what changed meanwhile, what is asked now."""
        try:
            try:
                action()
            except StaleError as error:
                self._next(str(error))
        except (Sc3dError, OSError) as error:
            said, self._line.content = self._line.content, note_html(str(error))
            if said != self._line.content:  # `_watch` tries again and again
                logger.warning("%s", error)

    def _begin(self) -> None:
        page = self._page
        self._text.content = note_html("places are looked for ...")
        try:
            count = num_points(page.scene.labelled)
            if count is not None and not page.inspector.has_room(count * _ASKED_BYTES):
                raise InputError(
                    "questions need more memory than the page leaves: sc3d annotate --suggest asks too"
                )
            self._asking = Asking(page.scene, page.inspector.views, lambda _: page.inspector.surface)
        finally:
            self._text.content = note_html(_HINT)
        self._start.visible, self._steps.visible = False, True
        for label, key, action in self._actions:
            command = page.server.gui.add_command(f"Questions: {label}", hotkey=key or None)
            command.on_trigger(partial(self._press, action))
            self._commands.append(command)
        self._ended.clear()
        threading.Thread(target=self._watch, args=(self._asking,), name=WATCHER, daemon=True).start()
        self._next()

    def _watch(self, asking: Asking) -> None:
        """Follow what others do, as long as these questions are asked."""
        while not self._ended.wait(_PAUSE) and self._asking is asking:
            self.follow()
            for follow in self._on_done:
                follow()

    def _stop(self) -> None:
        self._ended.set()
        self._asking = self._asked = None
        self._draw()
        self._page.cameras.hide(())
        for command in self._commands:
            command.remove()
        self._commands.clear()
        for handle in self._shown:
            handle.visible = False
        self._start.visible, self._steps.visible = True, False
        self._text.content, self._line.content = note_html(_HINT), ""

    def _answer(self, name: str | None) -> None:
        if self._asking is not None and self._asked is not None:
            self._asking.answer(self._asked.number, name)
            self._next()

    def _skip(self) -> None:
        if self._asking is not None and self._asked is not None:
            self._asking.skip(self._asked.number)
            self._next()

    def _look(self) -> None:
        self._next()
        self._fly()

    def _next(self, note: str = "") -> None:
        """Show what is asked now; if that is another place than before, fly there."""
        if self._asking is None:
            return
        before, self._asked = self._asked, self._asking.current()
        asked, table = self._asked, self._asking.class_table
        for handle in self._shown:
            handle.visible = asked is not None
        self._line.content = note_html(". ".join(part for part in (note, self._asking.line()) if part))
        if asked is None:
            self._text.content = note_html(_DONE if any(self._asking.counts().values()) else _NOTHING)
        else:
            place = asked.place
            rival = f", some views say <b>{escape(table.name(place.rival))}</b>" if place.rival else ""
            label = (
                f"most labelled <b>{escape(table.name(place.label))}</b>"
                if place.label
                else "most without label"
            )
            text = f"{len(place.rows)} points, {label}{rival}"
            seen = f"What is marked? It is seen best in {escape(asked.shown.view.name)}"
            style = "padding:0 .75em;font-size:.9em"
            keys = f"<br><small>{_KEYS_HINT}</small>"
            self._text.content = f"<div style='{style}'>{text}. {seen}{keys}</div>"
        self._draw()
        if asked is None or before is None or asked.number != before.number:
            self._fly()

    def _redraw(self) -> None:
        with self._busy:
            self._draw()

    def _draw(self) -> None:
        """Mark the place that is asked about; or show it in the colors of the photos, as far as the cloud
        has them.
        """
        asked, display, marked = self._asked, self._page.display, self._mark.value
        if asked is None or not (marked or asked.known.colors is not None):
            self._marked.show(np.zeros((0, 3)), np.zeros((0, 3)), 1.0)
            return
        known, step = asked.known, -(-len(asked.place.rows) // _MOST)
        rows = asked.place.rows[::step]
        colors = np.tile(np.array(_COLOR, np.float32), (len(rows), 1))
        if known.colors is not None:
            tint = _TINT if marked else 0.0
            colors = tint * colors + (1 - tint) * known.colors[rows]
        points = (known.points[rows] - display.origin).astype(np.float32)
        spacing = float(np.sqrt(step)) * display.spacing_at(self._page.cloud.count)
        self._marked.show(points, np.round(colors).astype(np.uint8), spacing)

    def _fly(self) -> None:
        """Take the browsers that take part to the place that is asked about."""
        asked, display = self._asked, self._page.display
        # the eye is on the way to a camera, and others stand around it
        self._page.cameras.hide(() if asked is None else [view.name for view in self._page.views])
        if asked is None:
            return
        points, line = asked.known.points[asked.place.rows] - display.origin, asked.shown.line
        target, least, goals = line.target - display.origin, _LEAST * asked.known.spacing, []
        for number, client in self._page.server.get_clients().items():
            if number in self._browsers:
                aspect, ahead = client.camera.aspect, OrbitCamera.of_client(client).ahead
                goal = OrbitCamera.of_place(points, target, line.towards, line.reach, least, aspect, ahead)
                goals.append((client, goal))
        fly(goals)
