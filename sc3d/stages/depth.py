"""Photos + cameras + sparse points -> depth/, one map per photo with how many others confirm it."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np

from sc3d.errors import InputError, left_out
from sc3d.geometry.cameras import undistorted
from sc3d.geometry.view_selection import neighbor_views
from sc3d.georeferencing.georeference import georeference_path
from sc3d.georeferencing.up_direction import find_up, view_poses
from sc3d.io.atomic import atomic_path
from sc3d.scene.depth_map import hardly_confirmed
from sc3d.scene.photo_names import photo_name
from sc3d.scene.scene import Scene, SparseModel, check_photos, photo_sizes
from sc3d.settings.reconstruction import Depth
from sc3d.stereo.given_sky import GivenSky, read_given_sky, shows_sky, sky_of_scene
from sc3d.stereo.multi_view import (
    MIN_SPARSE,
    StereoJob,
    estimate_depths,
    inverse_range,
    sparse_seeds,
    write_sky,
)
from sc3d.tiling.executor import open_executor
from sc3d.tiling.work_folder import WorkFolder

logger = logging.getLogger(__name__)


def inputs(scene: Scene, settings: Depth) -> list[Path]:
    always = [scene.images, scene.sparse]
    if settings.sky_masks is not None:
        return [*always, settings.sky_masks, *([scene.classes] if scene.classes.exists() else [])]
    return [*always, *([scene.masks, scene.classes] if _uses_masks(scene, settings) else [])]


def outputs(scene: Scene, settings: Depth) -> list[Path]:
    return [scene.depth]


def run(scene: Scene, settings: Depth) -> dict[str, object]:
    model = scene.model
    check_photos(scene, [view.name for view in model.views])
    masks = _sky_masks(scene, settings)
    work = WorkFolder(scene.depth, "depth", inputs(scene, settings), settings)
    job, dropped = _job(scene, settings, work)
    write_sky(job, masks)
    with open_executor(settings) as tasks, atomic_path(scene.depth) as folder:
        folder.mkdir()
        shares = np.array(estimate_depths(replace(job, output=folder), tasks))
        if not shares[:, 0].any():
            raise InputError(
                f"no depth of the {len(job.views)} photos is confirmed by another one: check that the cameras fit the photos, or take photos that overlap more"
            )
    work.remove()
    if few := hardly_confirmed([view.name for view in job.views], shares[:, 0].tolist()):
        logger.warning(few)
    one, two, known, sky = shares.mean(axis=0)
    return {
        "photos": len(job.views),
        **({"left_out": dropped} if dropped else {}),
        "size": f"{job.views[0].width}x{job.views[0].height}",
        "confirmed": f"{one:.1%} of the pixels by another view, {two:.1%} by two",
        "continued": f"{known - one:.1%} of the pixels",
        "sky": f"{sky:.1%} of the pixels",
        **({"sky_masks": f"of {len(masks)} photos"} if masks else {}),
    }


def _uses_masks(scene: Scene, settings: Depth) -> bool:
    return settings.sky_masks is None and not settings.ignore_masks and shows_sky(scene)


def _sky_masks(scene: Scene, settings: Depth) -> GivenSky:
    """What masks say of the sky, by view name; empty where none are to be used."""
    if settings.sky_masks is not None:
        table = scene.class_table() if scene.classes.exists() else None
        sizes = photo_sizes(scene.images)
        given = read_given_sky(settings.sky_masks, sizes, table, scene.images)
    elif _uses_masks(scene, settings):
        given = sky_of_scene(scene)
    else:
        return {}
    names = {view.name: photo_name(scene.photo(view.name), scene.images) for view in scene.model.views}
    found = {name: given[photo] for name, photo in names.items() if photo in given}
    source = settings.sky_masks or scene.masks
    if not found:
        raise InputError(
            f"none of the {len(given)} masks in {source} is of a photo with a camera in {scene.sparse}"
        )
    if bare := sorted(names.keys() - found.keys()):
        told = f"photos have no mask in {source}; their sky is found by its look"
        logger.info(left_out(bare, len(names), told))
    return found


def _job(scene: Scene, settings: Depth, work: WorkFolder) -> tuple[StereoJob, list[str]]:
    """What there is to do; names of the photos that see too few sparse points to begin with."""
    model = scene.model
    seeds = [
        sparse_seeds(undistorted(view, settings.max_size), model.points[track])
        for view, track in zip(model.views, model.tracks, strict=True)
    ]
    kept = [row for row, seed in enumerate(seeds) if seed is not None]
    if len(kept) < 2:
        raise InputError(
            f"{scene.sparse}: depth needs two photos with at least {MIN_SPARSE} sparse points each; {len(kept)} of {len(model.views)} have them: run `sc3d reconstruct` with more overlap"
        )
    photo_views = [model.views[row] for row in kept]
    used = [seed for seed in seeds if seed is not None]
    centers = np.array([view.center for view in photo_views])
    sources = neighbor_views([model.tracks[row] for row in kept], model.points, centers, settings.num_sources)
    baselines = [
        float(np.median(np.linalg.norm(centers[others] - center, axis=1)))
        for center, others in zip(centers, sources, strict=True)
    ]
    job = StereoJob(
        scene.path.absolute(),
        photo_views,
        [undistorted(view, settings.max_size) for view in photo_views],
        sources,
        [inverse_range(seed, baseline) for seed, baseline in zip(used, baselines, strict=True)],
        used,
        settings.max_size,
        _up(scene, model),
        work.subfolder("passes"),
        scene.depth,
    )
    return job, [view.name for view, seed in zip(model.views, seeds, strict=True) if seed is None]


def _up(scene: Scene, model: SparseModel) -> np.ndarray:
    """(3,) unit, world: z where the scene has a place, else by the cameras."""
    if georeference_path(scene).exists():
        return np.array([0.0, 0.0, 1.0])
    return find_up(view_poses(model.views, scene.images), model.points).up
