"""Train planar Gaussians on a few photos and take the surface from them: photos and cameras -> mesh and cloud.

    python data/manual/examples/02_surface_of_a_trained_model.py [FOLDER]

Photos and cameras come from the synthetic generator, so that the mesh can be held against the true cloud. 120
iterations at 160 px show the way, not the quality: the default is 1000 at least, at 800 px.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np

from sc3d.geometry.neighbors import NeighborIndex
from sc3d.io.clouds import read_cloud
from sc3d.runner import execute
from sc3d.scene.scene import Scene
from sc3d.settings.reconstruction import Extract
from sc3d.settings.synthesize import Synthesize
from sc3d.settings.train import Train


def main(folder: Path) -> None:
    scene = Scene(folder / "scene")
    execute("synthesize", scene, Synthesize(views=10, width=160, extent=40, altitude=30, num_points=40_000))

    train = Train(iterations=120, max_gaussians=10_000, max_size=160, device="cpu", checkpoint_every=0)
    trained = execute("train", scene, train)  # -> gaussians.ply, train.csv, train.jpg
    extracted = execute("extract", scene, Extract(max_size=160))  # -> mesh.ply, cloud.ply
    print(f"{trained['gaussians']} Gaussians, PSNR {trained['psnr']} dB on the photos trained on")
    print(f"{extracted['points']} points; the mesh is met by {extracted['coverage']}")

    points = read_cloud(scene.cloud).point.positions.numpy()
    true_points = read_cloud(scene.path / "truth.ply").point.positions.numpy()
    _, distances = NeighborIndex(true_points).nearest(points, 1)
    print(f"half of the points lie within {np.median(distances):.2f} m of the true surface")
    assert np.median(distances) < 0.5


if __name__ == "__main__":
    if len(sys.argv) > 1:
        main(Path(sys.argv[1]))
    else:
        with tempfile.TemporaryDirectory() as temporary:
            main(Path(temporary))
