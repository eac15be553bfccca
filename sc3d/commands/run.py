"""All stages in the order of the data flow."""

from __future__ import annotations

import logging
import shutil
import time
from contextlib import suppress
from dataclasses import replace

from sc3d.commands.plan import Stage, pending, plan, results, warn_of_slow
from sc3d.errors import InputError
from sc3d.io.atomic import atomic_path
from sc3d.io.json_files import read_json
from sc3d.io.progress import under_way
from sc3d.runner import MAX_SIDECAR, execute, sidecar
from sc3d.scene.class_table import MAKE_CLASSES, read_classes
from sc3d.scene.scene import Scene, match_masks, photo_sizes
from sc3d.scene.site_model import read_model
from sc3d.segmentation.shape.backend import write_default_classes
from sc3d.segmentation.shape.classes import DEFAULT, class_ids
from sc3d.settings.labels import Evaluate, Segment
from sc3d.settings.outputs import Report, Run
from sc3d.stages.reconstruct import prepare, steps

logger = logging.getLogger(__name__)


def main(command: Run) -> None:
    with under_way("run"):
        run(command)


def run(command: Run) -> None:
    started = time.perf_counter()
    scene = Scene(command.scene)
    segment = choose_masks(
        scene,
        replace(
            command.segment,
            masks=command.masks or command.segment.masks,
            confidence=command.confidence or command.segment.confidence,
        ),
    )
    check(command, segment)
    command = replace(command, reconstruct=prepare(command.photos, scene, command.reconstruct))
    if command.classes is not None:
        with atomic_path(scene.classes) as temporary:
            shutil.copyfile(command.classes, temporary)
    elif segment.backend == "geometry":
        write_default_classes(scene)
    stages = list_stages(command, scene, segment)
    tell_plan(command, scene, stages)
    for number, (name, settings) in enumerate(stages, 1):
        with under_way(f"stage {number} of {len(stages)}"):
            execute(name, scene, settings, command.overwrite)
    logger.info("run: %.0f s; look at %s\n%s", time.perf_counter() - started, scene.report, results(scene))


def tell_plan(command: Run, scene: Scene, stages: list[Stage]) -> None:
    """Which stages will run, and for how long about."""
    runs = pending(scene, stages, command.overwrite)
    sizes = list(photo_sizes(command.photos).values())
    logger.info(plan(stages, runs, sizes))
    warn_of_slow(stages, runs, sizes)
    if command.extract.method == "depth" and command.train != type(command.train)():
        logger.warning("--train options change nothing: --extract.from depth needs no training")


def list_stages(command: Run, scene: Scene, segment: Segment) -> list[Stage]:
    """The stages in the order in which they run; a surface from depth maps needs no training."""
    depth = command.depth
    if segment.backend == "geometry" and depth.sky_masks is None and scene.class_table().without_surface:
        depth = replace(depth, ignore_masks=True)  # shapes show no sky, and come after depth
    surface: list[Stage] = [
        ("depth", depth),
        *([] if command.extract.method == "depth" else [("train", command.train)]),
        ("extract", command.extract),
    ]
    masks: list[Stage] = [("segment", replace(segment, refine=False))]
    stages: list[Stage] = [
        *steps(command.reconstruct),
        *(masks + surface if _masks_first(scene, command, segment) else surface + masks),
        *([("segment", Segment(refine=True))] if segment.refine else []),
        ("label", command.label),
        ("propagate", command.propagate),
    ]
    if command.truth is not None:
        stages.append(("evaluate", Evaluate(truth=command.truth)))
    return [*stages, ("report", Report())]


def choose_masks(scene: Scene, settings: Segment) -> Segment:
    """Where masks come from: as the settings say, and where nothing is said and no masks are in the scene, or
    those that were made so before, from the shape of the scene.
    """
    if settings != Segment(refine=settings.refine) or (scene.masks.exists() and not _made_by_shape(scene)):
        return settings
    logger.info("no masks are given: they are made from the shape of the scene (--segment.backend geometry)")
    return replace(settings, backend="geometry")


def _made_by_shape(scene: Scene) -> bool:
    """Whether the masks that are in the scene were made from its shape."""
    with suppress(InputError):
        record = read_json(sidecar(scene.masks), MAX_SIDECAR)
        settings = record.get("settings") if isinstance(record, dict) else None
        return isinstance(settings, dict) and settings.get("backend") == "geometry"
    return False


def _masks_first(scene: Scene, command: Run, segment: Segment) -> bool:
    """Whether depth takes the sky of the masks, which geometry does not show."""
    if segment.backend == "geometry":
        return False
    other = command.depth.sky_masks is not None or command.depth.ignore_masks
    return not other and scene.classes.exists() and bool(scene.class_table().without_surface)


def check(command: Run, segment: Segment) -> None:
    """Find what would stop a late stage before the first one starts."""
    sizes = photo_sizes(command.photos)
    classes = command.classes or Scene(command.scene).classes
    by_shape = segment.backend == "geometry"
    if not classes.exists() and not by_shape:
        raise InputError(f"{classes} is missing: {MAKE_CLASSES}")
    class_table = read_classes(classes) if command.classes or classes.exists() else DEFAULT
    if by_shape:
        class_ids(class_table)
    if segment.backend == "files":
        from sc3d.segmentation.mask_formats.import_masks import check_masks, mask_source
        from sc3d.segmentation.mask_formats.source import MaskFiles

        masks = segment.masks or Scene(command.scene).masks
        if not masks.exists():
            raise InputError(
                "--masks PATH is needed (or --segment.backend geometry, strokes, grounded-sam or sam3, which make masks)"
            )
        source = mask_source(segment, masks) if segment.masks else MaskFiles(masks, "index")
        check_masks(source, sizes, class_table, segment.confidence, command.photos)
    for model, part in ((segment.model, "strokes"), (command.propagate.model, "appearance")):
        if model is not None:
            read_model(model, class_table, part)
    if command.extract.crop > len(sizes):
        raise InputError(f"--extract.crop {command.extract.crop}: there are only {len(sizes)} photos")
    if command.depth.sky_masks is not None:
        from sc3d.stereo.given_sky import read_given_sky

        read_given_sky(command.depth.sky_masks, sizes, class_table, command.photos)
    if command.truth is not None:
        match_masks(command.truth, sizes, class_table, photos=command.photos, truth=True)
