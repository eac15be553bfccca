"""The cut of the ground plane into blocks."""

import numpy as np
import pytest

from sc3d.errors import InputError
from sc3d.geometry.blocks import split_blocks


@pytest.mark.parametrize("count", [1, 2, 3, 7, 16])
def test_cores_fill_the_plane_and_hold_equal_shares(count):
    random = np.random.default_rng(count)
    points = random.normal(size=(4000, 3)) * (30, 10, 1)
    cut = split_blocks(points, count)
    assert len(cut) == count and cut[0].axes == (0, 1)
    anywhere = np.concatenate(
        [
            points,
            random.uniform(-1e4, 1e4, (4000, 3)),
            [[block.low[0], block.low[1], 0] for block in cut if np.isfinite(block.low).all()] or points[:1],
        ]
    )
    assert (np.sum([block.holds(anywhere) for block in cut], axis=0) == 1).all()
    held = np.array([block.holds(points).sum() for block in cut])
    assert np.abs(held / (len(points) / count) - 1).max() < 0.02
    assert split_blocks(points[:, [0, 2, 1]], count)[0].axes == (0, 2)  # worlds whose y points up
    for block in cut:
        around = block.holds(points, border=True)
        assert (around >= block.holds(points)).all() and (
            count == 1 or around.sum() > block.holds(points).sum()
        )


def test_too_many_blocks_are_refused():
    points = np.random.default_rng(0).normal(size=(50, 3))
    for bad in (points, np.repeat(points[:1], 5000, axis=0)):
        with pytest.raises(InputError, match="lower --blocks"):
            split_blocks(bad, 16)
