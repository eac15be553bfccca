"""Seeds -> labelled cloud."""

from __future__ import annotations

from pathlib import Path

from sc3d.errors import InputError
from sc3d.georeferencing.georeference import georeference_path, read_georeference
from sc3d.io.json_files import read_json
from sc3d.io.provenance import Input, PhotoFrames
from sc3d.propagation.propagate import propagate_scene, start_of
from sc3d.runner import MAX_SIDECAR, sidecar
from sc3d.scene.scene import Scene
from sc3d.scene.site_model import ModelPart, read_model, require_model_or_nothing, write_model
from sc3d.segmentation.instances import read_objects
from sc3d.segmentation.strokes.backend import Strokes
from sc3d.segmentation.strokes.model_file import to_part
from sc3d.settings.labels import Propagate
from sc3d.tiling.propagate import propagate_fits
from sc3d.tiling.propagate import propagate_scene as propagate_scene_by_tiles


def begin(scene: Scene, settings: Propagate) -> None:
    """Refuse a model that would replace another file; read what the end needs."""
    if settings.save_model:
        require_model_or_nothing(settings.save_model)
    if scene.classes.exists():
        scene.class_table()
    read_georeference(scene)


def inputs(scene: Scene, settings: Propagate) -> list[Input]:
    corrections = [scene.corrections] if scene.corrections.exists() else []
    photos = PhotoFrames(scene.images)  # which, with the cameras, tell up
    start, _ = start_of(scene, settings)
    model = [settings.model] if settings.model else []
    learned = _strokes_inputs(scene) if settings.save_model else []
    place = georeference_path(scene)  # which says how long a meter is
    table = [scene.classes] if corrections or model or settings.save_model or scene.classes.exists() else []
    objects = [scene.instances] if scene.instances.is_dir() else []
    return [start, scene.sparse, photos, *corrections, *table, *model, place, *objects, *learned]


def outputs(scene: Scene, settings: Propagate) -> list[Path]:
    return [settings.output or scene.labelled, *([settings.save_model] if settings.save_model else [])]


def run(scene: Scene, settings: Propagate) -> dict[str, object]:
    """Complete the labels, in memory or, where the cloud does not fit, by tiles."""
    fits = propagate_fits(scene, settings)
    strokes = _strokes_part(scene) if settings.save_model else None
    summary = (propagate_scene if fits else propagate_scene_by_tiles)(scene, settings, read_objects)
    if settings.save_model:
        if summary.learned is None:
            raise InputError(
                f"{settings.save_model} is not written, as fewer than two classes have enough sure points to learn"
                f" from; {settings.output or scene.labelled} is"
            )
        parts = {"appearance": summary.learned} | ({"strokes": strokes} if strokes else {})
        write_model(settings.save_model, scene.class_table(), parts)
    return summary.figures()


def _masks_settings(scene: Scene) -> dict:
    """With what the masks of the scene were made; empty if they were not made from strokes."""
    try:
        record = read_json(sidecar(scene.masks), MAX_SIDECAR)
    except InputError:
        return {}
    settings = record.get("settings") if isinstance(record, dict) else None
    return settings if isinstance(settings, dict) and settings.get("backend") == "strokes" else {}


def _strokes_source(scene: Scene) -> tuple[Path | None, Path | None]:
    """The folder of strokes, or the model, that the masks of the scene are from; None for what they are not."""
    settings = _masks_settings(scene)
    if not settings:
        return None, None
    if settings.get("model"):
        return None, scene.path / settings["model"]
    folder = scene.path / settings["strokes"] if settings.get("strokes") else scene.strokes
    return (folder if folder.is_dir() else None), None


def _strokes_inputs(scene: Scene) -> list[Input]:
    folder, model = _strokes_source(scene)
    return [sidecar(scene.masks), *([folder, scene.images] if folder else []), *([model] if model else [])]


def _strokes_part(scene: Scene) -> ModelPart | None:
    """What the strokes of the scene teach, learned again, if its masks are from strokes."""
    folder, model = _strokes_source(scene)
    if model is not None:
        return read_model(model, scene.class_table(), "strokes")
    if folder is None:
        return None
    return to_part(Strokes.fit(folder, scene.images, scene.class_table()))
