"""OA, IoU, mIoU against a hand-made matrix and scikit-learn; the depth edge band."""

import numpy as np
import pytest

from sc3d.metrics import Confusion, EvaluationPixels, depth_edge_band, total
from sc3d.scene.class_table import OTHER, parse_classes

TABLE = parse_classes(
    [{"id": n, "name": name, "color": [n, 0, 0]} for n, name in ((1, "road"), (2, "tree"), (3, "car"))], "x"
)


def test_hand_made_matrix():
    truth = np.uint8([1, 1, 1, 1, 2, 2, 3, 3, 0, 0])
    predicted = np.uint8([1, 1, 2, 0, 2, 1, 3, 3, 1, 0])  # the last two pixels are not judged
    confusion = Confusion.from_labels(truth, predicted, 5)
    expected = np.zeros((5, 5), int)
    expected[1, 1], expected[1, 2], expected[1, 0], expected[2, 2], expected[2, 1], expected[3, 3] = (
        2,
        1,
        1,
        1,
        1,
        2,
    )
    np.testing.assert_array_equal(confusion.counts, expected)
    assert confusion.accuracy == pytest.approx(5 / 8)
    assert (
        confusion.iou[1] == pytest.approx(2 / 5)
        and confusion.iou[2] == pytest.approx(1 / 3)
        and confusion.iou[3] == 1
    )
    assert np.isnan(confusion.iou[4])
    assert confusion.mean_iou == pytest.approx((2 / 5 + 1 / 3 + 1) / 3)
    assert confusion.coverage == pytest.approx(7 / 8)


def test_against_scikit_learn():
    metrics = pytest.importorskip("sklearn.metrics")
    rng = np.random.default_rng(0)
    truth = rng.integers(1, 5, (50, 60)).astype(np.uint8)
    predicted = np.where(rng.uniform(size=truth.shape) < 0.7, truth, rng.integers(1, 5, truth.shape)).astype(
        np.uint8
    )
    parts = [Confusion.from_labels(truth[rows], predicted[rows], 5) for rows in (slice(0, 20), slice(20, 50))]
    confusion = total(parts, 5)
    flat = truth.ravel(), predicted.ravel()
    np.testing.assert_array_equal(confusion.counts[1:, 1:], metrics.confusion_matrix(*flat))
    assert confusion.accuracy == pytest.approx(metrics.accuracy_score(*flat))
    np.testing.assert_allclose(confusion.iou[1:], metrics.jaccard_score(*flat, average=None))
    assert confusion.mean_iou == pytest.approx(metrics.jaccard_score(*flat, average="macro"))


def test_perfect_prediction_is_exactly_one_and_no_truth_is_nan():
    truth = np.random.default_rng(0).integers(0, 4, (30, 30)).astype(np.uint8)
    perfect = Confusion.from_labels(truth, truth, 4)
    assert perfect.accuracy == perfect.mean_iou == perfect.coverage == 1.0
    assert np.isnan(Confusion.from_labels(np.zeros((3, 3), np.uint8), truth[:3, :3], 4).accuracy)


def test_band_follows_a_depth_step():
    depth = np.full((40, 60), 50.0)
    depth[:, 30:] = 40.0
    depth += np.linspace(0, 0.5, 60)  # a slope is no edge
    band = depth_edge_band(depth, 5)
    assert band[:, 26:34].all() and not band[:, :23].any() and not band[:, 37:].any()
    assert not depth_edge_band(np.full((9, 9), 3.0), 5).any()


def test_judged_pixels_equal_the_confusion_of_images():
    rng = np.random.default_rng(0)
    label = rng.integers(0, 4, 50).astype(np.uint8)
    photos = []
    for shape in ((12, 9), (7, 11)):
        photos.append(
            (
                rng.integers(0, 4, shape).astype(np.uint8),
                rng.integers(-1, 50, shape).astype(np.int32),
                rng.uniform(size=shape) < 0.3,
            )
        )
    pixels = EvaluationPixels.concatenate([EvaluationPixels.from_photo(*photo) for photo in photos])
    near, elsewhere = pixels.confusions(pixels.look_up(label), 4)
    images = [
        (truth, np.where(rows >= 0, label[rows], 0).astype(np.uint8), band) for truth, rows, band in photos
    ]
    for confusion, inside in ((near, True), (elsewhere, False)):
        expected = total(
            (
                Confusion.from_labels(np.where(band == inside, truth, 0), predicted, 4)
                for truth, predicted, band in images
            ),
            4,
        )
        np.testing.assert_array_equal(confusion.counts, expected.counts)
    values = pixels.look_up(np.linspace(0.5, 1, 50, dtype=np.float32))
    assert (
        (values[pixels.rows < 0] == 0).all()
        and (values[pixels.rows >= 0] >= 0.5).all()
        and values.dtype == np.float32
    )
    believed = pixels.reliability(label, np.full(50, 0.75, np.float32), 4)
    right, labelled = int(np.trace((near + elsewhere).counts)), int((near + elsewhere).counts[:, 1:].sum())
    assert believed.count[7] == labelled and believed.accuracy[7] == pytest.approx(right / labelled)


def test_other_counts_in_precision_and_leaves_the_closed_figures():
    truth = np.uint8([1, 1, 1, 1, 2, 2, OTHER, OTHER, OTHER, OTHER, 0, 0])
    predicted = np.uint8([1, 1, 2, 0, 2, 1, 1, 1, 2, 0, 1, 0])
    confusion = Confusion.from_labels(truth, predicted, 4)
    closed = Confusion.from_labels(np.where(truth == OTHER, 0, truth), predicted, 4)
    found, before = confusion.summary(TABLE), closed.summary(TABLE)
    assert {key: found[key] for key in before if key not in ("precision", "other")} == {
        key: before[key] for key in before if key not in ("precision", "other")
    }
    assert found["pixels"] == 6 and found["oa"] == pytest.approx(3 / 6)
    assert found["precision"] == pytest.approx({"road": 2 / 5, "tree": 1 / 3})
    assert before["precision"] == pytest.approx({"road": 2 / 3, "tree": 1 / 2})
    assert found["recall"] == pytest.approx({"road": 2 / 4, "tree": 1 / 2})
    assert found["other"] == {
        "pixels": 4,
        "given_class": pytest.approx(3 / 4),
        "given": pytest.approx({"road": 2 / 4, "tree": 1 / 4}),
    }
    assert before["other"] == {"pixels": 0, "given_class": None, "given": {}}


def test_open_set_against_scikit_learn():
    metrics = pytest.importorskip("sklearn.metrics")
    rng = np.random.default_rng(0)
    truth, predicted = (rng.integers(0, 4, 5000).astype(np.uint8) for _ in range(2))
    confusion = Confusion.from_labels(np.where(truth == 0, OTHER, truth).astype(np.uint8), predicted, 4)
    for found, score in ((confusion.precision, "precision_score"), (confusion.recall, "recall_score")):
        expected = getattr(metrics, score)(truth, predicted, average=None, labels=[1, 2, 3])
        np.testing.assert_allclose(found[1:], expected)


def test_other_alone_has_no_closed_figures():
    confusion = Confusion.from_labels(np.full(4, OTHER, np.uint8), np.uint8([0, 0, 0, 3]), 4)
    assert np.isnan([confusion.accuracy, confusion.mean_iou, confusion.coverage]).all()
    assert confusion.other(TABLE) == {"pixels": 4, "given_class": 0.25, "given": {"car": 0.25}}
    assert confusion.summary(TABLE)["precision"] == {"car": 0.0} and len(confusion.present) == 0


def test_a_class_may_have_the_id_of_other():
    truth = np.uint8([OTHER, OTHER, 1])
    confusion = Confusion.from_labels(truth, np.uint8([OTHER, 1, 1]), OTHER + 1)
    assert confusion.counts[OTHER, OTHER] == confusion.counts[OTHER, 1] == 1 and not confusion.counts[0].any()


def test_reliability_with_and_without_other():
    truth, rows = np.uint8([[1, 1, OTHER, OTHER]]), np.int32([[0, 1, 0, -1]])
    pixels = EvaluationPixels.from_photo(truth, rows, np.zeros((1, 4), bool))
    label, confidence = np.uint8([1, 2]), np.float32([0.75, 0.75])
    closed = pixels.reliability(label, confidence, 4)
    everywhere = pixels.reliability(label, confidence, 4, other=True)
    assert closed.count.sum() == 2 and closed.ece == pytest.approx(0.25)
    assert everywhere.count.sum() == 3 and everywhere.ece == pytest.approx(0.75 - 1 / 3)
