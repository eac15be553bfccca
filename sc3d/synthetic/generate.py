"""Writes a synthetic scene folder: photos, true cameras, depth, masks, truth."""

from __future__ import annotations

import re
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import open3d as o3d
from PIL import Image

from sc3d.errors import InputError
from sc3d.geometry.cameras import View
from sc3d.io.atomic import atomic_path
from sc3d.io.clouds import write_geometry
from sc3d.io.colmap import build_model, write_model
from sc3d.io.images import write_image
from sc3d.io.json_files import write_json
from sc3d.settings.synthesize import Synthesize
from sc3d.synthetic.cloud import find_tracks, truth_cloud
from sc3d.synthetic.exif import geodetic, photo_exif
from sc3d.synthetic.flight import fly
from sc3d.synthetic.masks import noisy_mask
from sc3d.synthetic.mesh import NO_CLASS
from sc3d.synthetic.photos import Photo, photograph
from sc3d.synthetic.shading import display
from sc3d.synthetic.street import build_street
from sc3d.synthetic.world import World, build_world

# fmt: off
CLASSES = [
    {"id": 1, "name": "building", "color": [214, 60, 60], "prompts": ["building", "house", "roof"], "asprs": 6},
    {"id": 2, "name": "tree", "color": [40, 150, 60], "prompts": ["tree", "bush"], "asprs": 5},
    {"id": 3, "name": "road", "color": [150, 150, 160], "prompts": ["road", "street", "parking lot"], "asprs": 11},
    {"id": 4, "name": "grass", "color": [170, 220, 110], "prompts": ["grass", "lawn"], "asprs": 3},
]
# fmt: on
FOLDERS = ("images", "truth_depth", "truth", "truth_sky", "masks", "confidence")
# candidates for sparse points; those seen by three views are kept, of a street fewer of them
NUM_SPARSE, NUM_SPARSE_STREET = 16_000, 50_000


def synthesize(
    scene_path: Path, settings: Synthesize, progress: Callable[[float, str], None] | None = None
) -> dict:
    """Write a complete scene folder.

    Writes images/, truth_depth/<stem>.npy (float32 z, m), truth/, masks/, confidence/, sparse/0, truth.ply,
    truth_mesh.ply and classes.json; of a street also truth_sky/ (255 = sky).
    progress: called with the finished share (0..1) and what is being done; None = silent
    returns: summary: num_views, num_triangles, num_buildings, mask_accuracy (over pixels of a class),
        num_sparse_points, seconds_per_view
    """
    report = progress or (lambda share, text: None)
    _clear(scene_path)
    report(0.0, "building the world")
    if settings.kind == "street":
        world, views = build_street(settings)
    else:
        world, views = build_world(settings), fly(settings)
    positions = geodetic(_measured_centers(views, settings))
    started, right, labelled = time.perf_counter(), 0, 0
    for number, view in enumerate(views):
        report(0.05 + 0.85 * number / len(views), view.name)
        photo = photograph(world, view)
        mask, confidence = noisy_mask(
            photo.label, settings.mask_noise, np.random.default_rng([settings.seed, 4, number])
        )
        right += int(((mask == photo.label) & (photo.label != NO_CLASS)).sum())
        labelled += int((photo.label != NO_CLASS).sum())
        exif = photo_exif(number, positions[number] if settings.gps else None)
        _write_view(scene_path, Path(view.name), photo, (mask, confidence), exif)
        if world.street:
            write_image(
                scene_path / "truth_sky" / f"{Path(view.name).stem}.png",
                np.where(photo.depth > 0, 0, 255).astype(np.uint8),
            )
    seconds = (time.perf_counter() - started) / len(views)
    report(0.9, "sparse points")
    num_sparse = _write_sparse(scene_path / "sparse" / "0", world, views, settings)
    report(0.93, "truth cloud")
    cloud = truth_cloud(world, settings.num_points, np.random.default_rng([settings.seed, 5]))
    write_geometry(scene_path / "truth.ply", cloud)
    write_geometry(scene_path / "truth_mesh.ply", _mesh(world))
    write_json(scene_path / "classes.json", CLASSES)
    report(1.0, "done")
    return {
        "num_views": len(views),
        "num_triangles": len(world.corners),
        "num_buildings": len(world.buildings),
        "mask_accuracy": round(right / max(labelled, 1), 4),
        "num_sparse_points": num_sparse,
        "seconds_per_view": round(seconds, 3),
    }


def _clear(scene_path: Path) -> None:
    """Remove the photos of an earlier synthetic scene; InputError if there are others, which must not be
    mixed or lost.
    """
    files = [file for folder in FOLDERS for file in (scene_path / folder).glob("[!.]*")]
    for file in files:
        if not re.fullmatch(r"view_\d{3,}\.(jpg|png|npy)", file.name):
            raise InputError(f"{file} does not belong to a synthetic scene: choose an empty folder")
    for file in files:
        file.unlink()


def _measured_centers(views: list[View], settings: Synthesize) -> np.ndarray:
    """(N, 3) camera centers as the GPS gives them."""
    centers = np.stack([view.center for view in views])
    return (
        centers + np.random.default_rng([settings.seed, 6]).normal(0, 1, centers.shape) * settings.gps_noise
    )


def _write_view(
    scene_path: Path, name: Path, photo: Photo, segmented: tuple[np.ndarray, np.ndarray], exif: Image.Exif
) -> None:
    with atomic_path(scene_path / "images" / name) as temporary:
        Image.fromarray(photo.color).save(temporary, quality=95, subsampling=0, exif=exif)
    with atomic_path(scene_path / "truth_depth" / f"{name.stem}.npy") as temporary:
        np.save(temporary, photo.depth)
    for folder, image in (("truth", photo.truth), ("masks", segmented[0]), ("confidence", segmented[1])):
        write_image(scene_path / folder / f"{name.stem}.png", image)


def _mesh(world: World) -> o3d.t.geometry.TriangleMesh:
    """All triangles of the world, also those outside the site."""
    corners = world.corners.reshape(-1, 3)
    return o3d.t.geometry.TriangleMesh(
        o3d.core.Tensor(corners), o3d.core.Tensor(np.arange(len(corners), dtype=np.int32).reshape(-1, 3))
    )


def _write_sparse(path: Path, world: World, views: list[View], settings: Synthesize) -> int:
    """Write the true cameras and points with tracks as a COLMAP model; returns the number of points."""
    points, triangles, observations = find_tracks(
        world,
        views,
        NUM_SPARSE_STREET if world.street else NUM_SPARSE,
        np.random.default_rng([settings.seed, 7]),
    )
    colors = display(world.light(points.astype(np.float32), triangles, np.full(len(points), 0.1, np.float32)))
    write_model(path, build_model(views, points, colors, observations))
    return len(points)
