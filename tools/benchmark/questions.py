"""What answers are worth: the error that is left after so many of them, asked by `sc3d annotate --suggest`,
at random places, and at the least sure ones. A person is simulated who knows the truth of each point, and
skips a place that is several things at once.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from sc3d.annotate.questions import Evidence, Place, rank_places
from sc3d.errors import InputError
from sc3d.geometry.graph import Graph
from sc3d.georeferencing.up_direction import scene_up
from sc3d.io.clouds import read_cloud
from sc3d.io.provenance import versions
from sc3d.propagation.labelled_points import LabelledPoints
from sc3d.propagation.propagate import levels_of, neighbor_graph, propagate, seeds_in_channels
from sc3d.scene.channels import Channels
from sc3d.scene.labelled_cloud import read_labelled, read_votes, spacing_of
from sc3d.scene.labels import CORRECTED, Labels
from sc3d.scene.mask_values import OTHER
from sc3d.scene.scene import Scene
from sc3d.scene.selection import balls_within
from sc3d.settings.labels import Propagate
from tools.benchmark.publish import check_output, publish
from tools.benchmark.settings import BenchmarkQuestions

CLEAR = 0.8  # share of a place that is one thing, from which the person answers

Order = Callable[[list[Place], np.ndarray, np.random.Generator], list[Place]]
ORDERS: dict[str, Order] = {
    "suggest": lambda places, confidence, rng: places,
    "random places": lambda places, confidence, rng: [places[row] for row in rng.permutation(len(places))],
    "least confident": lambda places, confidence, rng: sorted(
        places, key=lambda place: float(confidence[place.rows].mean())
    ),
}


@dataclass(frozen=True)
class Site:
    """A synthetic scene whose cloud is that of its truth. truth: (N,) ids, 0 and `OTHER` are not judged"""

    truth: np.ndarray
    points: LabelledPoints
    normals: np.ndarray
    channels: Channels
    graph: Graph
    spacing: float

    @classmethod
    def load(cls, scene: Scene) -> Site:
        exact = read_cloud(scene.path / "truth.ply")
        cloud, seeds = read_labelled(scene.seeds, "label")
        votes, positions = read_votes(cloud), cloud.point.positions.numpy().astype(np.float64)
        if votes is None or not np.array_equal(exact.point.positions.numpy(), positions):
            raise InputError(f"{scene.path}: copy truth.ply to cloud.ply and run `sc3d label` first")
        seeds = seeds_in_channels(seeds, votes.channels, scene.seeds)
        colors, none = cloud.point.colors.numpy(), votes.channels.none
        levels = levels_of(scene, votes.channels)
        points = LabelledPoints(positions, seeds, votes.values, colors, scene_up(scene), none, levels=levels)
        normals, truth = cloud.point.normals.numpy(), exact.point["label"].numpy().ravel()
        graph = neighbor_graph(points, normals, Propagate())
        return cls(truth, points, normals, votes.channels, graph, spacing_of(positions))

    def labels(self, answers: list[tuple[np.ndarray, int]]) -> Labels:
        """Labels, ids, as `sc3d propagate` makes them of corrections: rows and their id."""
        given, label = self.points.seeds, self.points.seeds.label.copy()
        touched = np.zeros(len(label), bool)
        for rows, answer in answers:
            label[rows], touched[rows] = self.channels.from_ids(np.uint8([answer]))[0], True
        confidence = np.where(touched, label > 0, given.confidence).astype(np.float32)
        state = np.where(touched, CORRECTED, given.state).astype(np.uint8)
        corrected = replace(self.points, seeds=Labels(label, confidence, state, given.num_views))
        found = propagate(corrected, self.normals, Propagate(), self.graph)
        return replace(found, label=self.channels.to_ids(found.label))

    def error(self, labels: Labels) -> float:
        """Share of the points of a class that have another label."""
        judged = (self.truth > 0) & (self.truth < OTHER)
        return float((labels.label != self.truth)[judged].mean())

    def places(self, labels: Labels) -> list[Place]:
        ids = self.channels.ids[1:]
        values = self.points.known_votes[:, 1 : len(ids) + 1]
        known, colors = self.points.points, self.points.colors
        return rank_places(
            Evidence(known, labels.label, labels.confidence, labels.state, values, ids, colors, self.spacing)
        )

    def answer(self, place: Place) -> int | None:
        """What the person says: an id, 0 = none of the classes, None = skip."""
        counts = np.bincount(np.where(self.truth[place.rows] >= OTHER, 0, self.truth[place.rows]))
        return int(counts.argmax()) if counts.max() >= CLEAR * len(place.rows) else None

    def corrected(self, place: Place) -> np.ndarray:
        """(R,) rows of the points that the correction holds, as it is written down."""
        balls = balls_within(self.points.points, place.rows, self.spacing)
        return np.flatnonzero(balls.contain(self.points.points))


def measure(site: Site, numbers: tuple[int, ...], seed: int) -> dict[str, list[float]]:
    """The error that is left after each number of answers, by order of asking; `skipped` before the last."""
    before = site.labels([])
    places, result = site.places(before), dict[str, list[float]]()
    for name, order in ORDERS.items():
        queue = order(places, before.confidence, np.random.default_rng(seed))
        answers, errors, skipped = list[tuple[np.ndarray, int]](), [], 0
        for place in queue:
            if len(answers) == max(numbers):
                break
            said = site.answer(place)
            skipped += said is None
            if said is not None:
                answers.append((site.corrected(place), said))
        for number in numbers:
            errors.append(site.error(site.labels(answers[:number])))
        result[name] = errors
        result[f"{name}, skipped"] = [float(skipped)]
    return result


def run_questions(command: BenchmarkQuestions) -> None:
    """Measure every scene, show the table, write it if wanted."""
    check_output(command.output)
    figures = {}
    for path in command.scenes:
        scene = Scene(path)
        scene.require(scene.seeds, scene.path / "truth.ply", hint="see --help")
        figures[path.name] = measure(Site.load(scene), command.answers, command.seed)
    record = {
        "benchmark": "questions",
        "answers": list(command.answers),
        "versions": versions(),
        "figures": figures,
    }
    publish(record, page(command.answers, figures), command.output)


def page(numbers: tuple[int, ...], figures: dict[str, dict[str, list[float]]]) -> str:
    """A Markdown table: points with a wrong label, per cent, and by how much of them the error falls."""
    lines = [
        f"| site | asked | {' | '.join(f'{number} answers' for number in numbers)} | falls by | skipped |",
        f"|{'---|' * (len(numbers) + 4)}",
    ]
    for site, rows in figures.items():
        for name in ORDERS:
            errors, skipped = rows[name], rows[f"{name}, skipped"][0]
            falls = 1 - errors[-1] / errors[0] if errors[0] else 0.0
            cells = " | ".join(f"{100 * error:.2f} %" for error in errors)
            lines.append(f"| {site} | {name} | {cells} | {falls:.0%} | {skipped:.0f} |")
    return "\n".join(lines) + "\n"
