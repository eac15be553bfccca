"""Label a cloud with masks: which files a scene folder needs, and the three stages that work on them.

    python data/manual/examples/01_label_a_cloud.py [FOLDER]

The photos, cameras, masks and the cloud come from the synthetic generator; yours would come from a drone, from
COLMAP and from a segmenter. A quarter of the mask pixels is wrong, and the errors differ from photo to photo.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np

from sc3d.io.json_files import read_json
from sc3d.runner import execute
from sc3d.scene.labelled_cloud import read_labelled
from sc3d.scene.scene import Scene
from sc3d.settings.labels import Evaluate, Label, Propagate
from sc3d.settings.synthesize import Synthesize


def main(folder: Path) -> None:
    scene = Scene(folder / "scene")
    # writes sparse/0 (cameras), masks/, confidence/, classes.json, and what only a synthetic scene has:
    # truth/ (exact masks) and truth.ply (the cloud)
    execute("synthesize", scene, Synthesize(views=10, width=320, extent=60, altitude=40, num_points=60_000))

    execute("label", scene, Label(cloud=scene.path / "truth.ply"))  # -> seeds.ply, votes.npz
    execute("propagate", scene, Propagate())  # -> labelled.ply
    execute("evaluate", scene, Evaluate(truth=scene.truth))  # -> metrics.json

    _, labels = read_labelled(scene.labelled, "propagate")
    names = {entry.id: entry.name for entry in scene.class_table()}
    for label, count in zip(*np.unique(labels.label, return_counts=True), strict=True):
        print(f"{names.get(label, 'unlabelled'):10s} {count:6d} points")
    metrics = read_json(scene.metrics)
    print(f"masks  mIoU {metrics['masks']['miou']:.1%}\nlabels mIoU {metrics['labels']['miou']:.1%}")
    assert metrics["labels"]["miou"] > metrics["masks"]["miou"] + 0.1


if __name__ == "__main__":
    if len(sys.argv) > 1:
        main(Path(sys.argv[1]))
    else:
        with tempfile.TemporaryDirectory() as temporary:
            main(Path(temporary))
