"""Photos (or a folder of masks) -> masks/ and confidence/."""

from __future__ import annotations

import hashlib
import json
import logging
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from tqdm import tqdm

from sc3d.errors import InputError
from sc3d.io.atomic import atomic_path, discard, remove_leftovers
from sc3d.io.images import find_photos, write_image
from sc3d.io.json_files import read_json, write_json
from sc3d.io.provenance import digest
from sc3d.scene.class_table import ClassTable
from sc3d.scene.scene import Scene, photo_sizes
from sc3d.settings.labels import Segment

if TYPE_CHECKING:
    from sc3d.segmentation.segment import Folders

logger = logging.getLogger(__name__)


def inputs(scene: Scene, settings: Segment) -> list[Path]:
    if settings.refine:
        return [scene.classes, scene.sparse, scene.masks, scene.confidence, scene.cloud, scene.mesh]
    given = [path for path in (settings.masks, settings.confidence, settings.mapping) if path is not None]
    if settings.backend == "files":
        return [scene.classes, *given]
    return [
        scene.classes,
        scene.images,
        *([settings.strokes or scene.strokes] if settings.backend == "strokes" else []),
    ]


def outputs(scene: Scene, settings: Segment) -> list[Path]:
    return [scene.confidence_refined if settings.refine else scene.masks]


def run(scene: Scene, settings: Segment) -> dict[str, object]:
    class_table = scene.class_table()
    if settings.refine:
        return _refine(scene, settings)
    discard(scene.confidence_refined)  # it belongs to the masks that are replaced
    if settings.backend == "files":
        return _import(scene, settings, class_table)
    from sc3d.segmentation.segment import Folders, segment_photos

    class_table = with_prompts(class_table, settings.prompts)
    segmenter = _segmenter(scene, settings, class_table)
    folders = Folders(scene.masks, scene.confidence, scene.instances)
    # Masks of an interrupted run are gone on with if they were made with the same settings; others are set
    # aside.
    marker, state = scene.path / "segment.unfinished.json", _state(scene, settings, class_table)
    unfinished = marker.exists()
    if unfinished and read_json(marker) == state:
        for folder in (folders.masks, folders.confidence, folders.instances):
            remove_leftovers(folder)
    else:
        _set_aside(folders, "unfinished" if unfinished else "before")
    write_json(marker, state)
    summary = segment_photos(find_photos(scene.images), folders, segmenter, class_table)
    marker.unlink()
    pixels = {class_table.name(label): int(count) for label, count in enumerate(summary.num_pixels) if count}
    figures = {
        "segmented": len(summary.segmented),
        "already_there": len(summary.skipped),
        "instances": summary.num_instances,
    }
    return figures | {f"pixels_{name}": count for name, count in pixels.items()}


def _state(scene: Scene, settings: Segment, class_table: ClassTable) -> object:
    """What decides the masks, as JSON: everything but where the models lie and run. Photos are told by size
    and time, as they are read often.
    """
    decisive = replace(settings, device="auto", download=False, model_dir=None)
    strokes = digest(settings.strokes or scene.strokes) if settings.backend == "strokes" else ""
    photos = [
        (str(photo.relative_to(scene.images)), photo.stat().st_size, photo.stat().st_mtime_ns)
        for photo in find_photos(scene.images)
    ]
    seen = hashlib.blake2b(repr(photos).encode(), digest_size=16).hexdigest()
    return json.loads(json.dumps([repr(decisive), class_table.as_json(), strokes, seen]))


def _set_aside(folders: Folders, suffix: str) -> None:
    """Older masks may hold somebody's work: they become `<folder>.<suffix>`, in place of still older ones.
    Goes on where it was interrupted.
    """
    for folder in (folders.masks, folders.confidence, folders.instances):
        aside = folder.with_name(f"{folder.name}.{suffix}")
        if folder.is_dir():
            discard(aside)
            folder.rename(aside)
            logger.info("%s is now %s", folder, aside)


def _segmenter(scene: Scene, settings: Segment, class_table: ClassTable):
    if settings.backend == "strokes":
        from sc3d.segmentation.strokes.backend import Strokes

        return Strokes.learn(settings.strokes or scene.strokes, scene.images, class_table)
    if settings.backend == "sam3":
        from sc3d.segmentation.sam3 import Sam3

        return Sam3(settings, class_table)
    from sc3d.segmentation.grounded_sam import GroundedSam

    return GroundedSam(settings, class_table)


def with_prompts(class_table: ClassTable, prompts: tuple[str, ...]) -> ClassTable:
    """The table with the prompts of some classes replaced; `prompts`: texts like "road=street,parking lot"."""
    texts = {}
    for prompt in prompts:
        name, separator, values = prompt.partition("=")
        if not separator or name not in {entry.name for entry in class_table} or not values.strip():
            raise InputError(
                f"--prompts {prompt!r} must be NAME=text,text with a class name of {[entry.name for entry in class_table]}"
            )
        texts[name] = tuple(value.strip() for value in values.split(",") if value.strip())
    return ClassTable(
        tuple(replace(entry, prompts=texts.get(entry.name, entry.prompts)) for entry in class_table)
    )


def _refine(scene: Scene, settings: Segment) -> dict[str, object]:
    """Lower the confidence of doubted masks, if that helps."""
    from sc3d.labelling.inputs import Masks
    from sc3d.segmentation.mask_refinement import load_refinement_inputs, refine

    if settings.backend != "files" or settings.masks is not None:
        raise InputError(
            "--refine works on the masks that are in the scene: make them first, then run `sc3d segment SCENE --refine`"
        )
    masks = Masks.load(scene, scene.confidence)
    refinement = refine(load_refinement_inputs(scene, masks), masks.views, masks.read)
    if refinement.helps:
        with atomic_path(scene.confidence_refined) as folder:
            folder.mkdir()
            for view in tqdm(masks.views, desc="writing confidence", unit="photo", disable=None):
                write_image(folder / f"{Path(view.name).stem}.png", refinement.confidence(view, masks.read))
    else:
        discard(scene.confidence_refined)
    return {
        "agreement_before": f"{refinement.before:.2%}",
        "agreement_after": f"{refinement.after:.2%}",
        "kept": refinement.helps,
    }


def _import(scene: Scene, settings: Segment, class_table: ClassTable) -> dict[str, object]:
    from sc3d.segmentation.mask_formats.import_masks import import_masks, warn_of_turned
    from sc3d.segmentation.mask_formats.source import MaskFiles

    if settings.masks is None:
        if settings.mapping is not None or settings.format not in ("auto", "index"):
            raise InputError("--mapping and --format say how to read --masks, which is missing")
        if not scene.masks.is_dir():
            raise InputError(
                "--masks FOLDER is needed (or --backend grounded-sam, which makes masks from the prompts in classes.json)"
            )
        return {"masks": len(scene.mask_files(scene.masks, class_table)), "source": "already in the scene"}
    source, sizes = MaskFiles(settings.masks, settings.format, settings.mapping), photo_sizes(scene.images)
    names = import_masks(source, scene.masks, sizes, class_table, settings.confidence, scene.confidence)
    warn_of_turned([scene.photo(name) for name in names])
    return {"masks": len(names), "confidence": settings.confidence is not None}
