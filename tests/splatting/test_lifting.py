"""Labels lifted to Gaussians: against the renderer's gradients, a dense float64 twin, and cases that can be
counted by hand.
"""

import numba
import numpy as np
import pycolmap
import pytest
import torch

from sc3d.geometry.cameras import View, look_at, pinhole_view
from sc3d.splatting.gaussians import SH_C0, Gaussians
from sc3d.splatting.gpu.label_lifting import evidence_by_gradient
from sc3d.splatting.lifting import lift, winners
from sc3d.splatting.rendering import render
from tests.reference.splatting import render_reference
from tests.splatting.test_rendering import make_gaussians, make_view

pytestmark = pytest.mark.usefixtures("one_thread")

NUM_IDS = 8


def some_views(count=4):
    centers = np.random.default_rng(1).normal(size=(count, 3)) + [0.3, -0.5, -5.0]
    return [
        pinhole_view(
            f"view_{row}",
            (45 + 3 * row, 37),
            (40.0, 42.0, 27.3, 15.1),
            look_at(center, np.zeros(3), up=(0, -1, 0)),
        )
        for row, center in enumerate(centers)
    ]


def patches(view, seed=0, ids=NUM_IDS):
    """Mask of 7 px patches, a quarter of them unlabelled, and its confidence."""
    random = np.random.default_rng([seed, view.width])
    coarse = random.integers(0, ids, (8, 12)) * (random.random((8, 12)) > 0.25)
    mask = np.kron(coarse, np.ones((7, 7), int))[: view.height, : view.width].astype(np.uint8)
    return mask, random.integers(1, 256, mask.shape).astype(np.uint8)


def plates(depths, scale=300.0):
    """Opaque plates across the z axis that fill every view; all alphas are 0.99."""
    count = len(depths)
    means = torch.tensor([[0.0, 0.0, depth] for depth in depths])
    scales = torch.tensor([scale, scale, 1e-3]).log().repeat(count, 1)
    quats = torch.tensor([1.0, 0, 0, 0]).repeat(count, 1)
    return Gaussians(means, scales, quats, torch.full((count,), 30.0), torch.zeros(count, 3))


def test_equals_the_gradient_of_the_renderer():
    gaussians, views = make_gaussians(), some_views()
    found = lift(gaussians, views, patches, NUM_IDS)
    expected = sum(
        evidence_by_gradient(gaussians, view, mask, sure.astype(np.float32) / 255, NUM_IDS)
        for view in views
        for mask, sure in [patches(view)]
    )
    assert expected[:, 1:].sum() > 500 and not found[:, 0].any()
    assert np.linalg.norm(found - expected) < 1e-6 * np.linalg.norm(expected)
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5)


def test_equals_a_dense_float64_twin():
    gaussians, view = make_gaussians(60), make_view()
    mask, sure = patches(view)
    found = lift(gaussians, [view], lambda _: (mask, sure), NUM_IDS)
    parts = [tensor.double() for tensor in gaussians.painted(np.full((60, 3), 0.5)).parameters().values()]
    for label in range(1, NUM_IDS):
        colors = parts[4].clone().requires_grad_()
        image = render_reference(Gaussians(*parts[:4], colors), view)[0][..., 0]
        (image * torch.from_numpy((mask == label) * sure / 255.0)).sum().backward()
        np.testing.assert_allclose(found[:, label], colors.grad[:, 0].numpy() / SH_C0, rtol=1e-4, atol=1e-4)


def test_all_evidence_of_a_class_is_the_alpha_of_its_pixels():
    gaussians, view = make_gaussians(400, size=-1.0), make_view(70, 50)
    mask, sure = patches(view)
    alpha = render(gaussians, view, geometry=False).alpha.double().numpy()
    found = lift(gaussians, [view], lambda _: (mask, sure), NUM_IDS).sum(axis=0)
    expected = [(alpha * (mask == label) * sure / 255).sum() for label in range(NUM_IDS)]
    np.testing.assert_allclose(found[1:], expected[1:], rtol=1e-5)


def test_plates_share_pixels_as_light_passes_them():
    view = pinhole_view(
        "view",
        (40, 30),
        (50.0, 50.0, 20.0, 15.0),
        look_at(np.array([0.0, 0, -5]), np.zeros(3), up=(0, -1, 0)),
    )
    mask = np.zeros((30, 40), np.uint8)
    mask[:, :10], mask[:, 10:30] = 3, 1
    found = lift(plates([0.0, 1.0, 2.0, 3.0]), [view, view], lambda _: (mask, None), 5)
    pixels = 2 * np.array([0, 600, 0, 300, 0])
    np.testing.assert_allclose(found[0], 0.99 * pixels, rtol=1e-4)
    np.testing.assert_allclose(found[1], 0.0099 * pixels, rtol=1e-3)
    assert not found[3].any()  # behind three plates nothing arrives
    label, confidence = winners(found)
    assert label.tolist()[:2] == [1, 1] and label[3] == 0 and confidence[3] == 0
    np.testing.assert_allclose(confidence[:2], 2 / 3, rtol=1e-4)


def test_the_same_bits_for_any_order_of_views_gaussians_and_threads():
    gaussians, views = make_gaussians(500), some_views(5)
    found = lift(gaussians, views, patches, NUM_IDS)
    np.testing.assert_array_equal(lift(gaussians, views[::-1], patches, NUM_IDS), found)
    order = np.random.default_rng(3).permutation(500)
    np.testing.assert_array_equal(
        lift(gaussians[torch.from_numpy(order)], views, patches, NUM_IDS), found[order]
    )
    numba.set_num_threads(min(2, numba.config.NUMBA_NUM_THREADS))
    np.testing.assert_array_equal(lift(gaussians, views, patches, NUM_IDS), found)
    numba.set_num_threads(1)


def test_many_classes_and_the_largest_id():
    gaussians, view = make_gaussians(), make_view(120, 90)
    mask = (np.arange(120 * 90).reshape(90, 120) % 256).astype(np.uint8)
    weights = np.ones(mask.shape, np.float32)
    found = lift(gaussians, [view], lambda _: (mask, None), 256)
    np.testing.assert_allclose(
        found, evidence_by_gradient(gaussians, view, mask, weights, 256), rtol=1e-5, atol=1e-5
    )
    assert found[:, 255].sum() > 1


def test_without_labels_or_gaussians():
    gaussians, view = make_gaussians(20), make_view()
    nothing = np.zeros((view.height, view.width), np.uint8)
    assert not lift(gaussians, [view], lambda _: (nothing, None), 4).any()
    assert lift(
        gaussians[torch.zeros(20, dtype=torch.bool)], [view], lambda _: (nothing + 1, None), 4
    ).shape == (0, 4)
    label, confidence = winners(np.zeros((3, 4)))
    assert (
        label.dtype == np.uint8
        and confidence.dtype == np.float32
        and not label.any()
        and not confidence.any()
    )


def test_winner_is_the_largest_share_and_the_first_of_equals():
    label, confidence = winners(np.array([[0, 1, 3.0, 0], [0, 2, 2, 0], [0, 0, 0, 5]]))
    assert label.tolist() == [2, 1, 3]
    np.testing.assert_allclose(confidence, [0.75, 0.5, 1])


def test_distortion_and_sizes_are_refused():
    gaussians, view = make_gaussians(5), make_view()
    with pytest.raises(ValueError, match="size"):
        lift(gaussians, [view], lambda _: (np.ones((5, 5), np.uint8), None), 3)
    camera = pycolmap.Camera(model="SIMPLE_RADIAL", width=45, height=37, params=[40, 22, 18, 0.1])
    with pytest.raises(ValueError, match="pinhole"):
        lift(
            gaussians,
            [View("bent", camera, view.cam_from_world)],
            lambda _: (np.ones((37, 45), np.uint8), None),
            3,
        )
