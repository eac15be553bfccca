"""A small scene in UTM coordinates, made from scratch: a square of ground, half road and half grass, photographed from above."""

import json
from pathlib import Path

import numpy as np
import open3d as o3d
import pycolmap
from PIL import Image

from sc3d.geometry.cameras import look_at, rays, View

ORIGIN = np.array([512345.0, 5187654.0, 210.0])
SIZE = (160, 120)
CLASSES = [{"id": 1, "name": "road", "color": [150, 150, 160]}, {"id": 3, "name": "grass", "color": [170, 220, 110]}]


def ground(step: float = 0.1, half: float = 4.0) -> np.ndarray:
    """(N, 3) float64 UTM positions in a shuffled order."""
    x, y = np.meshgrid(np.arange(-half, half, step), np.arange(-half, half, step))
    points = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1) + ORIGIN
    return points[np.random.default_rng(0).permutation(len(points))]


def views() -> list[View]:
    camera = pycolmap.Camera(model="SIMPLE_RADIAL", width=SIZE[0], height=SIZE[1], params=[150.0, 80.0, 60.0, -0.05], camera_id=1)
    centres = [[-1, -1, 9], [1, -1, 9], [1, 1, 9], [-1, 1, 9], [0, 0, 10]]
    return [View(f"photo_{row}.jpg", camera, look_at(ORIGIN + centre, ORIGIN)) for row, centre in enumerate(centres)]


def truth_mask(view: View) -> np.ndarray:
    """Exact labels: road where x < 0, grass elsewhere, 0 outside the ground."""
    directions, _ = rays(view)
    hits = view.centre + directions * (-(view.centre[2] - ORIGIN[2]) / directions[:, 2])[:, None] - ORIGIN
    label = np.where(hits[:, 0] < 0, 1, 3)
    label[np.abs(hits[:, :2]).max(axis=1) > 3.9] = 0
    return label.reshape(view.height, view.width).astype(np.uint8)


def write_model(path: Path, scene_views: list[View]) -> None:
    reconstruction = pycolmap.Reconstruction()
    reconstruction.add_camera_with_trivial_rig(scene_views[0].camera)
    for row, view in enumerate(scene_views):
        image = pycolmap.Image(name=view.name, camera_id=1, image_id=row + 1)
        reconstruction.add_image_with_trivial_frame(image, pycolmap.Rigid3d(view.cam_from_world[:3]))
    path.mkdir(parents=True)
    reconstruction.write_binary(str(path))


def write_bare_scene(path: Path) -> Path:
    """sparse/0, cloud.ply, masks/, truth/ and classes.json; no photos, no mesh."""
    write_model(path / "sparse" / "0", views())
    cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor(ground()))
    o3d.t.io.write_point_cloud(str(path / "cloud.ply"), cloud)
    (path / "classes.json").write_text(json.dumps(CLASSES))
    for folder in ("masks", "truth"):
        (path / folder).mkdir()
        for view in views():
            Image.fromarray(truth_mask(view)).save(path / folder / f"{Path(view.name).stem}.png")
    return path
