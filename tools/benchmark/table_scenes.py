"""What the tables are computed on: synthetic scenes that are made once per seed, with masks of any strength,
and scenes given by path.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from sc3d.errors import InputError
from sc3d.geometry.cameras import View, local_origin
from sc3d.geometry.neighbors import NeighborIndex
from sc3d.geometry.raycast import Surface, first_surface, nearest_points
from sc3d.io.atomic import atomic_path
from sc3d.io.clouds import read_cloud
from sc3d.io.folders import link_or_copy
from sc3d.io.images import write_image
from sc3d.io.mask_images import read_index_image
from sc3d.io.progress import Progress, progress
from sc3d.labelling.cloud import Cloud
from sc3d.labelling.inputs import Masks, point_density
from sc3d.metrics import Confusion, EvaluationPixels, depth_edge_band
from sc3d.scene.labelled_cloud import REACH, point_arrays, read_surface, spacing_of
from sc3d.scene.scene import Scene
from sc3d.settings.synthesize import Synthesize
from sc3d.synthetic.generate import synthesize
from sc3d.synthetic.masks import noisy_mask, without_other

logger = logging.getLogger(__name__)

LINKS = {
    "sparse": "sparse",
    "truth": "truth",
    "classes.json": "classes.json",
    "images": "images",
    "truth.ply": "truth.ply",
    "cloud.ply": "truth.ply",
    "mesh.ply": "truth_mesh.ply",
}
BAND = 10.0  # px
FEW = 8  # photos are judged in any case, if there are so many


@dataclass(frozen=True)
class Place:
    """A scene without its masks: loaded once, whatever masks are tried on it.

    cloud: points and normals; colors: (N, 3) uint8 or None; truth: (N,) uint8 true label per point, maybe
        `OTHER`, None = not known
    judged: the evaluated pixels of `photos`, in this order
    """

    scene: Scene
    cloud: Cloud
    colors: np.ndarray | None
    truth: np.ndarray | None
    surface: Surface
    judged: EvaluationPixels
    photos: list[View]

    @property
    def num_ids(self) -> int:
        return self.scene.class_table().num_ids


def synthetic_scene(folder: Path, settings: Synthesize) -> Scene:
    """The scene of a seed in `folder`; made if it is not there yet. InputError if another scene is."""
    scene = Scene(folder)
    # classes.json is written last
    if not all(path.exists() for path in (scene.classes, folder / "truth.ply", folder / "truth_mesh.ply")):
        with Progress(100, f"synthesize {folder.name}", "%") as bar:
            synthesize(folder, settings, lambda share, _: bar.advance_to(round(100 * share)))
    views = scene.model.views
    found = len(views), views[0].width, len(read_cloud(folder / "truth.ply").point.positions)
    wanted = settings.num_views, settings.width, settings.num_points
    if found != wanted:
        raise InputError(
            f"{folder} has {found[0]} views of {found[1]} px and {found[2]} points, not {wanted}: choose another working folder, or its options"
        )
    return scene


def with_masks(scene: Scene, folder: Path, settings: Synthesize) -> Scene:
    """A scene folder with the same world and photos (links) and masks of strength `settings.mask_noise`, as
    `synthesize` makes them.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for name, target in LINKS.items():
        link = folder / name
        if not link.is_symlink():
            link_or_copy((scene.path / target).resolve(), link)
    made = Scene(folder)
    if made.masks.is_dir() and made.confidence.is_dir():
        return made
    truth = scene.mask_files(scene.truth)
    with atomic_path(made.confidence) as confidences, atomic_path(made.masks) as masks:
        for number, view in enumerate(scene.model.views):
            generator = np.random.default_rng([settings.seed, 4, number])
            label = without_other(read_index_image(truth[view.name]))
            mask, confidence = noisy_mask(label, settings.mask_noise, generator)
            for temporary, image in ((masks, mask), (confidences, confidence)):
                write_image(temporary / f"{Path(view.name).stem}.png", image)
    return made


def load_place(scene: Scene, every: int) -> Place:
    """Load cloud and surface of a scene and find the point that every judged pixel shows, in every `every`th
    photo that has truth (all if they are few).
    """
    scene.require(
        scene.truth,
        scene.classes,
        scene.cloud,
        hint="the tables need a scene with cloud.ply, classes.json and truth masks",
    )
    views, truth_files = scene.model.views, scene.mask_files(scene.truth, scene.class_table(), truth=True)
    cloud = read_cloud(scene.cloud)
    points, normals = point_arrays(cloud, np.array([view.center for view in views]))
    surface = read_surface(scene.surface, points, normals, local_origin(views))
    index, reach = NeighborIndex(points, points.min(axis=0)), REACH * spacing_of(points)
    photos = [view for view in views if view.name in truth_files]
    photos = photos[:: max(1, min(every, len(photos) // FEW))]
    parts = []
    for view in progress(photos, f"judged pixels of {scene.path.name}", "photo"):
        truth = scene.read_truth(truth_files[view.name], view.name)
        sized = view.resized(*truth.shape[::-1])
        first = first_surface(surface, sized)
        parts.append(
            EvaluationPixels.from_photo(
                truth,
                nearest_points(first, sized, index, reach, truth > 0),
                depth_edge_band(first.range, BAND),
            )
        )
    colors = cloud.point.colors.numpy() if "colors" in cloud.point else None
    # else a label in the cloud is somebody's result
    true = scene.cloud.resolve() == (scene.path / "truth.ply").resolve()
    label = cloud.point["label"].numpy().ravel() if true and "label" in cloud.point else None
    return Place(
        scene, Cloud(points, normals), colors, label, surface, EvaluationPixels.concatenate(parts), photos
    )


def judge_masks(place: Place, masks: Masks) -> tuple[Confusion, Confusion]:
    """Confusion of the masks themselves on the judged pixels, inside and outside the band; photos without a
    mask count as unlabelled.
    """
    truth_files, parts = place.scene.mask_files(place.scene.truth), []
    for view in place.photos:
        truth = place.scene.read_truth(truth_files[view.name], view.name)
        mask = np.zeros_like(truth)
        if view.name in masks.files:
            mask = cv2.resize(
                read_index_image(masks.files[view.name]), truth.shape[::-1], interpolation=cv2.INTER_NEAREST
            )
        parts.append(mask[truth > 0])
    return place.judged.confusions(np.concatenate(parts), place.num_ids)


def with_density(place: Place, voxel_size: float) -> Cloud:
    """The cloud with the density of matter that `sc3d label --density` uses."""
    return replace(place.cloud, density=point_density(place.scene, place.cloud.points, voxel_size))
