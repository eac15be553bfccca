"""What the page of `sc3d annotate --suggest` can do: show the place that is asked about in the photo that
sees it
best, and take the answer. Knows nothing of HTTP.
"""

from __future__ import annotations

import cv2
import numpy as np

from sc3d.annotate.asking import Asked, Asking, StaleError
from sc3d.annotate.session import Session
from sc3d.errors import InputError
from sc3d.geometry.cameras import local_origin, project
from sc3d.io.images import read_orientation
from sc3d.io.orientation import turned
from sc3d.scene.labelled_cloud import read_surface
from sc3d.scene.scene import Scene

SMALLEST = 2.5  # px, half width of a point in an outline


class Suggestions(Session):
    """A scene whose labels are questioned."""

    def __init__(self, scene: Scene) -> None:
        """Look at everything first, so that errors come before the page.

        Raises InputError if the scene lacks labels, cameras, photos or classes.
        """
        super().__init__(scene)
        scene.require(scene.sparse, hint="the page shows places in photos that have a camera")
        views = [view for view in scene.model.views if self.has(view.name)]
        self._asking = Asking(
            scene, views, lambda points: read_surface(scene.surface, points, None, local_origin(views))
        )

    def question(self) -> dict[str, object]:
        """The place that is asked about now, as JSON; `place` is None if there is none left."""
        asked = self._asking.current()
        head = {
            "classes": [
                {"name": entry.name, "color": list(entry.color)}
                for entry in self.class_table
                if entry.surface
            ],
            "own": self._asking.num_own,
            "line": self._asking.line(),
        } | self._asking.counts()
        if asked is None:
            return head | {"place": None}
        place, view = asked.place, asked.shown.view
        key = self.key_of(view.name)
        width, height = self.sizes[key]
        return head | {
            "place": asked.number,
            "stem": key,
            "name": view.name,
            "width": width,
            "height": height,
            "outline": self._outline(asked, key),
            "label": self.class_table.name(place.label),
            "rival": self.class_table.name(place.rival) if place.rival else None,
            "points": len(place.rows),
        }

    def answer(self, place: object, name: object) -> dict[str, object]:
        """Write down that a place is of a class (None: of none of the classes); returns the next question.

        Raises StaleError for a place that is not the one asked about, InputError for no class of a point.
        """
        if name is not None and not isinstance(name, str):
            raise InputError("an answer needs a class: a name, or null for none")
        self._asking.answer(_number(place), name)
        return self.question()

    def skip(self, place: object) -> dict[str, object]:
        """Leave a place out; returns the next question. StaleError as for `answer`."""
        self._asking.skip(_number(place))
        return self.question()

    def undo(self) -> dict[str, object]:
        """Take the last answer of this page back, so that it is asked again; without one, the question as
        it is.

        Raises StaleError if it does not stand any more.
        """
        self._asking.undo()
        return self.question()

    def line(self) -> str:
        """How much is left, and how sure the rest is."""
        return self._asking.line()

    def _outline(self, asked: Asked, key: str) -> list[list[list[int]]]:
        """Polygons around the points of a place, px of the photo as shown."""
        view, known = asked.shown.view, asked.known
        pixels, depth = project(view, known.points[asked.shown.rows])
        mask = np.zeros((view.height, view.width), np.uint8)
        radius = np.maximum(SMALLEST, known.spacing * view.focal / np.maximum(depth, 1e-9))
        for (x, y), size in zip(pixels, radius, strict=True):
            cv2.circle(mask, (int(x), int(y)), int(np.ceil(size)), 1, -1)
        lying = np.ascontiguousarray(turned(mask, read_orientation(self.photos[key])))
        contours, _ = cv2.findContours(lying, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_TC89_L1)
        return [contour[:, 0].tolist() for contour in contours if len(contour) > 2]


def _number(place: object) -> int:
    if not isinstance(place, int) or isinstance(place, bool):
        raise StaleError("an answer needs the number of the place that it is about")
    return place
