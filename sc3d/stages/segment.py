"""Photos (or a folder of masks, or the cloud) -> masks/ and confidence/."""

from __future__ import annotations

from pathlib import Path

from sc3d.georeferencing.georeference import georeference_path
from sc3d.io.atomic import discard
from sc3d.io.provenance import Input, PhotoFrames
from sc3d.scene.class_table import ClassTable
from sc3d.scene.scene import Scene
from sc3d.scene.site_model import read_model
from sc3d.segmentation.grounded_sam import GroundedSam
from sc3d.segmentation.mask_formats.import_masks import import_scene_masks
from sc3d.segmentation.sam3 import Sam3
from sc3d.segmentation.segment import Segmenter, segment_scene
from sc3d.segmentation.shape.backend import segment_by_shape, write_default_classes
from sc3d.segmentation.strokes.backend import Strokes
from sc3d.segmentation.strokes.model_file import from_part
from sc3d.segmentation.text_prompts import replace_prompts
from sc3d.settings.labels import Segment


def inputs(scene: Scene, settings: Segment) -> list[Input]:
    frames = PhotoFrames(scene.images)
    if settings.refine:
        return [
            scene.classes,
            scene.sparse,
            scene.masks,
            scene.confidence,
            scene.cloud,
            *scene.surface,
            frames,
        ]
    if settings.backend == "geometry":
        return [scene.classes, scene.sparse, scene.cloud, *scene.surface, georeference_path(scene), frames]
    given = [path for path in (settings.masks, settings.confidence, settings.mapping) if path is not None]
    if settings.backend == "files":
        return [scene.classes, *given, frames, *([] if settings.masks else [scene.sparse])]
    return [
        scene.classes,
        scene.images,
        *([settings.model or settings.strokes or scene.strokes] if settings.backend == "strokes" else []),
    ]


def outputs(scene: Scene, settings: Segment) -> list[Path]:
    return [scene.confidence_refined if settings.refine else scene.masks]


def besides(scene: Scene, settings: Segment) -> list[Path]:
    return [] if settings.refine else [scene.confidence, scene.instances]


def begin(scene: Scene, settings: Segment) -> None:
    if settings.backend == "geometry" and not settings.refine:
        write_default_classes(scene)


def run(scene: Scene, settings: Segment) -> dict[str, object]:
    """Make masks with a backend, import them, or (`--refine`) lower the confidence of those that are there."""
    class_table = scene.class_table()
    if settings.refine:
        from sc3d.segmentation.mask_refinement import refine_scene

        return refine_scene(scene, settings).figures()
    discard(scene.confidence_refined)  # it belongs to the masks that are replaced
    if settings.backend == "files":
        return import_scene_masks(scene, settings, class_table)
    if settings.backend == "geometry":
        return segment_by_shape(scene, class_table)
    class_table = replace_prompts(class_table, settings.prompts)
    segmenter = _segmenter(scene, settings, class_table)
    return segment_scene(scene, settings, class_table, segmenter).figures(class_table)


def _segmenter(scene: Scene, settings: Segment, class_table: ClassTable) -> Segmenter:
    if settings.backend == "strokes" and settings.model is not None:
        return from_part(read_model(settings.model, class_table, "strokes"), class_table, settings.model)
    if settings.backend == "strokes":
        return Strokes.fit(settings.strokes or scene.strokes, scene.images, class_table)
    return (Sam3 if settings.backend == "sam3" else GroundedSam)(settings, class_table)
