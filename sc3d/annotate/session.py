"""What the annotation page can do to a scene: show photos, read and write strokes, and try them out on a
photo. Knows nothing of HTTP.
"""

from __future__ import annotations

import threading
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np

from sc3d.errors import InputError
from sc3d.io.atomic import require_inside
from sc3d.io.folders import resolved
from sc3d.io.images import read_image
from sc3d.io.json_files import read_json, write_json
from sc3d.io.photo_folder import find_photos, require_within
from sc3d.io.provenance import digest
from sc3d.scene.photo_names import PhotoNames, photo_name
from sc3d.scene.scene import Scene
from sc3d.segmentation.strokes.backend import Strokes, StrokesSettings, shrink
from sc3d.segmentation.strokes.files import BACKGROUND, as_labelme, read_shapes, shown_size

DISPLAY_SIZE = 4096  # px, longest side of the photo in the browser
TRIAL_SIZE = 2048  # px, longest side of the mask that is tried out
# A quick look, with whatever is drawn so far; `sc3d segment` takes its time
QUICK = StrokesSettings(members=2, trees=40, steps=400, calibration_photos=1, require_all=False)


class BusyError(InputError):
    """Another photo is being tried out."""


class Session:
    """A scene that is being annotated."""

    def __init__(self, scene: Scene, start: str | None = None, settings: StrokesSettings = QUICK) -> None:
        """Look at everything first, so that errors come before the page.

        start: name of the photo to show first; its suffix and folders may be missing where that is clear
        Raises InputError if the scene lacks photos, classes or that photo, or holds strokes that cannot be
        read.
        """
        scene.require(scene.classes, scene.images, hint="the page needs classes.json and images/")
        self._scene = scene
        self._check_folder()
        self._settings = settings
        self.class_table = scene.class_table()
        photos = find_photos(scene.images)
        self._names = PhotoNames(photo_name(photo, scene.images) for photo in photos)
        self.photos = dict(zip(map(self._names.key, self._names.names), photos, strict=True))
        self.sizes = {key: shown_size(photo) for key, photo in self.photos.items()}
        self._start = (
            next(iter(self.photos))
            if start is None
            else self._names.key(self._names.one(start, scene.images))
        )
        self._trying, self._writing = threading.Lock(), threading.Lock()
        self._learned: tuple[str, Strokes] | None = None
        self._jpeg = lru_cache(maxsize=4)(self._encode)
        for key in self.photos:
            self.read(key)

    def _check_folder(self) -> None:
        """InputError if the folder of strokes has become a link that leads out of the scene."""
        require_inside(self._scene.path, self._scene.strokes / "any.json")

    def describe(self) -> dict[str, object]:
        """Everything the page shows at its start, as JSON."""
        classes = [{"name": entry.name, "color": list(entry.color)} for entry in self.class_table]
        classes.append({"name": BACKGROUND, "color": [255, 0, 200]})
        photos = []
        for key, photo in self.photos.items():
            width, height = self.sizes[key]
            photos.append(
                {
                    "stem": key,
                    "name": photo_name(photo, self._scene.images),
                    "width": width,
                    "height": height,
                    "strokes": len(self.read(key)),
                }
            )
        return {
            "scene": resolved(self._scene.path).name,
            "start": self._start,
            "classes": classes,
            "photos": photos,
        }

    def key_of(self, name: str) -> str:
        """The key of a photo of that name, under which the page knows it."""
        return self._names.key(name)

    def has(self, name: str) -> bool:
        """Whether there is a photo of that name."""
        return name in self._names.names

    def file(self, key: str) -> Path:
        """Where the strokes of a photo are kept; KeyError for an unknown photo, so that no name leads out of
        the folder.
        """
        name, folder = photo_name(self.photos[key], self._scene.images), self._scene.strokes
        file = self._names.find(folder, name, ".json") or self._names.path(folder, name, ".json")
        self._check_folder()
        require_within(file.parent, folder)
        return file

    def read(self, key: str) -> list[dict[str, object]]:
        """The shapes of a photo's LabelMe file, in px of the photo; none if there is no file."""
        file = self.file(key)
        return self._plain(read_json(file), file, key) if file.exists() else []

    def save(self, key: str, content: object) -> int:
        """Check a drawing like the backend does and write it; a file without shapes is removed. Returns the
        number of shapes.

        content: LabelMe, decoded; fields that strokes do not need are dropped
        """
        shapes = [
            shape | {"group_id": None, "description": "", "flags": {}}
            for shape in self._plain(content, "the drawing", key)
        ]
        width, height = self.sizes[key]
        head: dict[str, object] = {
            "version": "5.5.0",
            "flags": {},
            "imagePath": photo_name(self.photos[key], self._scene.images),
            "imageData": None,
            "imageHeight": height,
            "imageWidth": width,
        }
        with self._writing:  # two windows may save at once
            if shapes:
                write_json(self.file(key), head | {"shapes": shapes})
            else:
                self.file(key).unlink(missing_ok=True)
        return len(shapes)

    def _plain(self, content: object, origin: Path | str, key: str) -> list[dict[str, object]]:
        """The shapes of a LabelMe file, checked, in px of the photo."""
        names = {entry.id: entry.name for entry in self.class_table} | {0: BACKGROUND}
        shapes = read_shapes(content, origin, self.photos[key], self.class_table)
        return [as_labelme(shape, names[shape.label], self.sizes[key]) for shape in shapes]

    def photo(self, key: str) -> bytes:
        """The photo as JPEG, as shown: turned by its EXIF orientation, as in LabelMe; strokes lie in this
        frame.
        """
        return self._jpeg(key)

    def try_out(self, key: str) -> bytes:
        """Learn from all strokes of the scene, if they have changed, and segment a photo.

        returns: RGBA PNG in the colors of the classes, transparent where there is no label; no larger than
            needed
        Raises BusyError while another request does the same.
        """
        photo = self.photos[key]
        if not self._trying.acquire(blocking=False):
            raise BusyError("still learning: wait for the last run to end")
        try:
            self._check_folder()
            state = digest(self._scene.strokes)
            if self._learned is None or self._learned[0] != state:
                self._learned = (
                    state,
                    Strokes.fit(self._scene.strokes, self._scene.images, self.class_table, self._settings),
                )
            labels = self._learned[1].segment(shrink(self._pixels(photo), TRIAL_SIZE)).labels
        finally:
            self._trying.release()
        return _png(
            np.dstack(
                [self.class_table.palette[labels][..., ::-1], np.where(labels > 0, 255, 0).astype(np.uint8)]
            )
        )

    def _pixels(self, photo: Path) -> np.ndarray:
        return read_image(photo, self._scene.images, shown=True)

    def _encode(self, key: str) -> bytes:
        shown = np.ascontiguousarray(shrink(self._pixels(self.photos[key]), DISPLAY_SIZE)[..., ::-1])
        return cv2.imencode(".jpg", shown, [cv2.IMWRITE_JPEG_QUALITY, 90])[1].tobytes()


def _png(image: np.ndarray) -> bytes:
    """PNG of an (H, W, 4) uint8 BGRA image."""
    return cv2.imencode(".png", image)[1].tobytes()
