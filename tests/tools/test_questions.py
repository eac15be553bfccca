"""The simulated person, and that one answer at the right place is worth more than at random ones."""

import numpy as np

from sc3d.annotate.questions import Place
from sc3d.propagation.propagate import neighbor_graph
from sc3d.scene.channels import Channels
from sc3d.scene.labelled_cloud import spacing_of
from sc3d.settings.labels import Propagate
from tests.propagation.test_appearance import evidence_of, village
from tools.benchmark.questions import Site, measure, page


def site() -> Site:
    """A village without colors, in which single views call one roof a road, and nobody saw others well."""
    points, normals, colors, truth = (part[::8] for part in village(0))
    wrong = (truth == 2) & (points[:, 0] < 25) & (points[:, 1] < 25)
    known = evidence_of(points, colors, np.where(wrong, 3, truth).astype(np.uint8))
    known.votes[wrong, 2], known.votes[wrong, 3] = 0.4, 0.5
    known.votes[~wrong & (np.random.default_rng(0).random(len(points)) < 0.1), 1] += 1
    graph = neighbor_graph(known, normals, Propagate())
    return Site(truth, known, normals, Channels.of_classes([1, 2, 3]), graph, spacing_of(points))


def test_person_answers_what_is_clear_and_skips_the_rest():
    found = site()
    rows = [np.flatnonzero(found.truth == label)[:20] for label in (1, 2)]
    mixed = np.concatenate([rows[0], rows[1]])
    assert found.answer(Place(rows[1], 1, 2, 1.0)) == 2
    assert found.answer(Place(mixed, 1, 2, 1.0)) is None
    assert set(rows[0]) <= set(found.corrected(Place(rows[0], 1, 2, 1.0)))


def test_answers_lower_the_error_and_the_table_says_so():
    found = site()
    errors = measure(found, (0, 1, 3), seed=0)
    assert errors["suggest"][0] == errors["random places"][0] == found.error(found.labels([])) > 0
    assert errors["suggest"][-1] <= min(errors["random places"][-1], errors["suggest"][0])
    text = page((0, 1, 3), {"village": errors})
    assert text.count("\n") == 5 and "| village | suggest |" in text
