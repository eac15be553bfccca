"""Masks that follow the edges of their photo."""

import numpy as np
import pytest

from sc3d.exporters.mask_edges import follow_edges
from sc3d.exporters.masks import cleaned

HEIGHT, WIDTH = 240, 320


def ragged(seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A photo of a disk on a lawn, its true mask, and one with a border that strays by some pixels."""
    rng = np.random.default_rng(seed)
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    distance = np.hypot(rows - 120, columns - 160)
    truth = np.where(distance < 70, 7, 2)
    given = np.where(distance + rng.normal(0, 2.5, truth.shape) < 70, 7, 2)
    photo = np.where((truth == 7)[..., None], [120, 90, 80], [100, 120, 70])
    photo = np.clip(photo + rng.normal(0, 4, photo.shape), 0, 255).astype(np.uint8)
    return photo, truth, given


def test_ragged_borders_follow_the_edges_of_the_photo():
    photo, truth, given = ragged()
    found, clear = follow_edges(given, photo)
    assert (given != truth).mean() > 0.01 and (found != truth).mean() < 0.001
    assert (
        found.dtype == given.dtype
        and clear.dtype == np.float32
        and (clear[found == truth] > 0.5).mean() > 0.99
    )


@pytest.mark.parametrize("scale", [1, 5])
def test_large_photos_are_cleaned_as_well_by_a_smaller_picture(scale):
    photo, truth, given = (part.repeat(scale, axis=0).repeat(scale, axis=1) for part in ragged())
    assert (follow_edges(given, photo)[0] != truth).mean() < 0.002


def test_without_edges_in_the_photo_a_straight_border_stays():
    given = np.where(np.arange(WIDTH) < 100, 1, 4) * np.ones((HEIGHT, 1), int)
    found, _ = follow_edges(given, np.full((HEIGHT, WIDTH, 3), 90, np.uint8))
    np.testing.assert_array_equal(found, given)


def test_an_edge_of_the_photo_far_from_a_border_changes_nothing():
    given = np.where(np.arange(WIDTH) < 100, 1, 4) * np.ones((HEIGHT, 1), int)
    photo = np.where(np.arange(WIDTH) < 220, 60, 200)[None, :, None] * np.ones((HEIGHT, 1, 3))
    np.testing.assert_array_equal(follow_edges(given, photo.astype(np.uint8))[0], given)


def test_what_nobody_knows_and_what_is_of_no_class_stay_apart():
    photo, truth, given = ragged()
    mask, confidence = np.where(given == 7, 0, 3).astype(np.uint8), np.full(given.shape, 200, np.uint8)
    confidence[:, :60], mask[:, :60] = 0, 0  # nothing is known on the left
    found, sure = cleaned(mask, confidence, photo)
    assert set(np.unique(found)) == {0, 3} and not sure[:, :55].any() and (sure[:, 65:] > 0).all()
    assert (found[:, 65:] == np.where(truth == 7, 0, 3)[:, 65:]).mean() > 0.999
    same = (found == mask) & (sure > 0) & (confidence > 0)
    assert (sure[same] == 200).all()
