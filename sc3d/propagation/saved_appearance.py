"""What classes look like, from one site to another: the examples' histograms of `appearance`, with the
borders of their bins and the unit of heights, so that they are the same bins on another cloud.

A site's own borders are quantiles and its heights are in point spacings, which differ from site to site: a
model keeps its borders, and heights in meters where the scene is georeferenced. Where no scale is known,
heights stay in point spacings, and both clouds must be as dense.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sc3d.errors import InputError
from sc3d.geometry.graph import Graph
from sc3d.propagation.appearance import (
    COLOR_BINS,
    COLOR_BLUR,
    RELIEF_BINS,
    RELIEF_BLUR,
    AppearanceModel,
    AppearanceStatistics,
    LearnedAppearance,
    edges_of,
    feature_counts,
)
from sc3d.propagation.histogram import Histogram
from sc3d.propagation.labelled_points import MIN_EXAMPLES, LabelledPoints
from sc3d.propagation.terrain import NUM_FEATURES, Scale, relief_features, terrain_of
from sc3d.propagation.trust import Trust
from sc3d.propagation.vote_evidence import count_disagreement
from sc3d.scene.channels import Channels
from sc3d.scene.labels import Labels
from sc3d.scene.site_model import ModelPart

SURE = 0.7  # confidence of points that are saved as examples
METERS, SPACINGS = "meters", "point spacings"

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class SavedAppearance:
    """What a site taught. ids: (C,) uint8 classes; unit: of heights; cell: of the raster of the ground, in it

    relief_edges: (4, RELIEF_BINS - 1); color_edges: (3, COLOR_BINS - 1), None = the cloud had no colors
    statistics: as of `AppearanceModel`, of the classes `ids`: colors first, if there are any
    """

    ids: np.ndarray
    unit: str
    cell: float
    relief_edges: np.ndarray
    color_edges: np.ndarray | None
    statistics: AppearanceStatistics

    def to_part(self) -> ModelPart:
        """As a part of a site model."""
        counts = dict(zip(self._groups, self.statistics, strict=True))
        arrays = {"ids": self.ids, "relief_edges": self.relief_edges, **counts}
        if self.color_edges is not None:
            arrays["color_edges"] = self.color_edges
        return ModelPart({"heights": self.unit, "ground_cell": self.cell}, arrays)

    @property
    def _groups(self) -> tuple[str, ...]:
        return ("relief_counts",) if self.color_edges is None else ("color_counts", "relief_counts")

    @classmethod
    def from_part(cls, part: ModelPart, origin: Path) -> SavedAppearance:
        """From a part of a site model; InputError if it does not hold what it should. origin: its file"""
        arrays, colored = part.arrays, "color_edges" in part.arrays
        unit, cell = part.facts.get("heights"), part.facts.get("ground_cell")
        num_classes = len(arrays.get("ids", ()))
        shapes = {
            "ids": (num_classes,),
            "relief_edges": (NUM_FEATURES, RELIEF_BINS - 1),
            "relief_counts": (RELIEF_BINS**NUM_FEATURES, num_classes),
        }
        if colored:
            shapes |= {"color_edges": (3, COLOR_BINS - 1), "color_counts": (COLOR_BINS**3, num_classes)}
        fits = all(name in arrays and arrays[name].shape == shape for name, shape in shapes.items())
        known = unit in (METERS, SPACINGS) and isinstance(cell, float) and 0 < cell < np.inf
        if (
            not isinstance(cell, float)
            or not fits
            or not known
            or not num_classes
            or any((values < 0).any() for values in _counts(part))
        ):
            raise InputError(f"{origin} is damaged: its appearance has not the arrays of this version")
        edges = {name: arrays[name].astype(np.float32) for name in shapes if name.endswith("edges")}
        if not all(np.isfinite(part).all() and (np.diff(part) >= 0).all() for part in edges.values()):
            raise InputError(f"{origin} is damaged: the borders of its bins do not rise")
        statistics = tuple(values.astype(np.int64) for values in _counts(part))
        ids = arrays["ids"].astype(np.uint8)
        return cls(ids, str(unit), cell, edges["relief_edges"], edges.get("color_edges"), statistics)

    @classmethod
    def learn(
        cls, graph: Graph, known: LabelledPoints, found: Labels, channels: Channels, meters: float | None
    ) -> SavedAppearance | None:
        """From the labels of a finished site, as far as they are sure; None if that is too little.

        known, found: in the order of the cloud; found: channels; meters: per world unit, None = not known
        """
        known, found = known.ordered(graph.order), found[graph.order]
        classes = len(channels.ids) - 1
        examples = (found.label > 0) & (found.label <= classes) & (found.confidence >= SURE)
        terrain = terrain_of(graph, known.points, known.up)
        scale = Scale(terrain.cell, terrain.spacing if meters is None else 1 / meters)
        relief = relief_features(graph, known.points, known.up, scale)
        sketches = feature_counts(relief, known.colors)
        model = AppearanceModel.from_sketches(relief, known.colors, sketches)
        statistics = model.statistics(found.label, examples, classes)
        if (statistics[0].sum(axis=0) >= MIN_EXAMPLES).sum() < 2:
            return None
        colors = None if known.colors is None else np.stack(edges_of(sketches[NUM_FEATURES:], COLOR_BINS))
        relief_edges = np.stack(edges_of(sketches[:NUM_FEATURES], RELIEF_BINS))
        unit = SPACINGS if meters is None else METERS
        cell = terrain.cell / scale.unit
        return cls(channels.ids[1:], unit, cell, relief_edges, colors, statistics)

    def require_unit(self, meters: float | None, origin: Path) -> None:
        """InputError if heights of the model and of a scene cannot be compared; a warning where only those of
        equally dense clouds can be. meters: per world unit of the scene, None = not known
        """
        if self.unit == SPACINGS and meters is None:
            logger.warning(
                "%s and the scene are not georeferenced: heights are compared in point spacings, which is right"
                " only if both clouds are equally dense",
                origin,
            )
        elif self.unit == SPACINGS:
            raise InputError(
                f"{origin} has heights in point spacings, as its scene was not georeferenced, but this one is:"
                " run `sc3d georeference` there, and save the model again"
            )
        elif meters is None:
            raise InputError(
                f"{origin} has heights in meters, but the scene has no scale: run `sc3d georeference SCENE` first"
            )

    def on(
        self, graph: Graph, known: LabelledPoints, channels: Channels, meters: float | None, origin: Path
    ) -> tuple[LabelledPoints, LearnedAppearance]:
        """The model on the cloud of another scene, with what the agreed points of that scene teach.

        graph, known: in the order of the graph; meters: as in `require_unit`; origin: its file
        """
        spacing = terrain_of(graph, known.points, known.up).spacing
        unit = spacing if meters is None else 1 / meters
        relief = relief_features(graph, known.points, known.up, Scale(self.cell * unit, unit))
        colored = self.color_edges is not None and known.colors is not None
        if colored != (self.color_edges is not None):
            logger.warning("%s knows colors, but the cloud has none: relief alone is used", origin)
        groups = [Histogram.from_features(relief, list(self.relief_edges), RELIEF_BLUR)]
        if colored and self.color_edges is not None and known.colors is not None:
            groups.insert(0, Histogram.from_features(known.colors, list(self.color_edges), COLOR_BLUR))
        given = _in_channels(self.statistics[-len(groups) :], self.ids, channels)
        own = AppearanceModel(tuple(groups)).statistics(known.seed_labels, known.agreed, known.num_classes)
        model = SeededModel(tuple(groups), _no_heavier(given, own))
        statistics = model.with_prior(own)
        trust = Trust.unmeasured(statistics[0].sum(axis=0) >= MIN_EXAMPLES, count_disagreement(known))
        return known, LearnedAppearance(model, statistics, trust)


@dataclass(frozen=True)
class SeededModel(AppearanceModel):
    """An appearance model that starts from another site's examples. prior: their statistics"""

    prior: AppearanceStatistics = ()

    def statistics(self, label: np.ndarray, examples: np.ndarray, num_classes: int) -> AppearanceStatistics:
        """Also what the other site's examples teach."""
        return self.with_prior(super().statistics(label, examples, num_classes))

    def with_prior(self, own: AppearanceStatistics) -> AppearanceStatistics:
        return tuple(first + second for first, second in zip(self.prior, own, strict=True))

    def offers(self, num_classes: int) -> np.ndarray:
        """The classes of which the other site has enough examples."""
        return self.prior[0].sum(axis=0) >= MIN_EXAMPLES


def _counts(part: ModelPart) -> list[np.ndarray]:
    """Of an appearance, colors first."""
    return [part.arrays[name] for name in ("color_counts", "relief_counts") if name in part.arrays]


def _in_channels(
    statistics: AppearanceStatistics, ids: np.ndarray, channels: Channels
) -> AppearanceStatistics:
    """Statistics of the classes `ids` as those of the channels of a scene; of none of the classes, nothing is
    known.
    """
    own = channels.ids[1:].tolist()
    columns = [ids.tolist().index(label) if label in ids else -1 for label in own]
    columns += [-1] if channels.none else []
    return tuple(np.where(np.array(columns) >= 0, counts[:, columns], 0) for counts in statistics)


def _no_heavier(given: AppearanceStatistics, own: AppearanceStatistics) -> AppearanceStatistics:
    """Another site's examples, which weigh no more than a scene's own, if it has enough of two classes."""
    counts = own[0].sum(axis=0)
    if (counts >= MIN_EXAMPLES).sum() < 2:
        return given
    share = min(1.0, float(counts.sum()) / max(float(given[0].sum()), 1.0))
    return tuple(np.rint(counts * share).astype(np.int64) for counts in given)
