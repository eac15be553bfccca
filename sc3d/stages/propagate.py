"""Seeds -> labelled cloud."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sc3d.errors import InputError
from sc3d.fusion import PROPAGATED
from sc3d.io import write_geometry
from sc3d.labelled import read_labelled, read_votes, with_labels
from sc3d.propagation import Evidence, complete
from sc3d.scene import Scene
from sc3d.settings import Propagate


def inputs(scene: Scene, settings: Propagate) -> list[Path]:
    return [settings.seeds or scene.seeds]


def outputs(scene: Scene, settings: Propagate) -> list[Path]:
    return [settings.output or scene.labelled]


def run(scene: Scene, settings: Propagate) -> dict[str, object]:
    path = settings.seeds or scene.seeds
    cloud, seeds = read_labelled(path, "label")
    votes = read_votes(cloud)
    if settings.method == "map" and votes is None:
        raise InputError(f"{path} has no votes, which --method map needs: run `sc3d label` again, or choose --method geometry")
    if not (seeds.label > 0).any():
        raise InputError(f"{path} has no labelled point to start from: check that masks and cloud belong together, or lower --consensus in label")
    points = cloud.point.positions.numpy().astype(np.float64)
    normals = cloud.point.normals.numpy()
    evidence = Evidence(points, seeds, votes, cloud.point.colors.numpy() if "colors" in cloud.point else None)
    labels = complete(evidence, normals, settings)
    write_geometry(settings.output or scene.labelled, with_labels(cloud, normals, labels))
    return {
        "points": len(labels.label),
        "labelled": f"{(labels.label > 0).mean():.1%}",
        "propagated": f"{(labels.state == PROPAGATED).mean():.1%}",
        "mean_confidence": round(float(labels.confidence[labels.label > 0].mean()), 3),
    }
