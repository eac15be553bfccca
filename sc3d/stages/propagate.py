"""Seeds -> labelled cloud."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sc3d.errors import InputError
from sc3d.io.chunked_clouds import CloudFile
from sc3d.io.clouds import write_geometry
from sc3d.propagation.propagate import LabelledPoints, complete
from sc3d.scene.labelled_cloud import read_labelled, read_votes, with_labels
from sc3d.scene.labels import PROPAGATED
from sc3d.scene.scene import Scene
from sc3d.settings.labels import Propagate
from sc3d.tiling.executor import open_executor
from sc3d.tiling.memory import fits, num_points
from sc3d.tiling.propagate import BYTES, Summary, propagate_tiles


def inputs(scene: Scene, settings: Propagate) -> list[Path]:
    return [settings.seeds or scene.seeds]


def outputs(scene: Scene, settings: Propagate) -> list[Path]:
    return [settings.output or scene.labelled]


def run(scene: Scene, settings: Propagate) -> dict[str, object]:
    path = settings.seeds or scene.seeds
    count = num_points(path)
    if count is not None and not fits(count * BYTES, settings):
        with open_executor(settings) as tasks:
            return _summary(propagate_tiles(scene, settings, CloudFile.open(path), tasks))
    cloud, seeds = read_labelled(path, "label")
    votes = read_votes(cloud)
    if settings.method == "map" and votes is None:
        raise InputError(
            f"{path} has no votes, which --method map needs: run `sc3d label` again, or choose --method geometry"
        )
    if not (seeds.label > 0).any():
        raise InputError(
            f"{path} has no labelled point to start from: check that masks and cloud belong together, or lower --consensus in label"
        )
    points = cloud.point.positions.numpy().astype(np.float64)
    normals = cloud.point.normals.numpy()
    evidence = LabelledPoints(
        points, seeds, votes, cloud.point.colors.numpy() if "colors" in cloud.point else None
    )
    labels = complete(evidence, normals, settings)
    write_geometry(settings.output or scene.labelled, with_labels(cloud, normals, labels))
    labelled = labels.label > 0
    return _summary(
        Summary(
            len(labelled),
            int(labelled.sum()),
            int((labels.state == PROPAGATED).sum()),
            float(labels.confidence[labelled].sum(dtype=np.float64)),
        )
    )


def _summary(found: Summary) -> dict[str, object]:
    return {
        "points": found.num_points,
        "labelled": f"{found.labelled / found.num_points:.1%}",
        "propagated": f"{found.propagated / found.num_points:.1%}",
        "mean_confidence": round(found.confidence / max(found.labelled, 1), 3),
    }
