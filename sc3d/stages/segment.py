"""Photos (or a folder of masks) -> masks/ and confidence/."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

from sc3d.classes import ClassTable
from sc3d.errors import InputError
from sc3d.io import find_photos, read_json, write_json
from sc3d.scene import Scene, photo_sizes
from sc3d.settings import Segment


def inputs(scene: Scene, settings: Segment) -> list[Path]:
    given = [path for path in (settings.masks, settings.confidence, settings.mapping) if path is not None]
    if settings.backend == "files":
        return [scene.classes, *given]
    return [scene.classes, scene.images, *([settings.strokes or scene.strokes] if settings.backend == "strokes" else [])]


def outputs(scene: Scene, settings: Segment) -> list[Path]:
    return [scene.masks]


def run(scene: Scene, settings: Segment) -> dict[str, object]:
    class_table = scene.class_table()
    if settings.backend == "files":
        return _import(scene, settings, class_table)
    from sc3d.segmentation.run import segment_photos

    class_table = with_prompts(class_table, settings.prompts)
    segmenter = _segmenter(scene, settings, class_table)
    # Masks of an interrupted run are gone on with if they were made with the same settings; others are the user's to remove.
    marker, state = scene.path / "segment.unfinished.json", json.loads(json.dumps([repr(settings), class_table.as_json()]))
    if scene.masks.exists() and not (marker.exists() and read_json(marker) == state):
        raise InputError(f"{scene.masks} holds masks that other settings made: remove the folder to make new ones")
    write_json(marker, state)
    summary = segment_photos(find_photos(scene.images), scene.masks, scene.confidence, segmenter)
    marker.unlink()
    pixels = {class_table.name(label): int(count) for label, count in enumerate(summary.num_pixels) if count}
    return {"segmented": len(summary.segmented), "already_there": len(summary.skipped)} | {f"pixels_{name}": count for name, count in pixels.items()}


def _segmenter(scene: Scene, settings: Segment, class_table: ClassTable):  # noqa: ANN202 - a sc3d.segmentation.run.Segmenter; packages load late
    if settings.backend == "strokes":
        from sc3d.segmentation.strokes import Strokes

        return Strokes.learn(settings.strokes or scene.strokes, scene.images, class_table)
    if settings.backend == "sam3":
        from sc3d.segmentation.sam3 import Sam3

        return Sam3(settings, class_table)
    from sc3d.segmentation.grounded_sam import GroundedSam, GroundedSamSettings

    names = GroundedSamSettings.__dataclass_fields__.keys() & Segment.__dataclass_fields__.keys()
    return GroundedSam(GroundedSamSettings(**{name: getattr(settings, name) for name in names}), class_table)


def with_prompts(class_table: ClassTable, prompts: tuple[str, ...]) -> ClassTable:
    """The table with the prompts of some classes replaced; `prompts`: texts like "road=street,parking lot"."""
    texts = {}
    for prompt in prompts:
        name, separator, values = prompt.partition("=")
        if not separator or name not in {entry.name for entry in class_table} or not values.strip():
            raise InputError(f"--prompts {prompt!r} must be NAME=text,text with a class name of {[entry.name for entry in class_table]}")
        texts[name] = tuple(value.strip() for value in values.split(",") if value.strip())
    return ClassTable(tuple(replace(entry, prompts=texts.get(entry.name, entry.prompts)) for entry in class_table))


def _import(scene: Scene, settings: Segment, class_table: ClassTable) -> dict[str, object]:
    from sc3d.segmentation.files import import_masks

    if settings.masks is None:
        if not scene.masks.is_dir():
            raise InputError("--masks FOLDER is needed (or --backend grounded-sam, which makes masks from the prompts in classes.json)")
        return {"masks": len(scene.mask_files(scene.masks, class_table)), "source": "already in the scene"}
    names = import_masks(settings.masks, scene.masks, photo_sizes(scene.images), class_table, settings.confidence, scene.confidence)
    return {"masks": len(names), "confidence": settings.confidence is not None}
