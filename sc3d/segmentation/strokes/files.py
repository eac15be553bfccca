"""What a user drew on photos: strokes, polygons and colors, read, checked and painted at any size.

LabelMe JSON: shapes of type linestrip, line, point (with `"width": <px>`, which LabelMe keeps although it
does not know it), polygon, rectangle, oriented rectangle, circle and mask; coordinates in px from the upper left corner of the photo as
it is shown (`sc3d.io.orientation`); later shapes cover earlier ones. The label is the name of a class, in any
letter case, or
`_background_` for what belongs to no class. PNG: the colors of the class table; black and transparent pixels
say nothing. A photo may have both, the PNG below.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from sc3d.errors import InputError
from sc3d.io.images import image_size, open_image, read_orientation
from sc3d.io.json_files import read_json, whole_number
from sc3d.io.mask_images import mask_orientation
from sc3d.io.orientation import mask_turn, turned, turned_points, turned_size
from sc3d.io.photo_folder import find_photos
from sc3d.scene.class_table import ClassTable
from sc3d.scene.photo_names import PhotoNames, files_of_photos, photo_name
from sc3d.scene.scene import check_mask_aspect
from sc3d.segmentation.mask_formats.labelme import decode_mask, encode_mask
from sc3d.segmentation.mask_formats.outlines import OutlineError

logger = logging.getLogger(__name__)

BACKGROUND = "_background_"  # LabelMe's own name for it
NOTHING = -1  # a pixel without a stroke; 0 is background
MIN_POINTS = {"point": 1, "line": 2, "linestrip": 1, "polygon": 3, "rectangle": 2, "circle": 2, "mask": 2}
POLYGONS = ("oriented_rectangle", "rotation")  # of LabelMe and X-AnyLabeling, with all their corners
MAX_SHAPES, MAX_POINTS = 10_000, 200_000  # on one photo; nobody draws more
DEFAULT_WIDTH = 0.005  # of a stroke that states none, share of the photo's longest side
_MAX_COORDINATE = 1e5  # px; more cannot be meant, and would overflow the fixed-point coordinates of OpenCV
_SHIFT = 4  # fractional bits of those coordinates
_MAX_THICKNESS = 32767  # px, to OpenCV
_MIN_SHARE = 0.25  # of a reduced pixel that a PNG must cover


@dataclass(frozen=True)
class StrokeShape:
    """One stroke or area.

    label: class id, 0 = background; kind: of `MIN_POINTS`
    points: (N, 2) float64 px of the photo as shown; of a mask, corners of its box
    width: of strokes, px, 0 = default; mask: (H, W) bool pixels of a mask, on a grid of its own over the box
    """

    label: int
    kind: str
    points: np.ndarray
    width: float = 0.0
    mask: np.ndarray | None = None


@dataclass(frozen=True)
class PhotoStrokes:
    """Everything that was drawn on one photo.

    size: (width, height) px of the photo as shown
    shapes: from the bottom to the top
    picture: (H, W) int16 class ids of a PNG, NOTHING elsewhere; None if there is no PNG
    """

    photo: Path
    size: tuple[int, int]
    shapes: tuple[StrokeShape, ...] = ()
    picture: np.ndarray | None = None

    def paint(self, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
        """Draw everything at a size of the photo's aspect.

        returns: (height, width) int16 class ids, 0 = background, NOTHING elsewhere; (height, width) int32
            number of the stroke, from 1 on, 0 elsewhere
        """
        labels, groups, count = (
            np.full((height, width), NOTHING, np.int16),
            np.zeros((height, width), np.int32),
            0,
        )
        if self.picture is not None:
            labels = _reduce(self.picture, width, height)
            groups, count = _components(labels)
        scale = np.array([width, height]) / self.size
        for shape in self.shapes:
            covered = _draw(shape, scale, DEFAULT_WIDTH * max(self.size), (height, width))
            count += 1
            labels[covered], groups[covered] = shape.label, count
        return labels, groups


def read_strokes(folder: Path, photos_folder: Path, class_table: ClassTable) -> list[PhotoStrokes]:
    """Strokes of all photos that have some, ordered by photo.

    Raises InputError for a folder without strokes, files that belong to no photo, cannot be read or name
    unknown classes or colors.
    """
    names = PhotoNames(photo_name(photo, photos_folder) for photo in find_photos(photos_folder))
    files = files_of_photos(folder, names, (".json", ".png"))
    if not files:
        raise InputError(
            f"no strokes in {folder}: draw some with `sc3d annotate SCENE`, or put LabelMe JSON or PNG files there"
        )
    found: dict[Path, PhotoStrokes] = {}
    outside: list[str] = []
    for file in files:
        content = read_json(file) if file.suffix.lower() == ".json" else None
        photo = photos_folder / _photo_of(file, folder, content, names)
        size = shown_size(photo)
        shapes = () if content is None else read_shapes(content, file, photo, class_table)
        outside += [f"{file.name}: shape {index + 1}" for index in _outside(shapes, size)]
        picture = None if content is not None else _read_picture(file, photo, class_table)
        before = found.get(photo, PhotoStrokes(photo, size))
        if shapes and before.shapes:
            raise InputError(
                f"{file} holds strokes of {photo.name}, of which another file has some too: join them"
            )
        found[photo] = PhotoStrokes(
            photo, size, before.shapes + shapes, before.picture if picture is None else picture
        )
    if outside:
        logger.warning(
            "%s: %d shapes lie outside of their photos and are left out, such as %s",
            folder,
            len(outside),
            "; ".join(outside[:3]),
        )
    return [found[photo] for photo in sorted(found)]


def shown_size(photo: Path) -> tuple[int, int]:
    """(width, height) px of a photo as shown."""
    return turned_size(image_size(photo), read_orientation(photo))


def _outside(shapes: tuple[StrokeShape, ...], size: tuple[int, int]) -> list[int]:
    """Indices of the shapes whose box does not reach into the photo; size: (width, height) px."""
    found = []
    for index, shape in enumerate(shapes):
        reach = np.hypot(*(shape.points[1] - shape.points[0])) if shape.kind == "circle" else shape.width
        points = shape.points[:1] if shape.kind == "circle" else shape.points
        low, high = points.min(axis=0) - reach, points.max(axis=0) + reach
        if (high < 0).any() or (low > size).any():
            found.append(index)
    return found


def as_labelme(shape: StrokeShape, label: str, size: tuple[int, int]) -> dict[str, object]:
    """A shape as LabelMe writes it, of a photo of `size`, (width, height) px as shown; label: name of the class."""
    head: dict[str, object] = {"label": label, "shape_type": shape.kind}
    if shape.mask is None:
        return head | {"points": shape.points.tolist()} | ({"width": shape.width} if shape.width else {})
    canvas = _draw_mask(shape.mask, shape.points, size[::-1])
    places = np.argwhere(canvas)
    low, high = places.min(axis=0), places.max(axis=0)
    crop = canvas[low[0] : high[0] + 1, low[1] : high[1] + 1]
    return head | {"points": [low[::-1].tolist(), high[::-1].tolist()], "mask": encode_mask(crop)}


def read_shapes(
    content: object, origin: Path | str, photo: Path, class_table: ClassTable
) -> tuple[StrokeShape, ...]:
    """`parse_shapes` for a photo as shown; shapes whose file states the size of the photo as stored, and not
    as shown, are turned.
    """
    orientation, size = read_orientation(photo), image_size(photo)
    sides = [content.get(key) for key in ("imageWidth", "imageHeight")] if isinstance(content, dict) else []
    stated = [side for side in map(_side, sides) if side]
    if len(stated) < 2 or mask_turn(1, (stated[0], stated[1]), orientation, size)[0] != 1:
        return parse_shapes(content, origin, turned_size(size, orientation), class_table)
    return tuple(
        replace(
            shape,
            points=turned_points(shape.points, size, orientation),
            mask=None if shape.mask is None else turned(shape.mask, orientation),
        )
        for shape in parse_shapes(content, origin, size, class_table)
    )


def parse_shapes(
    content: object, origin: Path | str, size: tuple[int, int], class_table: ClassTable
) -> tuple[StrokeShape, ...]:
    """The shapes of a decoded LabelMe file, scaled to the photo; InputError if something is wrong.

    origin: names the file in messages; size: (width, height) px of the photo that they were drawn on
    """
    shapes = content.get("shapes") if isinstance(content, dict) else None
    if not isinstance(content, dict) or not isinstance(shapes, list):
        raise InputError(f"{origin} is not a LabelMe file: it has no list of shapes")
    _check_amount(shapes, origin)
    drawn = _drawn_size(content, origin, size)
    return tuple(
        _parse_shape(shape, f"{origin}: shape {index + 1}", class_table, drawn, max(size) / max(drawn))
        for index, shape in enumerate(shapes)
    )


def _check_amount(shapes: list, origin: Path | str) -> None:
    lists = [shape.get("points") for shape in shapes if isinstance(shape, dict)]
    points = sum(len(found) for found in lists if isinstance(found, list))
    if len(shapes) > MAX_SHAPES or points > MAX_POINTS:
        raise InputError(
            f"{origin} has {len(shapes)} shapes with {points} points: "
            f"at most {MAX_SHAPES} with {MAX_POINTS} are drawn"
        )


def _drawn_size(content: dict, origin: Path | str, size: tuple[int, int]) -> tuple[int, int]:
    """(width, height) px that a file states, that of the photo where it states none."""
    stated = (content.get("imageWidth"), content.get("imageHeight"))
    if stated == (None, None):
        return size
    width, height = map(_side, stated)
    if not width or not height:
        raise InputError(f"{origin}: imageWidth and imageHeight must be whole numbers of px")
    check_mask_aspect(origin, (width, height), size)
    return width, height


def _side(value: object) -> int:
    """A side of an image in px; 0 if it is none."""
    side = whole_number(value)
    return side if side is not None and 0 < side < _MAX_COORDINATE else 0


def _parse_shape(
    shape: object, origin: str, class_table: ClassTable, drawn: tuple[int, int], scale: float
) -> StrokeShape:
    """drawn: (width, height) px of the image that it was drawn on; scale: from that to the photo"""
    if not isinstance(shape, dict):
        raise InputError(f"{origin} is not an object")
    name, kind = shape.get("label"), shape.get("shape_type") or "polygon"
    kind = "polygon" if kind in POLYGONS else kind
    label = _label(name, class_table)
    if label is None:
        known = ", ".join([*(entry.name for entry in class_table), BACKGROUND])
        raise InputError(
            f"{origin} is of the class {str(name)[:40]!r}, which is not in the class table: one of {known}"
        )
    if not isinstance(kind, str) or kind not in MIN_POINTS:
        raise InputError(f"{origin} is a {str(kind)[:40]!r}: possible are {', '.join(MIN_POINTS)}")
    points, width = shape.get("points"), shape.get("width", 0)
    if not isinstance(points, list) or not all(
        isinstance(point, list) and len(point) == 2 and all(map(_is_number, point)) for point in points
    ):
        raise InputError(f"{origin}: points must be a list of [x, y] in px")
    if len(points) < MIN_POINTS[kind]:
        raise InputError(f"{origin}: a {kind} needs at least {MIN_POINTS[kind]} points")
    if not _is_number(width) or width < 0:
        raise InputError(f"{origin}: width must be a number of px")
    placed = np.array(points, np.float64).reshape(-1, 2) * scale
    if not (np.abs(placed) < _MAX_COORDINATE).all():
        raise InputError(f"{origin}: points must be a list of [x, y] in px")
    if kind == "mask":
        return _parse_mask(shape, origin, label, drawn, scale)
    return StrokeShape(label, kind, placed, float(width) * scale)


def _label(name: object, class_table: ClassTable) -> int | None:
    """Class id of a name in any letter case, 0 for `BACKGROUND`; None if there is none."""
    if not isinstance(name, str):
        return None
    return 0 if name.strip().casefold() == BACKGROUND else class_table.find(name)


def _parse_mask(shape: dict, origin: str, label: int, drawn: tuple[int, int], scale: float) -> StrokeShape:
    try:
        left, top, mask = decode_mask(shape.get("mask", ""), shape["points"], drawn)
    except (OutlineError, TypeError, ValueError) as error:
        raise InputError(f"{origin}: the mask {error}") from None
    if not mask.any():
        raise InputError(f"{origin}: the mask has no pixels")
    corners = np.array([[left, top], [left + mask.shape[1], top + mask.shape[0]]], np.float64) * scale
    return StrokeShape(label, "mask", corners, mask=mask)


def _is_number(value: object) -> bool:
    return (
        isinstance(value, int | float)
        and not isinstance(value, bool)
        and abs(value) < _MAX_COORDINATE  # false for what is not a number, too
    )


def _photo_of(file: Path, folder: Path, content: object, names: PhotoNames) -> str:
    """The photo that `imagePath` names, with the folder of the file where that is not clear, or else the one
    that the file is named after.
    """
    path, place = content.get("imagePath") if isinstance(content, dict) else None, photo_name(file, folder)
    for changed in (False, True):
        found = names.match(path, changed) if isinstance(path, str) else ()
        if len(found) != 1:
            own = names.match_file(place, folder, changed)
            found = tuple(name for name in own if name in found) or found or own
        if len(found) == 1:
            own = names.match_file(place, folder, False)
            if own and found[0] not in own:
                raise InputError(
                    f"{file} is named after the photo {own[0]}, but its imagePath says {found[0]}: correct one of them"
                )
            return found[0]
        if found:
            raise InputError(f"{file} may belong to {names.choices(found, file.suffix)}: rename it")
    raise InputError(
        f"{file} belongs to no photo: {len(names)} photos are known, such as {names.names[0]}{names.advice(place)}"
    )


def _read_picture(file: Path, photo: Path, class_table: ClassTable) -> np.ndarray:
    """(H, W) int16 class ids of a PNG in the colors of the class table, on the photo as shown, NOTHING where
    it is black or transparent.
    """
    onto, photo_size = mask_orientation(file, photo)[0], image_size(photo)
    check_mask_aspect(file, turned_size(image_size(file), onto), photo_size)
    with open_image(file, "picture of strokes") as image:
        rgba = np.array(image.convert("RGBA"))
    codes = (rgba[..., :3].astype(np.int32) * [65536, 256, 1]).sum(axis=-1)
    codes[rgba[..., 3] == 0] = 0
    values, places = np.unique(codes, return_inverse=True)
    ids = {
        (red << 16) + (green << 8) + blue: entry.id
        for entry in class_table
        for red, green, blue in [entry.color]
    } | {0: NOTHING}
    unknown = [int(value) for value in values if int(value) not in ids]
    if unknown:
        raise InputError(
            f"{file} has the color #{unknown[0]:06x}, which is not in the class table: draw without smoothing, and not as JPEG"
        )
    labels = np.array([ids[int(value)] for value in values], np.int16)[places].reshape(codes.shape)
    return turned(turned(labels, onto), read_orientation(photo))


def _reduce(picture: np.ndarray, width: int, height: int) -> np.ndarray:
    """The class that covers most of each reduced pixel, if it covers a quarter of it: thin strokes must not
    vanish.
    """
    ids = np.unique(picture[picture != NOTHING])
    if not len(ids):
        return np.full((height, width), NOTHING, np.int16)
    shares = np.stack(
        [
            cv2.resize((picture == label).astype(np.float32), (width, height), interpolation=cv2.INTER_AREA)
            for label in ids
        ]
    )
    return np.where(shares.max(axis=0) >= _MIN_SHARE, ids[shares.argmax(axis=0)], NOTHING).astype(np.int16)


def _components(labels: np.ndarray) -> tuple[np.ndarray, int]:
    """Connected areas of one class, numbered from 1 on; their number."""
    groups, count = np.zeros(labels.shape, np.int32), 0
    for label in np.unique(labels[labels != NOTHING]):
        number, parts = cv2.connectedComponents((labels == label).astype(np.uint8))
        groups[parts > 0] = parts[parts > 0] + count
        count += number - 1
    return groups, count


def _draw(shape: StrokeShape, scale: np.ndarray, default_width: float, size: tuple[int, int]) -> np.ndarray:
    """(H, W) bool pixels that a shape covers, at least one unless it lies outside; scale: (2,) of x and y;
    size: (H, W).
    """
    if shape.mask is not None:
        return _draw_mask(shape.mask, shape.points * scale, size)
    canvas, points = np.zeros(size, np.uint8), shape.points
    if shape.kind == "circle":
        angles = np.linspace(0, 2 * np.pi, 64, endpoint=False)
        points = points[0] + np.hypot(*(points[1] - points[0])) * np.stack(
            [np.cos(angles), np.sin(angles)], axis=1
        )
    elif shape.kind == "rectangle":
        (left, top), (right, bottom) = points.min(axis=0), points.max(axis=0)
        points = np.array([[left, top], [right, top], [right, bottom], [left, bottom]])
    # OpenCV counts from the center of the first pixel
    fixed = [np.rint((points * scale - 0.5) * 2**_SHIFT).astype(np.int32)]
    if shape.kind in ("polygon", "rectangle", "circle"):
        cv2.fillPoly(canvas, fixed, 1, shift=_SHIFT)
    else:
        thickness = min(max(1, round((shape.width or default_width) * float(scale.mean()))), _MAX_THICKNESS)
        # a single point is no line to OpenCV
        cv2.polylines(canvas, [np.concatenate([fixed[0], fixed[0][-1:]])], False, 1, thickness, shift=_SHIFT)
    return canvas > 0


def _draw_mask(mask: np.ndarray, corners: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """(H, W) bool pixels whose centers lie on pixels of a mask, or the one under its first pixel if none does.

    corners: (2, 2) x, y of its box, px; size: (H, W)
    """
    low, high = corners.min(axis=0), corners.max(axis=0)
    cells = (high - low) / mask.shape[::-1]
    columns, rows = (
        np.floor((np.arange(count) + 0.5 - low[axis]) / cells[axis]).astype(int)
        for axis, count in enumerate(size[::-1])
    )
    canvas = np.zeros(size, bool)
    inside = [
        (index >= 0) & (index < count) for index, count in zip((rows, columns), mask.shape, strict=True)
    ]
    canvas[np.ix_(*inside)] = mask[np.ix_(rows[inside[0]], columns[inside[1]])]
    if mask.any() and not canvas.any():
        first = (np.argwhere(mask)[0][::-1] + 0.5) * cells + low
        column, row = np.clip(first.astype(int), 0, np.array(size[::-1]) - 1)
        canvas[row, column] = True
    return canvas
