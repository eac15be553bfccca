"""What `propagate` keeps of each tile between its passes: the neighbor graph of the tile and its margin, and
arrays of the tile's own points.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np

from sc3d.geometry.graph import Graph, build_graph
from sc3d.io.chunked_clouds import CloudFile, columns, positions
from sc3d.labelling.cloud import CloudExtent
from sc3d.propagation.appearance import (
    COLOR_BINS,
    COLOR_BLUR,
    RELIEF_BINS,
    RELIEF_BLUR,
    AppearanceModel,
)
from sc3d.propagation.histogram import Histogram
from sc3d.propagation.labelled_points import LabelledPoints, tie_breakers
from sc3d.propagation.misplaced import Misplaced
from sc3d.propagation.none_evidence import NoneRates
from sc3d.propagation.propagate import seeds_in_channels
from sc3d.propagation.terrain import NUM_FEATURES
from sc3d.scene.channels import Channels
from sc3d.scene.corrections import Corrections
from sc3d.scene.labelled_cloud import VOTES, unit_normals
from sc3d.scene.labels import UNSEEN, Labels
from sc3d.scene.scene import Scene
from sc3d.settings.labels import Propagate
from sc3d.tiling.given_normals import NORMALS, has_usable_normals
from sc3d.tiling.store import Results, TileStore, TileWithHalo

GRAPH = tuple(field.name for field in fields(Graph))
# of Evidence, in the order of the graph
KNOWN = ("points", "votes", *(field.name for field in fields(Labels)), "colors")


@dataclass(frozen=True)
class BareStart:
    """A cloud without labels and votes, which a model labels. centers: (M, 3) of the cameras; estimated:
    whether its normals are
    """

    centers: np.ndarray
    estimated: bool

    @classmethod
    def of_cloud(cls, cloud: CloudFile, scene: Scene) -> BareStart:
        return cls(np.array([view.center for view in scene.model.views]), not has_usable_normals(cloud))

    def know(
        self, records: np.ndarray, origin: np.ndarray, channels: Channels
    ) -> tuple[Labels, np.ndarray, np.ndarray]:
        """Labels and votes (N, channels) float32, which are empty, and normals (N, 3) float32 of records;
        origin: (3,) as in `NeighborIndex`.
        """
        empty, count = np.zeros(len(records), np.uint8), (len(records), channels.count)
        labels = Labels(empty, empty.astype(np.float32), empty + np.uint8(UNSEEN), empty.astype(np.int32))
        given = None if self.estimated else columns(records, NORMALS)
        normals = unit_normals(given, positions(records), self.centers, origin)
        return labels, np.zeros(count, np.float32), normals


@dataclass(frozen=True)
class PropagateJob:
    """What the task of a tile needs to know. margin: world units; channels: of the votes; shared: folder
    for what all tiles read; up: (3,) of the cameras, None = not known; rates: of votes for none, once
    counted; levels: as of `LabelledPoints`; misplaced: votes that count less, once measured; start: where
    nothing is known of the points
    """

    settings: Propagate
    extent: CloudExtent
    store: TileStore
    results: Results
    margin: float
    channels: Channels
    shared: Path
    up: np.ndarray | None = None
    corrections: Corrections = Corrections()
    rates: NoneRates | None = None
    levels: np.ndarray | None = None
    misplaced: Misplaced | None = None
    start: BareStart | None = None

    @property
    def colored(self) -> bool:
        return {"red", "green", "blue"} <= set(self.store.names)


@dataclass(frozen=True)
class TileGraph:
    """A tile with its margin, in the canonical order of its graph. core: (N,) bool points of the tile itself"""

    tile: int
    halo: TileWithHalo
    graph: Graph
    known: LabelledPoints
    core: np.ndarray

    @classmethod
    def load(cls, job: PropagateJob, tile: int) -> TileGraph:
        """The graph is built at the first time and kept in files, of which a pass reads what it looks at."""
        halo = job.store.with_halo(tile, job.margin)
        if not job.results.has(tile, f"part_{KNOWN[-1]}"):
            _build(job, tile, halo)
        graph, known = Graph(*_mapped(job, tile, GRAPH)), _mapped(job, tile, KNOWN)
        evidence = LabelledPoints(
            known[0],
            Labels(*known[2:-1]),
            known[1],
            known[-1] if job.colored else None,
            none=job.channels.none,
            rates=job.rates,
            levels=job.levels,
        )
        part = cls(tile, halo, graph, evidence, halo.core[graph.order])
        if job.misplaced is None:
            return part
        placed = job.misplaced.without(evidence, part.appearance(job).groups[-1].cell)
        return replace(part, known=placed)

    def own(self, values: np.ndarray) -> np.ndarray:
        """Values of the tile's own points, as `Results` keeps them, from values (N, ...) of the part."""
        result = np.empty_like(values)
        result[self.graph.order] = values
        return result[self.halo.core]

    def around(self, job: PropagateJob, name: str) -> np.ndarray:
        """Values of all points of the part, from what their tiles keep."""
        return job.results.around(self.halo, name)[self.graph.order]

    def own_in_order(self, values: np.ndarray) -> np.ndarray:
        """The opposite of `own`; 0 at the points of the margin."""
        result = np.zeros((len(self.core), *values.shape[1:]), values.dtype)
        result[self.halo.core] = values
        return result[self.graph.order]

    def appearance(self, job: PropagateJob) -> AppearanceModel:
        """Histogram cells of all points of the part."""
        return appearance_of(self.around(job, "cells"))


def appearance_of(cells: np.ndarray) -> AppearanceModel:
    """Raters from the cells (N, G) int32 that `cells_of` gives."""
    relief = relief_histogram(cells[:, -1])
    return AppearanceModel(
        (relief,) if cells.shape[1] == 1 else (Histogram(cells[:, 0], (COLOR_BINS,) * 3, COLOR_BLUR), relief)
    )


def relief_histogram(cell: np.ndarray) -> Histogram:
    """Of the relief of points, from the cell (N,) int32 of each."""
    return Histogram(cell, (RELIEF_BINS,) * NUM_FEATURES, RELIEF_BLUR)


def cells_of(appearance: AppearanceModel) -> np.ndarray:
    """(N, G) int32 cell of each point in each group."""
    return np.stack([group.cell for group in appearance.groups], axis=1)


def _build(job: PropagateJob, tile: int, halo: TileWithHalo) -> None:
    evidence, normals, touched = _evidence(job, halo)
    colors, box = evidence.colors if job.settings.color else None, (job.extent.low, job.extent.high)
    graph = build_graph(
        evidence.points, normals, job.settings.num_neighbors, colors, tie_breakers(evidence, normals), box
    )
    known = evidence.ordered(graph.order)
    values = (
        known.points,
        known.known_votes,
        *(getattr(known.seeds, field.name) for field in fields(Labels)),
        known.colors if job.colored else np.empty(0),
    )
    job.results.write(tile, touched=touched)
    if job.start is not None and normals is not None:
        job.results.write(tile, normals=normals[halo.core])
    for names, arrays in ((GRAPH, [getattr(graph, name) for name in GRAPH]), (KNOWN, values)):
        job.results.write(tile, **{f"part_{name}": array for name, array in zip(names, arrays, strict=True)})


def _mapped(job: PropagateJob, tile: int, names: tuple[str, ...]) -> list[np.ndarray]:
    return [np.asarray(job.results.read(tile, f"part_{name}", mapped=True)) for name in names]


def _evidence(job: PropagateJob, halo: TileWithHalo) -> tuple[LabelledPoints, np.ndarray | None, np.ndarray]:
    """What is known of the window's points, by row, their normals, and how many lie in each correction."""
    records = halo.gather(job.store.records)
    points, colors = positions(records), columns(records, ("red", "green", "blue"))
    votes: np.ndarray | None
    normals: np.ndarray | None
    if job.start is not None:
        labels, votes, normals = job.start.know(records, job.extent.low, job.channels)
    else:
        names = {"label": np.uint8, "confidence": np.float32, "state": np.uint8, "num_views": np.int32}
        labels = Labels(*(records[name].astype(kind) for name, kind in names.items()))
        votes = columns(records, [f"{VOTES}{name}" for name in job.channels.names])
        normals = columns(records, NORMALS)
    labels, touched = job.corrections.apply(labels, points)
    labels = seeds_in_channels(labels, job.channels, "the cloud")
    return LabelledPoints(points, labels, votes, colors), normals, touched
