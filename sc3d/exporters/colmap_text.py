"""The cameras and sparse points as a COLMAP model in text files."""

from __future__ import annotations

import logging
from pathlib import Path

from sc3d.exporters.projected_cloud import copy_georeference
from sc3d.io.atomic import atomic_path
from sc3d.io.colmap import load_model
from sc3d.scene.scene import Scene
from sc3d.settings.outputs import Export

logger = logging.getLogger(__name__)


def outputs(scene: Scene, settings: Export) -> list[Path]:
    return [scene.export / "colmap-text"]


def write(scene: Scene, settings: Export) -> dict[str, object]:
    """`export/colmap-text/cameras.txt`, `images.txt`, `points3D.txt` and what else COLMAP writes."""
    model = load_model(scene.sparse)
    blank = [view.name for view in scene.model.views if len(view.name.split()) > 1]
    if blank:
        logger.warning(
            "%d of %d photo names have blanks, such as %r: sc3d reads them, COLMAP itself reads text up to the first blank; sparse/0 keeps them",
            len(blank),
            len(scene.model.views),
            blank[0],
        )
    with atomic_path(outputs(scene, settings)[0]) as folder:
        folder.mkdir()
        model.write_text(str(folder))
        copy_georeference(scene, folder)
    return {"photos": model.num_reg_images(), "points": model.num_points3D()}
