"""What the objects that a segmenter found in the photos say of the objects of a site: where two places are
one object in most photos that show both, they are one; where they are two, they part.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from sc3d.errors import InputError
from sc3d.geometry.cameras import View, in_image, project
from sc3d.instances.agglomeration import agglomerate
from sc3d.instances.kinds import Kind
from sc3d.instances.object_map import MIN_AREA, Tops
from sc3d.instances.regions import neighbors, renumbered
from sc3d.instances.sight import in_sight
from sc3d.instances.site_frame import SiteFrame
from sc3d.instances.trees import MIN_CROWN
from sc3d.io.images import read_orientation
from sc3d.io.orientation import inverse, turned
from sc3d.io.progress import progress
from sc3d.scene.object_image import ObjectImage, ReadObjects
from sc3d.scene.scene import Scene

logger = logging.getLogger(__name__)

BLOCK, SAMPLE = (
    1.0,
    0.33,
)  # side of the places that photos are asked about; distance of the points looked for there, m
WALL, MAX_DOWN = 1.5, 8  # distance of the points down a wall, m, and how many at most
PRIOR = 2  # photos that the shape of the site counts as much as, at each side of a place
SURE = 0.5  # of the points of a place that a photo shows, more are on one of its objects


@dataclass(frozen=True)
class PhotoVotes:
    """views: those that have a file of objects, with the file; read: reads it; broken: files that it
    refused
    """

    scene: Scene
    frame: SiteFrame
    views: list[tuple[View, Path]]
    read: ReadObjects
    broken: dict[Path, str] = field(default_factory=dict)

    @classmethod
    def of_scene(cls, scene: Scene, frame: SiteFrame, read: ReadObjects) -> PhotoVotes | None:
        """None where no photo has objects."""
        if not scene.instances.is_dir():
            return None
        files = [
            (view, scene.photo_names.path(scene.instances, view.name, ".json")) for view in scene.model.views
        ]
        found = [(view, file) for view, file in files if file.exists()]
        return cls(scene, frame, found, read) if found else None

    def refine(self, tops: Tops, number: int, kind: Kind, regions: np.ndarray) -> np.ndarray:
        """(H, W) int32 regions from 1 of one of the kinds of `tops`, parted and joined as the photos have
        it.
        """
        atoms = _atoms(regions, round(BLOCK / tops.grid.pixel) or 1)
        edges = _edges(atoms)
        if not len(edges):
            return regions
        same, differ = self._count(tops, number, kind, atoms, edges)
        if not (same + differ).any():
            return regions
        owner = np.zeros(atoms.max() + 1, np.int64)
        owner[atoms.ravel()] = regions.ravel()
        together = owner[edges[:, 0]] == owner[edges[:, 1]]
        weights = np.where(together, PRIOR, -PRIOR) + same - differ
        group = agglomerate(len(owner), edges, weights)
        sizes = np.bincount(atoms.ravel(), minlength=len(owner)).astype(np.float64) * tops.grid.pixel**2
        sizes[0] = 0.0
        least = {"roofs": MIN_AREA, "crowns": MIN_CROWN}.get(kind.how, 0.0)
        group = _joined(group, sizes, edges, weights, least)
        return renumbered(np.where(atoms > 0, group[atoms] + 1, 0))

    def _count(
        self, tops: Tops, number: int, kind: Kind, atoms: np.ndarray, edges: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """(E,) int64 photos in which the two places of each edge are one object, and those in which they
        are two.
        """
        points, places = _samples(tops, number, atoms)
        world = self.frame.to_world(points)
        same, differ = np.zeros(len(edges), np.int64), np.zeros(len(edges), np.int64)
        for view, image in self._images():
            eye = self.frame.place(view.center[None])[0]
            shown = np.flatnonzero(in_image(view, project(view, world)[0]))
            shown = shown[in_sight(tops.grid, tops.all, points[shown], eye)]
            numbers = _look_up(image, view, project(view, world[shown])[0])
            numbers = np.where(np.isin(image.class_ids[numbers], kind.ids), numbers, 0)
            seen = _majority(places[shown], numbers, int(atoms.max()) + 1)
            first, second = seen[edges[:, 0]], seen[edges[:, 1]]
            both = (first > 0) & (second > 0)
            same += both & (first == second)
            differ += both & (first != second)
        return same, differ

    def _images(self) -> Iterator[tuple[View, ObjectImage]]:
        for view, file in progress(self.views, "objects of the photos", "photo"):
            if file in self.broken:
                continue
            try:
                found = self.read(file)
            except InputError as error:
                self._leave_out(file, str(error))
                continue
            photo = self.scene.photo(view.name)
            turn = inverse(read_orientation(photo)) if photo.is_file() else 1
            yield view, ObjectImage(turned(found.numbers, turn), found.class_ids)

    def _leave_out(self, file: Path, why: str) -> None:
        """The work is done by now: what photos say is left out with a word."""
        if not self.broken:
            logger.warning("photos whose objects cannot be read have no say, the first of them: %s", why)
        self.broken[file] = why


def _atoms(regions: np.ndarray, side: int) -> np.ndarray:
    """(H, W) int64 number from 1 of the square block of each cell within its region; 0 = no region."""
    rows, columns = np.indices(regions.shape) // side
    blocks = rows * (columns.max() + 1) + columns
    keys = blocks * (int(regions.max()) + 1) + regions
    _, numbers = np.unique(np.where(regions > 0, keys, -1), return_inverse=True)
    numbers = numbers.reshape(regions.shape)
    return numbers if (regions == 0).any() else numbers + 1


def _edges(atoms: np.ndarray) -> np.ndarray:
    """(E, 2) pairs of atoms that touch, the smaller first."""
    pairs = np.concatenate([np.stack([atoms[a].ravel(), atoms[b].ravel()], axis=1) for a, b in neighbors()])
    pairs = np.sort(pairs[(pairs > 0).all(axis=1) & (pairs[:, 0] != pairs[:, 1])], axis=1)
    return np.unique(pairs, axis=0)


def _samples(tops: Tops, number: int, atoms: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(K, 3) points of one of the kinds on the cells of atoms, m: on top and, of walls, down to the lowest;
    and the atom (K,) of each.
    """
    step = max(1, round(SAMPLE / tops.grid.pixel))
    chosen = np.zeros(atoms.shape, bool)
    chosen[::step, ::step] = True
    high, low = tops.kinds[number], tops.lows[number]
    chosen &= (atoms > 0) & np.isfinite(high)
    places, owners = tops.grid.centers()[chosen.ravel()], atoms[chosen]
    high, low = high[chosen], low[chosen]
    down = np.minimum(np.floor((high - low) / WALL), MAX_DOWN).astype(np.int64)
    rows = np.repeat(np.arange(len(places)), down + 1)
    steps = np.arange(len(rows)) - np.repeat(np.cumsum(down + 1) - down - 1, down + 1)
    return np.column_stack([places[rows], high[rows] - WALL * steps]), owners[rows]


def _look_up(image: ObjectImage, view: View, pixels: np.ndarray) -> np.ndarray:
    """(K,) number of the object at pixels (K, 2) of a view, whatever size its objects have."""
    height, width = image.numbers.shape
    columns = np.clip((pixels[:, 0] * width / view.width).astype(np.int64), 0, width - 1)
    rows = np.clip((pixels[:, 1] * height / view.height).astype(np.int64), 0, height - 1)
    return image.numbers[rows, columns]


def _majority(places: np.ndarray, numbers: np.ndarray, count: int) -> np.ndarray:
    """(count,) the object that more than SURE of the points of each place are on, 0 = none is."""
    result = np.zeros(count, np.int64)
    if len(places):
        top = int(numbers.max()) + 1
        pairs, votes = np.unique(places * top + numbers, return_counts=True)
        won = votes > SURE * np.bincount(places, minlength=count)[pairs // top]
        result[pairs[won] // top] = pairs[won] % top
    return result


def _joined(
    group: np.ndarray, sizes: np.ndarray, edges: np.ndarray, weights: np.ndarray, least: float
) -> np.ndarray:
    """The groups (A,) of atoms, of which those smaller than `least` m2 join the one beside them that they
    belong to most, the smallest first. sizes: (A,) m2; edges: (E, 2); weights: (E,)
    """
    group = group.copy()
    while True:
        areas = np.bincount(group, sizes, minlength=len(group))
        between = group[edges]
        apart = between[:, 0] != between[:, 1]
        small = np.unique(between[apart])
        small = small[(areas[small] < least) & (areas[small] > 0)]
        if not len(small):
            return group
        smallest = int(small[np.lexsort((small, areas[small]))[0]])
        touching = apart & (between == smallest).any(axis=1)
        others = between[touching].sum(axis=1) - smallest
        ids, place = np.unique(others, return_inverse=True)
        best = ids[np.argmax(np.bincount(place, weights[touching]))]
        group[group == smallest] = best
