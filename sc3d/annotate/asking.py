"""Asking about the doubtful places of a scene, one after the other, whatever page shows them: which is
asked about, what an answer writes, and what was answered or taken back elsewhere.

What counts as answered is what `corrections.json` says, so that pages, tabs and programs follow one another.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sc3d.annotate.best_photo import BestPhoto, Shown
from sc3d.annotate.questions import LEAST, Evidence, Place, rank_places
from sc3d.errors import InputError
from sc3d.geometry.cameras import View
from sc3d.geometry.raycast import RayTarget
from sc3d.io.atomic import file_state
from sc3d.scene.corrections import Corrections, add_correction, undo
from sc3d.scene.labelled_cloud import Votes, read_labelled, read_votes, spacing_of
from sc3d.scene.labels import CORRECTED
from sc3d.scene.scene import Scene
from sc3d.scene.selection import balls_within


class StaleError(InputError):
    """What was meant has changed elsewhere: the answer is to a place that is not asked about any more, or
    the answer that should be taken back does not stand.
    """


@dataclass(frozen=True)
class Asked:
    """What is asked about. number: which is never given again, also after new labels; place: its points
    that are not corrected; shown: the photo that sees it best; known: of the points
    """

    number: int
    place: Place
    shown: Shown
    known: Evidence


class Asking:
    """The questions of a scene. Those first where an answer changes most, but for the places that are
    answered, skipped, or in no photo. All methods look first at what changed in the scene's files, and may be called by
    several threads.
    """

    def __init__(
        self, scene: Scene, views: Sequence[View], surface: Callable[[np.ndarray], RayTarget]
    ) -> None:
        """views: in which places may be shown; surface: makes what hides the points (N, 3) of the cloud

        Raises InputError if the scene lacks labels or classes.
        """
        self.class_table = scene.class_table()
        self._scene, self._views, self._make_surface = scene, views, surface
        self._lock = threading.RLock()
        self._own, self._first, self._places = list[str](), 0, list[Place]()
        self._asked: Asked | None = None
        self._num_open = np.zeros(0, np.int64)  # points of each place that are not corrected
        self._load()

    @property
    def is_current(self) -> bool:
        """Whether neither labels nor corrections have changed since they were looked at."""
        return (self._labelled, self._corrected) == self._states()

    def current(self) -> Asked | None:
        """What is asked about now; None if nothing is left."""
        with self._lock:
            self._follow()
            for index in np.flatnonzero(self._num_open >= LEAST).tolist():
                if index in self._skipped or index in self._unseen:
                    continue
                place = self._places[index]
                rows = place.rows[~self._settled[place.rows]]
                if self._asked is None or not np.array_equal(self._asked.place.rows, rows):
                    self._asked = self._show(index, replace(place, rows=rows))
                if self._asked is not None:
                    return self._asked
                self._unseen.add(index)
            self._asked = None
            return None

    def answer(self, number: int, name: str | None) -> None:
        """Write down that the place of that number is of a class (None: of none of the classes).

        Raises StaleError for a place that is not the one asked about, InputError for no class of a point.
        """
        with self._lock:
            found = self._require(number)
            shape = balls_within(found.known.points, found.place.rows, found.known.spacing)
            self._own.append(add_correction(self._scene, name, shape))

    def skip(self, number: int) -> None:
        """Leave the place of that number out. StaleError as for `answer`."""
        with self._lock:
            self._require(number)
            self._skipped.add(number - self._first)

    def undo(self) -> None:
        """Take back the last answer that was given here; without one, nothing happens.

        Raises StaleError if it does not stand any more; then the next time takes back the one before.
        """
        with self._lock:
            if self._own and undo(self._scene, self._own.pop()) is None:
                raise StaleError("the last answer of this page was taken back elsewhere already")

    @property
    def num_own(self) -> int:
        """Answers that were given here and not taken back here."""
        return len(self._own)

    def counts(self) -> dict[str, int]:
        """How many places are answered, skipped, in no photo as far as known, and left."""
        with self._lock:
            self._follow()
            is_open = self._num_open >= LEAST
            skipped, unseen = (
                sum(is_open[index] for index in kind) for kind in (self._skipped, self._unseen)
            )
            answered = int(np.count_nonzero(~is_open))
            left = len(is_open) - answered - int(skipped) - int(unseen)
            return {"answered": answered, "skipped": int(skipped), "unseen": int(unseen), "left": left}

    def line(self) -> str:
        """How much is left, and how sure the rest is by its confidences."""
        with self._lock:
            counts = self.counts()
            rest = ~self._settled
            wrong, total = float(self._unsure[rest].sum()), int(np.count_nonzero(rest))
        unseen = f", {counts['unseen']} in no photo" if counts["unseen"] else ""
        return (
            f"{counts['answered']} answered, {counts['skipped']} skipped{unseen},"
            f" {counts['left']} places left; about {wrong:.0f} of {total} points may be wrong:"
            f" the rest is {1 - wrong / max(total, 1):.1%} sure"
        )

    def _require(self, number: int) -> Asked:
        found = self.current()
        if found is None or found.number != number:
            raise StaleError(
                "this place was answered, or others were taken back, elsewhere: nothing is written"
            )
        return found

    def _show(self, index: int, place: Place) -> Asked | None:
        shown = self._photos.find(place.rows)
        return None if shown is None else Asked(self._first + index, place, shown, self._known)

    def _states(self) -> tuple[tuple[int, ...] | None, tuple[int, ...] | None]:
        return file_state(self._scene.labelled), file_state(self._scene.corrections)

    def _follow(self) -> None:
        """Take in what has changed in the scene's files since."""
        labelled, corrected = self._states()
        if labelled != self._labelled:
            self._load()
        elif corrected != self._corrected:
            self._settle()

    def _load(self) -> None:
        """Start anew with the labels that there are now."""
        labelled, _ = self._states()  # before they are read: what comes after is not missed
        known = evidence_of_scene(self._scene)
        places = rank_places(known)
        self._first += len(self._places)
        sizes = np.array([len(place.rows) for place in places], np.int64)
        self._known, self._places = known, places
        self._rows = np.concatenate([np.zeros(0, np.int64), *(place.rows for place in places)])
        self._place_of = np.repeat(np.arange(len(places)), sizes)
        unsure = np.where(known.label == 0, 1, 1 - known.confidence.astype(np.float64))
        self._unsure = np.where(known.state == CORRECTED, 0, unsure)
        self._skipped, self._unseen = set[int](), set[int]()
        self._asked = None
        self._photos = BestPhoto(known, self._views, lambda: self._make_surface(known.points))
        self._inside = dict[str, np.ndarray]()  # rows of the cloud, by the key of a correction
        self._settle()
        self._labelled = labelled

    def _settle(self) -> None:
        """See which points are corrected, in whatever way, and how many of each place are not."""
        _, corrected = self._states()
        found = Corrections.of_scene(self._scene)
        self._settled = np.zeros(len(self._known.points), bool)
        for row, one in enumerate(found.corrections):
            if one.key not in self._inside:
                self._inside[one.key] = np.flatnonzero(found.contain(row, self._known.points))
            self._settled[self._inside[one.key]] = True
        is_open = self._place_of[~self._settled[self._rows]]
        self._num_open = np.bincount(is_open, minlength=len(self._places))
        self._corrected = corrected


def evidence_of_scene(scene: Scene) -> Evidence:
    """The labels of a scene and the votes that they are from, without the corrections that they do not
    have yet.
    """
    cloud, labels = read_labelled(scene.labelled, "propagate")
    points = cloud.point.positions.numpy().astype(np.float64)
    votes = _votes(scene, len(points))
    if votes is None:
        ids = scene.class_table().channels.ids[1:]
        values = np.zeros((len(points), len(ids)), np.float32)
    else:
        ids = votes.channels.ids[1:]
        values = votes.values[:, 1 : len(ids) + 1]
    return Evidence(
        points,
        labels.label,
        labels.confidence,
        labels.state,
        values,
        ids,
        cloud.point.colors.numpy() if "colors" in cloud.point else None,
        spacing_of(points),
    )


def _votes(scene: Scene, count: int) -> Votes | None:
    """Of the points of the labelled cloud, which are those of the seeds; None if it was made without."""
    if not scene.seeds.exists():
        return None
    seeds, _ = read_labelled(scene.seeds, "label")
    if len(seeds.point.positions) != count:
        raise InputError(
            f"{scene.labelled} and {scene.seeds} are not of the same points: run `sc3d propagate` again"
        )
    return read_votes(seeds)
