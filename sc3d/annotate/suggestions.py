"""What the page of `sc3d annotate --suggest` can do: show the place where an answer changes most, in the
photo that sees it best, and write the answer down as a correction. Knows nothing of HTTP.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass

import cv2
import numpy as np

from sc3d.annotate.questions import Evidence, Place, rank_places
from sc3d.annotate.session import Session
from sc3d.errors import InputError
from sc3d.geometry.cameras import View, in_image, local_origin, project, rays
from sc3d.geometry.raycast import RayTarget
from sc3d.io.images import read_orientation
from sc3d.io.orientation import turned
from sc3d.scene.corrections import Corrections, add_correction, undo
from sc3d.scene.labelled_cloud import Votes, read_labelled, read_surface, read_votes, spacing_of
from sc3d.scene.labels import CORRECTED
from sc3d.scene.scene import Scene
from sc3d.scene.selection import balls_within

PROBES = 200  # points of a place that are looked for in photos
CANDIDATES = 8  # photos in which the place is largest, of which one is taken that sees most of it
RANGE_TOLERANCE = (
    0.01  # of the range, and two point spacings: how far behind the first surface a point is seen
)
LEAST_SEEN = 0.2  # share of a place that a photo must see
ALMOST = 0.98  # of the most that any of these photos sees: then the one that shows it largest is taken
SMALLEST = 2.5  # px, half width of a point in an outline


class StaleError(InputError):
    """The answer is to a place that is not asked about any more."""


@dataclass(frozen=True)
class Shown:
    """Where a place is seen: the view, and the rows of its points that are."""

    view: View
    rows: np.ndarray


class Suggestions(Session):
    """A scene whose labels are questioned. Undo takes back what was answered here, one by one."""

    def __init__(self, scene: Scene) -> None:
        """Look at everything first, so that errors come before the page.

        Raises InputError if the scene lacks labels, cameras, photos or classes.
        """
        super().__init__(scene)
        scene.require(scene.sparse, hint="the page shows places in photos that have a camera")
        self._known = evidence_of_scene(scene)
        self._views = [view for view in scene.model.views if self.has(view.name)]
        self._places = rank_places(self._known)
        unsure = 1 - self._known.confidence.astype(np.float64)
        unsure[self._known.label == 0] = 1
        self._unsure = np.where(self._known.state == CORRECTED, 0, unsure)
        self._lock = threading.Lock()
        self._next, self._answered, self._skipped = 0, list[int](), set[int]()
        self._surface: RayTarget | None = None
        self._unseen = set[int]()

    def question(self) -> dict[str, object]:
        """The place that is asked about now, as JSON; `place` is None if there is none left."""
        with self._lock:
            return self._question()

    def answer(self, place: object, name: object) -> dict[str, object]:
        """Write down that a place is of a class (None: of none of the classes); returns the next question.

        Raises StaleError for a place that is not the one asked about, InputError for no class of a point.
        """
        with self._lock:
            self._require_current(place)
            if name is not None and not isinstance(name, str):
                raise InputError("an answer needs a class: a name, or null for none")
            rows = self._places[self._next].rows
            known = self._known
            add_correction(self._scene, name, balls_within(known.points, rows, known.spacing))
            self._answered.append(self._next)
            self._next += 1
            return self._question()

    def skip(self, place: object) -> dict[str, object]:
        """Leave a place out; returns the next question."""
        with self._lock:
            self._require_current(place)
            self._skipped.add(self._next)
            self._next += 1
            return self._question()

    def undo(self) -> dict[str, object]:
        """Take the last answer of this page back and ask it again; without one, the question as it is."""
        with self._lock:
            if self._answered and undo(self._scene) is not None:
                self._next = self._answered.pop()
                self._skipped = {one for one in self._skipped if one < self._next}
            return self._question()

    def _require_current(self, place: object) -> None:
        if place != self._next or self._next >= len(self._places):
            raise StaleError("this place was answered in another window: reload the page")

    def _question(self) -> dict[str, object]:
        shown = None
        while self._next < len(self._places) and shown is None:
            shown = self._best_photo(self._places[self._next])
            if shown is None:  # no photo can be asked about it
                self._unseen.add(self._next)
                self._next += 1
        head = {
            "classes": [
                {"name": entry.name, "color": list(entry.color)}
                for entry in self.class_table
                if entry.surface
            ],
            "answered": len(self._answered),
            "skipped": len(self._skipped),
            "line": self.line(),
        }
        if shown is None:
            return head | {"place": None}
        place = self._places[self._next]
        key = self.key_of(shown.view.name)
        width, height = self.sizes[key]
        return head | {
            "place": self._next,
            "stem": key,
            "name": shown.view.name,
            "width": width,
            "height": height,
            "outline": self._outline(shown, key),
            "label": self.class_table.name(place.label),
            "rival": self.class_table.name(place.rival) if place.rival else None,
            "points": len(place.rows),
        }

    def line(self) -> str:
        """How much is left, and how sure the rest is by its confidences."""
        settled = np.zeros(len(self._unsure), bool)
        for row in self._answered:
            settled[self._places[row].rows] = True
        rest = ~settled
        wrong = float(self._unsure[rest].sum())
        sure = 1 - wrong / max(int(rest.sum()), 1)
        left = len(self._places) - self._next
        unseen = f", {len(self._unseen)} in no photo" if self._unseen else ""
        return (
            f"{len(self._answered)} answered, {len(self._skipped)} skipped{unseen}, {left} places left;"
            f" about {wrong:.0f} of {int(rest.sum())} points may be wrong: the rest is {sure:.1%} sure"
        )

    def _best_photo(self, place: Place) -> Shown | None:
        """Where most of a place is seen, large; None if no photo sees enough of it."""
        probes = place.rows[:: max(1, len(place.rows) // PROBES)]
        points = self._known.points[probes]
        sizes = []
        for view in self._views:
            pixels, depth = project(view, points)
            inside = in_image(view, pixels) & (depth > 0)
            near = float(np.median(depth[inside])) if inside.any() else np.inf
            sizes.append(float(inside.mean()) * (view.focal / near) ** 2)
        candidates = np.argsort(-np.array(sizes), kind="stable")[:CANDIDATES]
        seen = np.array([self._seen(self._views[index], points).mean() for index in candidates])
        if not len(seen) or seen.max() < LEAST_SEEN:
            return None
        found = self._views[candidates[np.argmax(seen >= ALMOST * seen.max())]]  # the largest of them
        return Shown(found, place.rows[self._seen(found, self._known.points[place.rows])])

    def _seen(self, view: View, points: np.ndarray) -> np.ndarray:
        """(N,) bool points that lie in the image and not behind the first surface."""
        if self._surface is None:
            origin = local_origin(self._views)
            self._surface = read_surface(self._scene.surface, self._known.points, None, origin)
        pixels, _ = project(view, points)
        inside = in_image(view, pixels)
        directions, _ = rays(view, pixels[inside])
        reach, _ = self._surface.cast(view, (directions @ view.cam_from_world[:3, :3].T).astype(np.float32))
        distance = np.linalg.norm(points[inside] - view.center, axis=1)
        seen = np.zeros(len(points), bool)
        seen[inside] = distance <= reach + 2 * self._known.spacing + RANGE_TOLERANCE * distance
        return seen

    def _outline(self, shown: Shown, key: str) -> list[list[list[int]]]:
        """Polygons around the points of a place, px of the photo as shown."""
        view = shown.view
        pixels, depth = project(view, self._known.points[shown.rows])
        mask = np.zeros((view.height, view.width), np.uint8)
        radius = np.maximum(SMALLEST, self._known.spacing * view.focal / np.maximum(depth, 1e-9))
        for (x, y), size in zip(pixels, radius, strict=True):
            cv2.circle(mask, (int(x), int(y)), int(np.ceil(size)), 1, -1)
        lying = np.ascontiguousarray(turned(mask, read_orientation(self.photos[key])))
        contours, _ = cv2.findContours(lying, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_TC89_L1)
        return [contour[:, 0].tolist() for contour in contours if len(contour) > 2]


def evidence_of_scene(scene: Scene) -> Evidence:
    """The labels of a scene and the votes that they are from; what was corrected since is certain."""
    cloud, labels = read_labelled(scene.labelled, "propagate")
    points = cloud.point.positions.numpy().astype(np.float64)
    labels, _ = Corrections.of_scene(scene).apply(labels, points)
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
