"""CVAT for images 1.1: one XML file for many photos; a larger z_order lies on top, and of equal ones the
later.

Format: https://docs.cvat.ai/docs/manual/advanced/xml_format. Read by a parser that refuses document type
declarations, and with them entities, which can make a small file fill the memory or read others.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from xml.parsers import expat

from sc3d.errors import InputError
from sc3d.io.json_files import whole_number_of
from sc3d.segmentation.mask_formats.annotations import Annotation, PhotoAnnotations
from sc3d.segmentation.mask_formats.outlines import (
    OutlineError,
    Polygons,
    RunLengths,
    ellipse,
    polygons,
    rectangle,
    run_lengths,
)

WITHOUT_AREA = {"points", "polyline", "cuboid", "skeleton", "tag"}
WITH_AREA = {"polygon", "box", "ellipse", "mask"}


def read_cvat(file: Path) -> Iterator[PhotoAnnotations]:
    """The annotations of a CVAT file, image by image; InputError if it is none, or one for videos."""
    document = _Document(file)
    parser = expat.ParserCreate()
    parser.StartDoctypeDeclHandler = document.refuse
    parser.StartElementHandler = document.start
    parser.EndElementHandler = document.end
    try:
        with file.open("rb") as stream:
            parser.ParseFile(stream)
    except OSError as error:
        raise InputError(f"cannot read {file}: {error.strerror}") from None
    except (expat.ExpatError, ValueError, LookupError) as error:
        raise InputError(f"{file} is not valid XML ({error})") from None
    yield from document.photos


class _Document:
    """What the parser has met so far."""

    def __init__(self, file: Path) -> None:
        self.file = file
        self.photos: list[PhotoAnnotations] = []
        self._depth = 0
        self._image: dict[str, str] | None = None
        self._annotations: list[tuple[int, Annotation]] = []

    def refuse(self, *declaration: object) -> None:
        raise InputError(
            f"{self.file} has a document type declaration, which CVAT never writes: it is refused"
        )

    def start(self, tag: str, attributes: dict[str, str]) -> None:
        if self._depth == 0 and tag != "annotations":
            raise InputError(f"{self.file} is not a CVAT file: <annotations> is expected, not <{tag[:40]}>")
        self._depth += 1
        if tag == "track":
            raise InputError(f"{self.file} is CVAT for video: export the task as 'CVAT for images 1.1'")
        if tag == "image":
            self._image, self._annotations = attributes, []
        elif self._image is not None and tag in WITH_AREA | WITHOUT_AREA:
            outline = partial(_outline, tag, attributes) if tag in WITH_AREA else None
            found = Annotation(tag, (attributes.get("label", ""),), outline)
            self._annotations.append((self._level(attributes), found))

    def end(self, tag: str) -> None:
        self._depth -= 1
        if tag == "image" and self._image is not None:
            size = (self._image.get("width"), self._image.get("height"))
            found = tuple(
                annotation for _, annotation in sorted(self._annotations, key=lambda entry: entry[0])
            )
            photos, stated = (self._image.get("name", ""),), None if None in size else size
            self.photos.append(PhotoAnnotations(str(self.file), photos, stated, found))
            self._image = None

    def _level(self, attributes: dict[str, str]) -> int:
        level = whole_number_of(attributes.get("z_order", 0))
        if level is None:
            raise InputError(
                f"{self.file} has the z_order {attributes['z_order'][:40]!r}: a whole number is expected"
            )
        return level


def _outline(tag: str, attributes: dict[str, str], size: tuple[int, int]) -> Polygons | RunLengths:
    rotation = float(attributes.get("rotation", 0))
    if tag == "polygon":
        pairs = attributes["points"].replace(";", ",").split(",")
        return polygons([pairs], size)
    if tag == "box":
        return rectangle(
            [attributes["xtl"], attributes["ytl"]], [attributes["xbr"], attributes["ybr"]], rotation, size
        )
    if tag == "ellipse":
        return ellipse(
            [attributes["cx"], attributes["cy"]], [attributes["rx"], attributes["ry"]], rotation, size
        )
    left, top, width, height = (_whole(attributes[key]) for key in ("left", "top", "width", "height"))
    if min(left, top, width, height) < 0 or max(left, top, width, height) > max(size):
        raise OutlineError("lies outside of the image")
    return run_lengths(attributes["rle"].split(","), (left, top, width, height), False, size)


def _whole(text: str) -> int:
    found = whole_number_of(text)
    if found is None:
        raise ValueError
    return found
