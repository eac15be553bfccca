"""Classes most of whose votes lie on the wrong level: found by what relief tells, and only then."""

from dataclasses import replace

import numpy as np
import pytest

from sc3d.propagation.misplaced import misplaced_shares
from sc3d.propagation.propagate import neighbor_graph, propagate
from sc3d.scene.channels import Channels
from sc3d.scene.class_table import ON_GROUND, STANDING, ClassTable, SemanticClass
from sc3d.scene.labels import CORRECTED
from sc3d.settings.labels import Propagate
from tests.propagation.test_appearance import LAWN, ROAD, ROOF, evidence_of, village

LEVELS = np.array([ON_GROUND, STANDING, ON_GROUND, STANDING])  # of LAWN, ROOF, ROAD, SHED
SHED = 4


@pytest.mark.parametrize("share", [0.4, 0.8])
def test_the_share_is_that_of_the_mixture(share):
    """Relief errs on 10 % of the ground and on 20 % of what stands."""
    sides = np.array([[0.9, 0.1], [0.2, 0.8], [0.9, 0.1], [0.2 + 0.7 * share, 0.8 - 0.7 * share]]) * 10_000
    found = misplaced_shares(sides.astype(int), LEVELS)
    np.testing.assert_allclose(found, [0, 0, 0, share], atol=1e-3)


@pytest.mark.parametrize(
    "sides",
    [
        [[900, 100], [200, 800], [900, 100], [320, 680]],  # little more than the other class that stands
        [[900, 100], [20, 80], [900, 100], [900, 100]],  # too few of the other class that stands
        [[600, 400], [400, 600], [600, 400], [600, 400]],  # relief cannot tell
    ],
)
def test_no_class_is_blamed_without_reason(sides):
    assert not misplaced_shares(np.array(sides) * (10 if sides[1][0] > 20 else 1), LEVELS).any()


def test_levels_follow_from_asprs_codes():
    def table(*codes: int) -> ClassTable:
        return ClassTable(
            tuple(SemanticClass(i + 1, str(i), (0, 0, i), asprs=c) for i, c in enumerate(codes))
        )

    channels = Channels.of_classes([1, 2, 3, 4], none=True)
    assert table(6, 5, 11, 3).levels(channels).tolist() == [STANDING, STANDING, ON_GROUND, ON_GROUND, -1]
    assert table(6, 3, 11, 1).levels(channels).tolist() == [STANDING, STANDING, ON_GROUND, -1, -1]  # 3: trees
    assert table(1, 1, 1, 1).levels(channels) is None and table(2, 9, 11, 10).levels(channels) is None


@pytest.mark.parametrize("method", ["map", "geometry"])
def test_sheds_on_the_road_are_taken_back(method):
    """Every view calls four fifths of the road a shed; some roofs are sheds."""
    points, normals, colors, truth = (part[::2] for part in village())
    truth = np.where((truth == ROOF) & (points[:, 0] < 40), SHED, truth).astype(np.uint8)
    wrong = (truth == ROAD) & (points[:, 1] % 10 < 8)
    evidence = evidence_of(points, colors, np.where(truth == SHED, ROOF, truth))
    label = np.where(wrong, SHED, truth).astype(np.uint8)
    votes = 1.5 * np.eye(5, dtype=np.float32)[label]
    person = np.flatnonzero(wrong)[:3]
    state = evidence.seeds.state.copy()
    state[person] = CORRECTED
    evidence = replace(evidence, votes=votes, seeds=replace(evidence.seeds, label=label, state=state))
    graph = neighbor_graph(evidence, normals, Propagate())
    before, after = (
        propagate(replace(evidence, levels=levels), normals, Propagate(method=method), graph).label
        for levels in (None, LEVELS)
    )
    rest = np.delete(np.flatnonzero(wrong), slice(0, 3))
    assert (before[rest] == SHED).mean() > 0.5 and (after[rest] == SHED).mean() < 0.05
    assert (after[person] == SHED).all()  # what a person has said stays
    for own in (LAWN, ROOF, SHED):
        assert (after[truth == own] == own).mean() > 0.97
