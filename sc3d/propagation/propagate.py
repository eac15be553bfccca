"""From seeds to a label for every point that the graph connects to one (paper section 3.4): `propagate` is the whole
method, in the paper's order. By tiles, with the same signature: `tiling.propagate`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np
import open3d as o3d

from sc3d.errors import InputError
from sc3d.geometry.graph import Graph, build_graph
from sc3d.georeferencing.georeference import read_georeference
from sc3d.georeferencing.up_direction import scene_up
from sc3d.instances.scene_objects import SceneObjects
from sc3d.io.clouds import read_cloud, write_geometry
from sc3d.propagation.appearance import LearnedAppearance, learn_appearance, plausible, uses_appearance
from sc3d.propagation.labelled_points import LabelledPoints, tie_breakers
from sc3d.propagation.none_evidence import NoneRates, count_votes
from sc3d.propagation.potts import minimize_energy
from sc3d.propagation.region_growing import grow_regions, reachable, vote_nearest
from sc3d.propagation.saved_appearance import SavedAppearance
from sc3d.scene.channels import Channels
from sc3d.scene.corrections import Corrections
from sc3d.scene.labelled_cloud import (
    Votes,
    is_confirmed,
    point_arrays,
    read_labelled,
    read_votes,
    with_labels,
)
from sc3d.scene.labels import CORRECTED, LOCKED, PROPAGATED, SEED, UNLOCKED, UNSEEN, Labels
from sc3d.scene.object_image import ReadObjects
from sc3d.scene.scene import Scene
from sc3d.scene.site_model import ModelPart, read_model
from sc3d.settings.labels import Propagate

FILLED = 0.5  # confidence of what the nearest label fills
MAKE_CLOUD = "run `sc3d extract SCENE` first, or `sc3d import` a cloud"

Learner = Callable[[Graph, LabelledPoints], tuple[LabelledPoints, LearnedAppearance | None]]


def propagate(
    points: LabelledPoints,
    normals: np.ndarray | None,
    settings: Propagate,
    graph: Graph | None = None,
    learn: Learner = learn_appearance,
) -> Labels:
    """Label the points that have none; all arrays, given and returned, in the order of the cloud.

    normals: (N, 3) unit, oriented, or None = estimated; graph: of these points, if it is there already
    learn: how the appearance is learned; where another site taught it, points get a label without a seed, too
    geometry, knn: seeds keep their label (with verify_seeds: those that look like their class); map: needs votes
    """
    graph = graph or neighbor_graph(points, normals, settings)  # normals, curvature, similarity (eq. 5 to 7)
    if points.none:  # how often views find nothing, where there is something
        points = replace(points, rates=NoneRates.from_counts(count_votes(points.known_votes)))
    known = points.ordered(graph.order)
    known, appearance = learn(graph, known) if uses_appearance(settings) else (known, None)
    seeds = known.seed_labels
    if settings.method == "map":
        label, confidence = minimize_energy(
            graph, known, appearance, settings
        )  # eq. 8, with the sign of Potts
        if learn is learn_appearance:
            label = np.where(reachable(graph, seeds), label, 0).astype(np.uint8)
    else:
        if appearance is not None:
            seeds = plausible(known, appearance)
        label, confidence = spread(graph, known.points, seeds, settings)  # eq. 9
    if settings.fill:
        label, confidence = fill_from_nearest(known.points, label, confidence)
    labels = with_states(known.seeds, seeds, (label, confidence), settings)
    return labels[np.argsort(graph.order)]


def neighbor_graph(points: LabelledPoints, normals: np.ndarray | None, settings: Propagate) -> Graph:
    """The graph of the points of a whole cloud."""
    colors, ties = points.colors if settings.color else None, tie_breakers(points, normals)
    return build_graph(points.points, normals, settings.num_neighbors, colors, ties)


def spread(
    graph: Graph, points: np.ndarray, seeds: np.ndarray, settings: Propagate
) -> tuple[np.ndarray, np.ndarray]:
    """Labels and confidences by knn or geometry; points: (N, 3), seeds: (N,) uint8, both in the order of the graph."""
    if settings.method == "knn":
        return vote_nearest(points, seeds, settings.num_neighbors)
    return grow_regions(graph, seeds)


def fill_from_nearest(
    points: np.ndarray, label: np.ndarray, confidence: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Label also what no edge connects to a seed, half as sure. points: (N, 3); label, confidence: (N,)."""
    if label.all() or not label.any():
        return label, confidence
    filled, share = vote_nearest(points, label.astype(np.uint8), 1)
    return np.where(label == 0, filled, label), np.where(label == 0, FILLED * share, confidence)


def with_states(
    given: Labels, seeds: np.ndarray, found: tuple[np.ndarray, np.ndarray], settings: Propagate
) -> Labels:
    """The labels found, (N,) each with its confidence, and what they mean: kept seeds, propagated, or
    doubted seeds; what people have corrected is theirs.
    """
    corrected = given.state == CORRECTED
    label, confidence = np.where(corrected, given.label, found[0]), np.where(corrected, 1, found[1])
    kept = (seeds > 0) & (label == seeds)
    doubted = np.where(np.isin(given.state, (SEED, UNLOCKED)) & (label == 0), LOCKED, given.state)
    state = np.where(kept | corrected, given.state, np.where(label > 0, PROPAGATED, doubted))
    confidence = np.where(kept & (settings.method != "map"), given.confidence, confidence)
    confidence = np.where(label == 0, 0, confidence).astype(np.float32)
    return Labels(label.astype(np.uint8), confidence, state.astype(np.uint8), given.num_views)


@dataclass(frozen=True)
class PropagateSummary:
    """Of a finished cloud: points, those with a label, those that got it here, the sum of the labelled
    points' confidences, and those that people corrected. learned: what `--save-model` keeps, if it is asked for.
    objects: how many there are of each countable class.
    """

    num_points: int
    labelled: int
    propagated: int
    confidence: float
    corrected: int = 0
    learned: ModelPart | None = None
    objects: dict[str, int] = field(default_factory=dict)

    def figures(self) -> dict[str, object]:
        """What the stage reports."""
        return {
            "points": self.num_points,
            "labelled": f"{self.labelled / self.num_points:.1%}",
            "propagated": f"{self.propagated / self.num_points:.1%}",
            "mean_confidence": round(self.confidence / max(self.labelled, 1), 3),
            **({"corrected": self.corrected} if self.corrected else {}),
            **({"objects": _listed(self.objects)} if self.objects else {}),
        }


def _listed(objects: dict[str, int]) -> str:
    return ", ".join(f"{name} {count:,}" for name, count in objects.items())


def propagate_scene(
    scene: Scene, settings: Propagate, read_objects: ReadObjects | None = None
) -> PropagateSummary:
    """Complete the labels of a scene's seeds (or of `settings.seeds`) and write the labelled cloud.
    read_objects: as `SceneObjects.tell_apart` takes it
    """
    saved = read_saved_appearance(scene, settings)
    meters = meters_per_unit(scene) if settings.model or settings.save_model else None
    cloud, seeds, votes, path = _read_start(scene, settings)
    positions = cloud.point.positions.numpy().astype(np.float64)
    corrections = Corrections.of_scene(scene)
    seeds, counts = corrections.apply(seeds, positions)
    corrections.warn_of_missing(counts, path)
    if saved is None and not (seeds.label > 0).any():  # none of the classes alone is no start
        raise no_seeds(path, corrections)
    colors = cloud.point.colors.numpy() if "colors" in cloud.point else None
    channels = Channels.of_classes(np.unique(seeds.label).tolist()) if votes is None else votes.channels
    seeds = seeds_in_channels(seeds, channels, path)
    values = None if votes is None else votes.values
    points = LabelledPoints(
        positions,
        seeds,
        values,
        colors,
        scene_up(scene),
        channels.none,
        levels=levels_of(scene, channels),
    )
    normals = cloud.point.normals.numpy()
    graph, learn = neighbor_graph(points, normals, settings), learn_appearance
    if saved is not None and settings.model is not None:
        learn = partial(saved.on, channels=channels, meters=meters, origin=settings.model)
    found = propagate(points, normals, settings, graph, learn)
    labels = replace(found, label=channels.to_ids(found.label))
    sure = is_confirmed(cloud)
    objects = SceneObjects.tell_apart(scene, lambda: iter([(positions, labels.label, sure)]), read_objects)
    instance = None if objects is None else objects.find(positions, labels.label)
    output = settings.output or scene.labelled
    write_geometry(output, with_labels(cloud, normals, labels, instance=instance))
    learned = None
    if settings.save_model is not None:
        kept = SavedAppearance.learn(graph, points, found, channels, meters)
        learned = None if kept is None else kept.to_part()
    labelled, numbers = labels.label > 0, {} if objects is None else objects.figures()
    propagated = int((labelled & (labels.state == PROPAGATED)).sum())
    total = float(labels.confidence[labelled].sum(dtype=np.float64))
    corrected = int((labels.state == CORRECTED).sum())
    return PropagateSummary(
        len(labelled), int(labelled.sum()), propagated, total, corrected, learned, numbers
    )


def _read_start(
    scene: Scene, settings: Propagate
) -> tuple[o3d.t.geometry.PointCloud, Labels, Votes | None, Path]:
    """Cloud, labels (ids) and votes to start from, and their file: what `sc3d label` wrote or, with a model, the
    cloud of the scene, of which nothing is known.
    """
    path, bare = start_of(scene, settings)
    if not bare:
        cloud, seeds = read_labelled(path, "label")
        votes = read_votes(cloud)
        if settings.method == "map" and votes is None:
            raise InputError(
                f"{path} has no votes, which --method map needs: run `sc3d label` again, or choose --method geometry"
            )
        return cloud, seeds, votes, path
    scene.require(path, hint=MAKE_CLOUD)
    cloud = read_cloud(path)
    points, normals = point_arrays(cloud, np.array([view.center for view in scene.model.views]))
    channels, empty = scene.class_table().channels, np.zeros(len(points), np.uint8)
    cloud.point.normals = o3d.core.Tensor(normals)
    seeds = Labels(empty, empty.astype(np.float32), empty + np.uint8(UNSEEN), empty.astype(np.int32))
    return cloud, seeds, Votes(np.zeros((len(points), channels.count), np.float32), channels), path


def start_of(scene: Scene, settings: Propagate) -> tuple[Path, bool]:
    """The cloud to start from, and whether nothing is known of its points: that of the scene, which a model
    labels.
    """
    path = settings.seeds or scene.seeds
    bare = settings.model is not None and settings.seeds is None and not path.exists()
    return (scene.cloud if bare else path), bare


def read_saved_appearance(scene: Scene, settings: Propagate) -> SavedAppearance | None:
    """What `--model` holds, checked against the scene before anything else."""
    if settings.model is None:
        return None
    part = read_model(settings.model, scene.class_table(), "appearance")
    saved = SavedAppearance.from_part(part, settings.model)
    saved.require_unit(meters_per_unit(scene), settings.model)
    return saved


def levels_of(scene: Scene, channels: Channels) -> np.ndarray | None:
    """As of `LabelledPoints`; None without a class table."""
    return scene.class_table().levels(channels) if scene.classes.exists() else None


def meters_per_unit(scene: Scene) -> float | None:
    """Meters per unit of the world of a scene; None where nobody says."""
    found = read_georeference(scene)
    return None if found is None else found.meters


def seeds_in_channels(seeds: Labels, channels: Channels, origin: Path | str) -> Labels:
    """Labels of fusion, which are ids, as channels; seeds without a class are of none of them. origin: for
    errors.
    """
    label = channels.from_ids(seeds.label, origin)
    return replace(seeds, label=channels.with_none(label, np.isin(seeds.state, (SEED, UNLOCKED, CORRECTED))))


def no_seeds(path: object, corrections: Corrections) -> InputError:
    """What to say of a cloud without a single label, once corrected."""
    corrected = f", or take back what {corrections.origin} sets to none" if 0 in corrections.ids else ""
    return InputError(
        f"{path} has no labelled point to start from: check that masks and cloud belong together, or lower"
        f" --consensus in label{corrected}"
    )
