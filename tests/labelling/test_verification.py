"""Two-way verification: views that contradict the fused labels nearby lose their say."""

import numpy as np

from sc3d.geometry.voxels import BLOCK, LabelGrid, sort_by_voxel
from sc3d.labelling.verification import MIN_RELIABILITY, PRIOR_SHARE, PRIOR_VIEWS, VoteLog, verify

FULL = 4096


def log_of(*views: tuple) -> VoteLog:
    log = VoteLog()
    for labels, weights in views:
        log.append(np.asarray(labels, np.uint8), np.asarray(weights, np.uint16))
    return log


def cells_in_blocks(*counts: int, at: tuple[int, ...] = (0,)) -> tuple[LabelGrid, np.ndarray]:
    """A grid with so many cells in each of the blocks at `at` along x, one voxel each, and their rows."""
    inside = np.stack(np.unravel_index(np.arange(BLOCK**3), (BLOCK,) * 3), axis=1) + 0.5
    points = np.concatenate([inside[:count] + [BLOCK * x, 0, 0] for count, x in zip(counts, at, strict=True)])
    grid = LabelGrid.from_voxels(sort_by_voxel(points, 1.0, np.zeros(3)), 4)
    return grid, grid.find(points)


def verified(
    log: VoteLog, winner: np.ndarray, grid: LabelGrid, rows: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Which cells pass, and their votes, which are weighed anew."""
    passed = verify(log, winner, grid, rows, FULL, reweigh=True)
    return passed, grid.votes[rows]


def test_the_log_gives_back_what_was_written_as_often_as_asked():
    log = log_of(([0, 3, 0, 1], [9, 8, 7, 6]), ([0, 0, 0, 0], [1, 1, 1, 1]), ([2, 0, 0, 0], [4096, 0, 0, 0]))
    for _ in range(2):
        first, empty, last = log
        np.testing.assert_array_equal(first[0], [1, 3])
        np.testing.assert_array_equal(first[1], [3, 1])
        np.testing.assert_array_equal(first[2], [8, 6])
        assert len(empty[0]) == 0 and last[2][0] == 4096


def test_votes_are_weighed_by_the_square_of_the_share_that_agrees():
    winner = np.full(100, 1, np.uint8)
    labels = np.where(np.arange(100) < 25, 1, 2)  # agrees at a quarter of the cells
    grid, rows = cells_in_blocks(100)
    grid.votes[rows, 0] = 7
    passed, votes = verified(log_of((labels, np.full(100, FULL))), winner, grid, rows)
    reliability = (25 + PRIOR_VIEWS * PRIOR_SHARE) / (100 + PRIOR_VIEWS)
    assert reliability > MIN_RELIABILITY
    np.testing.assert_array_equal(votes[np.arange(100), labels], round(FULL * reliability**2))
    assert (votes[:, 0] == 7).all()  # the number of views stays
    # where the label rests on this view alone, it is doubted
    np.testing.assert_array_equal(passed, labels == 2)


def test_a_view_that_errs_all_around_a_place_is_overruled_there_by_one_that_does_not():
    """Where only two views look they contradict each other; elsewhere in the block the other views show which
    of them errs.
    """
    count = 200
    good, bad = np.full(count, 1), np.full(count, 2)
    others = np.where(np.arange(count) < 150, 1, 0)
    winner = np.where(np.arange(count) < 150, 1, 2).astype(np.uint8)  # a tie at first: the wrong one won
    weights, cells = np.full(count, FULL), cells_in_blocks(count)
    log = log_of((bad, weights), (good, weights), (others, weights), (others, weights))
    votes = verified(log, winner, *cells)[1]
    assert (votes[150:, 1] > 5 * votes[150:, 2]).all()


def test_reliability_is_a_matter_of_place():
    """A view that errs in one block keeps its say in a block far away, and less of it next door."""
    grid, rows = cells_in_blocks(50, 50, 50, at=(0, 1, 5))
    slots = grid.slots(np.int32([[0, 0, 0], [1, 0, 0], [5, 0, 0]]))
    neighbors = grid.neighbors()[slots]
    np.testing.assert_array_equal(neighbors[:, 13], slots)
    assert set(neighbors[0]) == {-1, slots[0], slots[1]} and set(neighbors[2]) == {-1, slots[2]}
    labels = np.r_[np.full(50, 2), np.full(100, 1)]
    votes = verified(log_of((labels, np.full(150, FULL))), np.full(150, 1, np.uint8), grid, rows)[1]
    here, next_door, far = votes[0, 2], votes[50, 1], votes[100, 1]
    assert here < 0.3 * FULL and 0.3 * FULL < next_door < 0.6 * FULL and far > 0.95 * FULL


def test_the_order_of_views_does_not_matter():
    rng = np.random.default_rng(0)
    views = [(rng.integers(0, 4, 300), rng.integers(1, FULL, 300)) for _ in range(5)]
    winner, results = rng.integers(0, 4, 300).astype(np.uint8), []
    for order in (views, views[::-1]):
        results.append(verified(log_of(*order), winner, *cells_in_blocks(300)))
    np.testing.assert_array_equal(results[0][0], results[1][0])
    np.testing.assert_array_equal(results[0][1], results[1][1])


def test_without_reweighing_the_votes_stay_and_the_same_cells_pass():
    rng = np.random.default_rng(0)
    views = [(rng.integers(0, 4, 300), rng.integers(1, FULL, 300)) for _ in range(5)]
    winner, (grid, rows) = rng.integers(0, 4, 300).astype(np.uint8), cells_in_blocks(300)
    grid.votes[rows] = 5
    passed = verify(log_of(*views), winner, grid, rows, FULL, reweigh=False)
    assert (grid.votes[rows] == 5).all()
    np.testing.assert_array_equal(passed, verified(log_of(*views), winner, grid, rows)[0])
