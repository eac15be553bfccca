"""A synthetic city: sites of the generator side by side, made one after the other, so that no cloud of more
than one site is ever in memory.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import open3d as o3d

from sc3d.geometry.cameras import View, pixel_centers, rays
from sc3d.io.folders import link_or_copy
from sc3d.io.images import write_image
from sc3d.io.json_files import write_json
from sc3d.io.progress import progress
from sc3d.scene.class_table import OTHER
from sc3d.scene.scene import Scene
from sc3d.settings.synthesize import Synthesize, SynthesizeCity
from sc3d.synthetic.city_files import CloudWriter, MeshWriter, open_cloud, open_mesh, write_cameras
from sc3d.synthetic.city_flight import fly_over
from sc3d.synthetic.cloud import truth_cloud
from sc3d.synthetic.generate import CLASSES
from sc3d.synthetic.masks import noisy_mask, without_other
from sc3d.synthetic.shading import surface_labels, truth_labels
from sc3d.synthetic.world import World, build_world, ray_tensor

# of the city's middle in the world, m: coordinates of the size of UTM's
OFFSET = np.array([500_000.0, 5_500_000.0, 0.0])
EXTENT = 120.0  # side of a site, m; a multiple of 15 m, so that cells of the ground end at its edges
RAYS = 1 << 19  # cast at a time


@dataclass(frozen=True)
class Site:
    """One site. number: from 0, row by row from the south-west; middle: (3,) float64 in the city's frame,
    whose origin is the city's middle.
    """

    number: int
    middle: np.ndarray
    world: World

    @property
    def own(self) -> np.ndarray:
        """(K,) triangles of the world that reach into the site; the others are its surroundings, which a city
        replaces by other sites.
        """
        low, high = self.world.corners[:, :, :2].min(1), self.world.corners[:, :, :2].max(1)
        return np.flatnonzero(((low < EXTENT / 2) & (high > -EXTENT / 2)).all(1))


@dataclass
class City:
    """What rays need of all sites: `scene` in the city's frame, whose geometry ids are the numbers of
    `sites`.
    """

    scene: o3d.t.geometry.RaycastingScene
    sites: list[SiteLabels]

    def add(self, site: Site) -> None:
        """Append the next site."""
        own = site.own
        corners = (site.world.corners[own] + site.middle).astype(np.float32).reshape(-1, 3)
        self.scene.add_triangles(
            o3d.core.Tensor(corners), o3d.core.Tensor(np.arange(len(corners), dtype=np.uint32).reshape(-1, 3))
        )
        ground = site.world.ground
        self.sites.append(
            SiteLabels(site.middle, site.world.ints[own], ground.half, ground.rasters, ground.rects)
        )

    def truth(self, view: View) -> np.ndarray:
        """(H, W) uint8 truth of the pixels of a view in the city's frame, as `truth_labels`."""
        band = max(1, RAYS // view.width)
        parts = [
            self._truth_rows(view, row, min(row + band, view.height)) for row in range(0, view.height, band)
        ]
        return np.concatenate(parts).reshape(view.height, view.width)

    def _truth_rows(self, view: View, first: int, last: int) -> np.ndarray:
        directions, _ = rays(view, pixel_centers(view.width, last - first) + [0.0, first])
        hits = self.scene.cast_rays(ray_tensor(np.broadcast_to(view.center, directions.shape), directions))
        distance, triangles, numbers = (
            hits[name].numpy() for name in ("t_hit", "primitive_ids", "geometry_ids")
        )
        truth = np.full(len(directions), OTHER, np.uint8)
        for number in np.unique(numbers[np.isfinite(distance)]):
            rows = np.flatnonzero(numbers == number)
            points = view.center + directions[rows] * distance[rows, None]
            truth[rows] = self.sites[number].truth(points, triangles[rows].astype(np.int64))
        return truth


@dataclass(frozen=True)
class SiteLabels:
    """What tells the label of a place on a site: (3,) middle; (K, 3) material, label and object of its
    triangles; the plan of its ground.
    """

    middle: np.ndarray
    ints: np.ndarray
    half: float
    rasters: np.ndarray
    rects: np.ndarray

    def truth(self, points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
        """(N,) uint8 as `truth_labels` of surface points (N, 3), city's frame, on triangles (N,) of the site."""
        local, plan = (
            (points - self.middle).astype(np.float32),
            (self.half, EXTENT / 2, self.rasters, self.rects),
        )
        return truth_labels(surface_labels(local, triangles, self.ints, *plan), local, triangles, EXTENT / 2)


def make_sites(settings: SynthesizeCity) -> Iterator[Site]:
    """The sites, each built when it is asked for; level at their edges, so that they meet."""
    columns, rows = settings.sites
    for number in range(columns * rows):
        middle = np.array(
            [
                (number % columns - (columns - 1) / 2) * EXTENT,
                (number // columns - (rows - 1) / 2) * EXTENT,
                0.0,
            ]
        )
        yield Site(
            number,
            middle,
            build_world(Synthesize(seed=1000 * settings.seed + number, extent=EXTENT), level_edges=True),
        )


def synthesize_city(settings: SynthesizeCity) -> dict[str, object]:
    """Write cloud.ply (a link to truth.ply, which has the true labels), mesh.ply, sparse/0, truth/, masks/,
    confidence/ and classes.json.

    returns: points, views, triangles, mask_accuracy (over pixels of a class)
    """
    scene, city = Scene(settings.scene), City(o3d.t.geometry.RaycastingScene(), [])
    columns, rows = settings.sites
    num_points = columns * rows * settings.points_per_site
    with ExitStack() as files:
        cloud = files.enter_context(open_cloud(scene.path / "truth.ply", num_points))
        mesh = files.enter_context(open_mesh(scene.mesh))
        objects = 0
        for site in progress(make_sites(settings), "building", "site", total=columns * rows):
            _write_site(site, settings, cloud, mesh, objects)
            city.add(site)
            objects += int(site.world.ints[:, 2].max())
    views = fly_over((columns * EXTENT, rows * EXTENT), settings)
    write_cameras(scene.sparse, [view.shifted(-OFFSET) for view in views])
    accuracy = _write_masks(scene, city, views, settings.seed)
    link_or_copy(Path("truth.ply"), scene.cloud)
    write_json(scene.classes, CLASSES)
    return {"points": num_points, "views": len(views), "triangles": mesh.triangles, "mask_accuracy": accuracy}


def _write_site(
    site: Site, settings: SynthesizeCity, cloud: CloudWriter, mesh: MeshWriter, objects: int
) -> None:
    """objects: number of those on the sites before"""
    made = truth_cloud(
        site.world, settings.points_per_site, np.random.default_rng([settings.seed, 5, site.number])
    )
    names = ("normals", "colors", "label")
    instance = made.point["instance"].numpy()
    cloud.append(
        made.point.positions.numpy() + site.middle + OFFSET,
        **{name: made.point[name].numpy() for name in names},
        instance=np.where(instance > 0, instance + objects, 0).astype(np.int32),
    )
    mesh.append(site.world.corners[site.own].astype(np.float64) + site.middle + OFFSET)


def _write_masks(scene: Scene, city: City, views: list[View], seed: int) -> float:
    """True and noisy masks of all views; returns the share of the labelled pixels that the noisy ones have
    right.
    """
    right = labelled = 0
    for number, view in enumerate(progress(views, "masks", "view")):
        truth = city.truth(view)
        label = without_other(truth)
        mask, confidence = noisy_mask(label, Synthesize.mask_noise, np.random.default_rng([seed, 4, number]))
        right += int(((mask == label) & (label != 0)).sum())
        labelled += int((label != 0).sum())
        for folder, image in ((scene.truth, truth), (scene.masks, mask), (scene.confidence, confidence)):
            write_image(folder / f"{Path(view.name).stem}.png", image)
    return right / max(labelled, 1)
