"""COCO instances: one JSON file for many photos, polygons or run-length codes.

Format: https://cocodataset.org/#format-data. The format has no order, and its own tools refuse overlaps: here
the smaller region wins, so that a car stays on its road. Crowd regions count as their class, because CVAT and
Datumaro mark every mask that is not a polygon as one.
"""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Container, Iterator
from functools import partial
from pathlib import Path

import numpy as np

from sc3d.errors import InputError
from sc3d.io.json_files import read_json, whole_number_of
from sc3d.segmentation.mask_formats.annotations import Annotation, PhotoAnnotations
from sc3d.segmentation.mask_formats.outlines import (
    OutlineError,
    Polygons,
    RunLengths,
    numbers,
    polygons,
    run_lengths,
)


def read_coco(file: Path) -> Iterator[PhotoAnnotations]:
    """The annotations of a COCO file, image by image; InputError if it is none."""
    content = read_json(file)
    images, annotations, categories = (
        _entries(content, key, file) for key in ("images", "annotations", "categories")
    )
    images = list({json.dumps(image, sort_keys=True): image for image in images}.values())
    names = _names(categories, file)
    by_image = defaultdict(list)
    for annotation in annotations:
        by_image[_id(annotation, "image_id", file)].append(annotation)
    known = [_id(image, "id", file) for image in images]
    strangers = by_image.keys() - set(known)
    if strangers:
        raise InputError(
            f"{file} has annotations of an image that it does not list, id {_shown(min(strangers, key=str))}: "
            "add it to images, or take them out"
        )
    _check_once(images, known, by_image, file)
    for image, image_id in zip(images, known, strict=True):
        photo, size = str(image.get("file_name", "")), (image.get("width"), image.get("height"))
        found = tuple(_annotation(entry, names, file) for entry in by_image[image_id])
        photos = (*_original_name(image), photo)
        yield PhotoAnnotations(str(file), photos, None if None in size else size, found, smaller_on_top=True)


def _names(categories: list[dict], file: Path) -> dict[int | str, str]:
    """Names of the categories by id; InputError if two have one id."""
    names: dict[int | str, str] = {}
    for category in categories:
        number, name = _id(category, "id", file), str(category.get("name", ""))
        if names.setdefault(number, name) != name:
            raise InputError(
                f"{file} gives the id {_shown(number)} to two categories, {_shown(names[number])} and {_shown(name)}: "
                "give each its own"
            )
    return names


def _check_once(
    images: list[dict], ids: list[int | str], annotated: Container[int | str], file: Path
) -> None:
    """InputError if two images have one id, or one name and annotations both."""
    by_id, by_name = dict[int | str, str](), dict[str, int | str]()
    for image, number in zip(images, ids, strict=True):
        name = str(image.get("file_name", ""))
        if number in by_id:
            raise InputError(
                f"{file} gives the id {_shown(number)} to two images, {_shown(by_id[number])} and {_shown(name)}: "
                "give each its own, or leave one"
            )
        by_id[number] = name
        if number in annotated and name and name in by_name:
            raise InputError(
                f"{file} lists the image {_shown(name)} twice, as id {_shown(by_name[name])} and {_shown(number)}, both with "
                "annotations: give them to one"
            )
        if number in annotated:
            by_name[name] = number


def _shown(value: object) -> str:
    return repr(str(value)[-80:])[1:-1]


def _original_name(image: dict) -> tuple[str, ...]:
    """Name of the photo before Roboflow renamed it."""
    extra = image.get("extra")
    name = extra.get("name") if isinstance(extra, dict) else None
    return (name,) if isinstance(name, str) and name else ()


def _entries(content: object, key: str, file: Path) -> list[dict]:
    entries = content.get(key) if isinstance(content, dict) else None
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise InputError(
            f"{file} is not a COCO file of instances: lists of images, annotations and categories are expected"
        )
    return entries


def _id(entry: dict, key: str, file: Path) -> int | str:
    found, value = whole_number_of(entry.get(key)), entry.get(key)  # some programs write 7 as 7.0 or "7"
    if found is None and not isinstance(value, str):
        raise InputError(f"{file} is not a COCO file of instances: an entry lacks its {key}")
    return str(value) if found is None else found


def _annotation(entry: dict, names: dict[int | str, str], file: Path) -> Annotation:
    category = _id(entry, "category_id", file)
    keys = (names.get(category, f"category {category}"), str(category))
    segmentation = entry.get("segmentation")
    if not segmentation:
        return Annotation("box or keypoints", keys, None)
    if isinstance(segmentation, dict):
        return Annotation("run-length code", keys, partial(_run_lengths, segmentation))
    return Annotation("polygon", keys, partial(_polygons, segmentation))


def _polygons(segmentation: object, size: tuple[int, int]) -> Polygons:
    if not isinstance(segmentation, list) or not all(isinstance(ring, list) for ring in segmentation):
        raise OutlineError("is no list of polygons")
    return polygons(segmentation, size)


def _run_lengths(segmentation: dict, size: tuple[int, int]) -> RunLengths:
    counts = segmentation["counts"]
    if numbers(segmentation["size"]).tolist() != [size[1], size[0]]:
        raise OutlineError("has a run-length code of another size than its image")
    return run_lengths(decompress(counts) if isinstance(counts, str) else counts, (0, 0, *size), True, size)


def decompress(text: str) -> np.ndarray:
    """(N,) int64 counts of a compressed run-length code; OutlineError if it is damaged.

    Each count is 5 bits per character (+48), the lowest first; bit 32 says that more follow, and bit 16 of
    the last one is the sign. From the fourth count on, the difference to the count two before is stored.
    Source: rleFrString of the COCO API.

    pycocotools only gives whole masks back, 9 to 16 ms for one of 12 megapixels where this and `rasterize` take
    0.1 ms (an object of 300 px) to 3 ms (25 000 runs), and what a short code lacks is whatever memory holds.
    """
    try:
        code = np.frombuffer(text.encode("ascii"), np.uint8).astype(np.int64) - 48
    except UnicodeEncodeError:
        code = np.array([-1])
    last = np.flatnonzero(~code & 32)
    first = np.concatenate([[0], last[:-1] + 1])
    if (
        not len(last)
        or last[-1] != len(code) - 1
        or (code < 0).any()
        or (code > 63).any()
        or (last - first > 6).any()
    ):
        raise OutlineError("has a compressed run-length code that is damaged")
    place = np.arange(len(code)) - np.repeat(first, last - first + 1)
    values = np.add.reduceat((code & 31) << 5 * place, first)
    values -= (code[last] & 16 > 0).astype(np.int64) << 5 * (last - first + 1)
    for start in (1, 2):
        values[start::2] = np.cumsum(values[start::2])
    return values
