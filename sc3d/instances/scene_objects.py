"""The objects of a scene's labelled cloud, whether it is in memory or read in parts."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np

from sc3d.instances.kinds import countable_kinds
from sc3d.instances.object_map import Chunk, ObjectMap, map_objects
from sc3d.instances.photo_votes import PhotoVotes
from sc3d.instances.site_frame import SiteFrame
from sc3d.scene.class_table import ClassTable
from sc3d.scene.object_image import ReadObjects
from sc3d.scene.scene import Scene

logger = logging.getLogger(__name__)

# positions (N, 3) world, label (N,) uint8 ids, and (N,) bool, confirmed by several photos, of all parts
Parts = Callable[[], Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]]


@dataclass
class SceneObjects:
    """Looks up the object of each point. seen, lost: points of each kind that were asked for, and without
    one
    """

    frame: SiteFrame
    table: ClassTable
    map: ObjectMap
    seen: dict[int, int] = field(default_factory=dict)
    lost: dict[int, int] = field(default_factory=dict)

    @classmethod
    def tell_apart(
        cls, scene: Scene, parts: Parts, read_objects: ReadObjects | None = None
    ) -> SceneObjects | None:
        """Those of countable classes; None without a class table, or if it has no such class. read_objects:
        of the photos, which then have a say
        """
        if not scene.classes.exists():
            return None
        table = scene.class_table()
        if not countable_kinds(table):
            return None
        frame = SiteFrame.of_scene(scene)

        def chunks() -> Iterator[Chunk]:
            for positions, label, sure in parts():
                yield Chunk(frame.place(positions), label, sure)

        votes = PhotoVotes.of_scene(scene, frame, read_objects) if read_objects is not None else None
        found = map_objects(chunks, table, votes.refine if votes is not None else None)
        if found.why:
            logger.warning("no objects are told apart: %s", found.why)
        elif found.kinds:
            frame.warn(scene)
        return cls(frame, table, found)

    def find(self, positions: np.ndarray, label: np.ndarray) -> np.ndarray:
        """(N,) uint32 object of each point, 0 = none. positions: (N, 3) world; label: (N,) uint8 ids."""
        found = self.map.find(self.frame.place(positions), label)
        for kind in self.map.kinds:
            chosen = np.isin(label, kind.ids)
            first = kind.ids[0]
            self.seen[first] = self.seen.get(first, 0) + int(chosen.sum())
            self.lost[first] = self.lost.get(first, 0) + int((chosen & (found == 0)).sum())
        return found

    def figures(self) -> dict[str, int]:
        """Objects by class, and one line about the points that belong to none."""
        left = [
            f"{self.table.name(label)} {lost:,} of {self.seen[label]:,}"
            for label, lost in self.lost.items()
            if lost
        ]
        if left:
            logger.info(
                "points of no object, as it is too low or too small, or no second photo confirms it: %s",
                ", ".join(left),
            )
        return self.map.counts(self.table)
