"""Reliability by hand, and for answers whose odds are known."""

import numpy as np
import pytest

from sc3d.metrics import Reliability, reliability


def test_by_hand():
    found = reliability(np.array([0.05, 0.15, 0.15, 1.0]), np.array([False, True, False, True]))
    np.testing.assert_array_equal(found.count, [1, 2, 0, 0, 0, 0, 0, 0, 0, 1])
    np.testing.assert_allclose(found.accuracy[[0, 1, 9]], [0, 0.5, 1])
    np.testing.assert_allclose(found.confidence[[0, 1, 9]], [0.05, 0.15, 1])
    assert np.isnan(found.accuracy[2:9]).all()
    assert found.ece == pytest.approx((0.05 + 2 * 0.35 + 0) / 4)
    assert found.summary()["bins"][2] is None and found.summary()["bins"][1] == [pytest.approx(0.15), 0.5, 2]


def test_right_as_often_as_said_is_calibrated_and_boasting_is_not():
    rng = np.random.default_rng(0)
    confidence = rng.uniform(0.2, 1, 100_000)
    right = rng.uniform(size=len(confidence)) < confidence
    order = rng.permutation(len(confidence))
    assert reliability(confidence, right).ece < 0.01
    assert reliability(np.sqrt(confidence), right).ece > 0.1
    parts = [reliability(confidence[rows], right[rows]) for rows in np.array_split(np.arange(len(right)), 3)]
    np.testing.assert_allclose(
        Reliability.merge(parts).accuracy, reliability(confidence, right).accuracy, rtol=1e-12
    )
    assert Reliability.merge(parts).ece == pytest.approx(reliability(confidence, right).ece, abs=1e-12)
    assert reliability(confidence[order], right[order]).ece == pytest.approx(
        reliability(confidence, right).ece, abs=1e-12
    )


def test_nothing_to_judge_and_impossible_confidences():
    assert np.isnan(reliability(np.empty(0), np.empty(0, bool)).ece)
    with pytest.raises(ValueError):
        reliability(np.array([1.2]), np.array([True]))
