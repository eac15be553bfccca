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
from sc3d.propagation.quantile_sketch import QuantileSketch
from sc3d.propagation.terrain import NUM_FEATURES, GroundModel, Scale, relief_features, terrain_of
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
        terrain = terrain_of(graph, known.points, known.up)
        relief = relief_features(graph, known.points, known.up, own_scale(terrain, meters))
        sketches = feature_counts(relief, known.colors)
        model = AppearanceModel.from_sketches(relief, known.colors, sketches)
        examples = sure_points(found.label, found.confidence, channels)
        statistics = model.statistics(found.label, examples, len(channels.ids) - 1)
        return cls.from_statistics(statistics, sketches, terrain, channels, meters)

    @classmethod
    def from_statistics(
        cls,
        statistics: AppearanceStatistics,
        sketches: list[QuantileSketch],
        terrain: GroundModel,
        channels: Channels,
        meters: float | None,
    ) -> SavedAppearance | None:
        """From what the sure points of a whole site teach; None if that is too little. sketches: as of
        `feature_counts`, with heights in `own_scale`; terrain: of the site; meters: as in `learn`
        """
        if has_examples(statistics).sum() < 2:
            return None
        colors = np.stack(edges_of(sketches[NUM_FEATURES:], COLOR_BINS)) if len(statistics) > 1 else None
        relief_edges = np.stack(edges_of(sketches[:NUM_FEATURES], RELIEF_BINS))
        unit, cell = SPACINGS if meters is None else METERS, terrain.cell / own_scale(terrain, meters).unit
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
        scale = self.scale_on(terrain_of(graph, known.points, known.up).spacing, meters)
        self.tell_of_colors(known.colors is not None, origin)
        relief = relief_features(graph, known.points, known.up, scale)
        groups = self.histograms(relief, known.colors)
        own = AppearanceModel(groups).statistics(known.seed_labels, known.agreed, known.num_classes)
        model = SeededModel(groups, self.prior_beside(own, channels))
        statistics = add_prior(model.prior, own)
        trust = Trust.unmeasured(has_examples(statistics), count_disagreement(known))
        return known, LearnedAppearance(model, statistics, trust)

    def scale_on(self, spacing: float, meters: float | None) -> Scale:
        """Of the relief of another scene, in its world units. spacing: of its points; meters: as in
        `require_unit`
        """
        unit = spacing if meters is None else 1 / meters
        return Scale(self.cell * unit, unit)

    def tell_of_colors(self, colored: bool, origin: Path) -> None:
        """A line if the model knows colors that a cloud has not. origin: its file"""
        if self.color_edges is not None and not colored:
            logger.warning("%s knows colors, but the cloud has none: relief alone is used", origin)

    def histograms(self, relief: np.ndarray, colors: np.ndarray | None) -> tuple[Histogram, ...]:
        """Cells of points with the borders of the model, colors first, where it and the points have any.
        relief: (N, 4) in `scale_on`; colors: (N, 3) uint8 or None
        """
        groups = [Histogram.from_features(relief, list(self.relief_edges), RELIEF_BLUR)]
        if self.color_edges is not None and colors is not None:
            groups.insert(0, Histogram.from_features(colors, list(self.color_edges), COLOR_BLUR))
        return tuple(groups)

    def prior_beside(self, own: AppearanceStatistics, channels: Channels) -> AppearanceStatistics:
        """What the model teaches a scene of these channels, whose own agreed points teach `own`, of as many
        groups.
        """
        return _no_heavier(_in_channels(self.statistics[-len(own) :], self.ids, channels), own)


@dataclass(frozen=True)
class SeededModel(AppearanceModel):
    """An appearance model that starts from another site's examples. prior: their statistics"""

    prior: AppearanceStatistics = ()

    def statistics(self, label: np.ndarray, examples: np.ndarray, num_classes: int) -> AppearanceStatistics:
        """Also what the other site's examples teach."""
        return add_prior(self.prior, super().statistics(label, examples, num_classes))

    def offers(self, num_classes: int) -> np.ndarray:
        """The classes of which the other site has enough examples."""
        return has_examples(self.prior)


def add_prior(prior: AppearanceStatistics, own: AppearanceStatistics) -> AppearanceStatistics:
    """What another site's examples and a scene's own teach together."""
    return tuple(first + second for first, second in zip(prior, own, strict=True))


def has_examples(statistics: AppearanceStatistics) -> np.ndarray:
    """(C,) bool classes of which there are enough."""
    return statistics[0].sum(axis=0) >= MIN_EXAMPLES


def own_scale(terrain: GroundModel, meters: float | None) -> Scale:
    """With what the relief of a site is saved: heights in meters, or in point spacings where nobody knows how
    long a meter is. meters: per world unit, None = not known
    """
    return Scale(terrain.cell, terrain.spacing if meters is None else 1 / meters)


def sure_points(label: np.ndarray, confidence: np.ndarray, channels: Channels) -> np.ndarray:
    """(N,) bool points of a finished site that are saved as examples; label: (N,) channels; confidence:
    (N,)
    """
    return (label > 0) & (label < len(channels.ids)) & (confidence >= SURE)


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
