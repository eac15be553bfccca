"""The renderer against its dense float64 twin, and the properties its users rely on."""

from dataclasses import replace

import numba
import numpy as np
import pycolmap
import pytest
import torch

from sc3d.geometry.cameras import look_at, pinhole_view
from sc3d.splatting.gaussians import Gaussians
from sc3d.splatting.rendering import render, unbiased_depth
from tests.reference.splatting import render_reference, rotation_matrices

NAMES = ("means", "log_scales", "quats", "opacity_logits", "sh_dc", "sh_rest")
BACKGROUND = torch.tensor([0.2, 0.5, 0.7])


def make_gaussians(count=150, coefficients=16, seed=0, size=-1.8):
    generator = torch.Generator().manual_seed(seed)
    spread = torch.tensor([2.0, 1.5, 1.0])
    means = torch.randn(count, 3, generator=generator) * spread
    log_scales = torch.randn(count, 3, generator=generator) * 0.6 + size
    quats, logits = torch.randn(count, 4, generator=generator), torch.randn(count, generator=generator) * 2
    sh = torch.randn(count, coefficients, 3, generator=generator) * 0.3
    return Gaussians(means, log_scales, quats, logits, sh[:, 0].clone(), sh[:, 1:].clone())


def make_view(width=45, height=37, calibration=(40.0, 42.0, 27.3, 15.1)):
    return pinhole_view(
        "view", (width, height), calibration, look_at(np.array([0.5, -1.0, -5.0]), np.zeros(3), up=(0, -1, 0))
    )


def with_gradients(gaussians, dtype=torch.float32):
    return Gaussians(*(getattr(gaussians, name).to(dtype, copy=True).requires_grad_() for name in NAMES))


def images(rendering):
    return rendering.color, rendering.alpha, rendering.normal, rendering.plane_distance


def weighted_sum(outputs, seed=5):
    generator = torch.Generator().manual_seed(seed)
    return sum((output * torch.randn(output.shape, generator=generator)).sum() for output in outputs)


def assert_equals_reference(
    gaussians, view, sh_degree=None, background=None, outputs=slice(None), tolerance=1e-5
):
    fast, slow = with_gradients(gaussians), with_gradients(gaussians, torch.float64)
    found = images(render(fast, view, sh_degree, background))[outputs]
    expected = render_reference(slow, view, sh_degree, background)[outputs]
    for image, truth in zip(found, expected, strict=True):
        assert (image - truth).abs().mean() < 0.1 * tolerance * max(1.0, float(truth.detach().abs().max()))
        assert (image - truth).abs().max() < 1e-4
    weighted_sum(found).backward()
    weighted_sum(expected).backward()
    for name in NAMES:
        gradient, truth = getattr(fast, name).grad, getattr(slow, name).grad
        if truth is None:
            truth = torch.zeros_like(gradient)
        assert (gradient - truth).norm() <= tolerance * truth.norm(), name
    return expected


@pytest.mark.parametrize("sh_degree", [0, 1, 2, 3, None])
def test_images_and_gradients_equal_the_dense_twin(sh_degree):
    expected = assert_equals_reference(make_gaussians(seed=1), make_view(), sh_degree, BACKGROUND)
    assert 0.3 < expected[1].mean() < 0.9  # the scene is neither empty nor saturated


@pytest.mark.parametrize(
    "outputs",
    [slice(0, 1), slice(1, 2), slice(2, 3), slice(3, 4)],
    ids=["color", "alpha", "normal", "plane_distance"],
)
def test_gradients_of_each_output_alone(outputs):
    assert_equals_reference(make_gaussians(60, 4, seed=2), make_view(), outputs=outputs)


@pytest.mark.parametrize(
    "calibration",
    [(40.0, 42.0, -20.0, 60.0), (300.0, 200.0, 22.5, 18.5)],
    ids=["principal point outside", "telephoto"],
)
def test_unusual_calibrations(calibration):
    assert_equals_reference(
        make_gaussians(200, 1, seed=3), make_view(calibration=calibration), background=BACKGROUND
    )


def test_camera_inside_the_scene_clamps_the_jacobian():
    view = pinhole_view("inside", (40, 40), (30.0, 30.0, 12.0, 25.0), np.eye(4))
    gaussians = make_gaussians(300, 4, seed=4, size=-2.5)
    slopes = gaussians.means[:, :2] / gaussians.means[:, 2:]
    # beyond the limits of the Jacobian
    assert ((gaussians.means[:, 2] > 0.01) & (slopes.abs() > 2.5).any(1)).sum() > 20
    assert_equals_reference(gaussians, view)


def test_opaque_layers_stop_and_clamp_like_the_twin():
    gaussians = make_gaussians(120, 1, seed=6, size=-0.5)
    gaussians.opacity_logits += 6.0  # most of them above the limit of 0.99
    # float32 opacities near 1 are that coarse
    expected = assert_equals_reference(gaussians, make_view(), tolerance=1e-4)
    assert (expected[1] > 1 - 1e-4).double().mean() > 0.2


@pytest.mark.parametrize("size", [(1, 1), (16, 16), (17, 5), (3, 70)])
def test_any_image_size(size):
    calibration = (size[0] * 0.9, size[0] * 0.9, size[0] * 0.5, size[1] * 0.5)
    assert_equals_reference(make_gaussians(80, 1, seed=7, size=-1.0), make_view(*size, calibration))


def test_thin_long_splats_keep_their_shape():
    gaussians = make_gaussians(60, 1, seed=8)
    gaussians.log_scales[:, 0], gaussians.log_scales[:, 1:] = 2.0, -7.0
    assert_equals_reference(gaussians, make_view(160, 120, (150.0, 150.0, 80.0, 60.0)), tolerance=1e-4)


def test_tilted_wall_has_exact_depth():
    angle = np.radians(50.0)
    normal_cam = np.array([np.sin(angle), 0.2, -np.cos(angle)])
    normal_cam /= np.linalg.norm(normal_cam)
    view = pinhole_view(
        "wall",
        (60, 44),
        (55.0, 57.0, 21.0, 30.0),
        look_at(np.array([3.0, 1.0, 2.0]), np.array([0.0, 4.0, 1.0])),
    )
    rotation, translation = view.cam_from_world[:3, :3], view.cam_from_world[:3, 3]
    # the wall lies 6 units in front of the camera and is made of many Gaussians
    tangent = np.linalg.svd(normal_cam[None])[2][1:]
    generator = np.random.default_rng(9)
    points_cam = np.array([0.0, 0.0, 6.0]) + generator.uniform(-9, 9, (400, 2)) @ tangent
    points_cam = points_cam[points_cam[:, 2] > 1.0]
    axes = np.stack([tangent[0], tangent[1], np.cross(tangent[0], tangent[1])], axis=1)
    count = len(points_cam)
    gaussians = Gaussians(
        torch.tensor((points_cam - translation) @ rotation, dtype=torch.float32),
        torch.log(torch.tensor([[0.8, 0.8, 1e-4]])).repeat(count, 1),
        quat_of(rotation.T @ axes).repeat(count, 1),
        torch.full((count,), 2.0),
        torch.zeros(count, 3),
    )
    rendering = render(gaussians, view)
    u, v = np.meshgrid(np.arange(60) + 0.5, np.arange(44) + 0.5)
    rays = np.stack([(u - 21.0) / 55.0, (v - 30.0) / 57.0, np.ones_like(u)], axis=-1)
    expected = torch.from_numpy(normal_cam[2] * 6.0 / (rays @ normal_cam))
    covered = (rendering.alpha > 0.01) & (expected > 0)
    assert covered.double().mean() > 0.5
    depth = unbiased_depth(rendering, view)
    assert ((depth - expected).abs() / expected)[covered].max() < 1e-4


def quat_of(rotation):
    """(1, 4) wxyz quaternion of a rotation matrix, by the eigenvector of its symmetric form."""
    r = rotation if np.linalg.det(rotation) > 0 else rotation * [1, 1, -1]
    matrix = np.array(
        [
            [r[0, 0] + r[1, 1] + r[2, 2], r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]],
            [0, r[0, 0] - r[1, 1] - r[2, 2], r[0, 1] + r[1, 0], r[0, 2] + r[2, 0]],
            [0, 0, r[1, 1] - r[0, 0] - r[2, 2], r[1, 2] + r[2, 1]],
            [0, 0, 0, r[2, 2] - r[0, 0] - r[1, 1]],
        ]
    )
    quat = torch.tensor(np.linalg.eigh(matrix, UPLO="U")[1][:, -1], dtype=torch.float32)[None]
    assert torch.allclose(rotation_matrices(quat)[0], torch.tensor(r, dtype=torch.float32), atol=1e-5)
    return quat


def test_depth_is_differentiable_and_safe_where_nothing_is():
    gaussians, view = with_gradients(make_gaussians(20, 1, seed=10, size=-2.5)), make_view()
    rendering = render(gaussians, view)
    depth = unbiased_depth(rendering, view)
    empty = rendering.alpha < 1e-3
    assert empty.any()
    assert (depth[empty] == 0).all()
    depth.sum().backward()
    assert gaussians.means.grad.norm() > 0
    assert all(
        torch.isfinite(getattr(gaussians, name).grad).all()
        for name in ("means", "log_scales", "quats", "opacity_logits")
    )


@pytest.mark.skipif(numba.config.NUMBA_NUM_THREADS < 2, reason="one processor")
def test_threads_do_not_change_a_bit():
    before, results = numba.get_num_threads(), []
    for threads in (1, 2):
        numba.set_num_threads(threads)
        gaussians = with_gradients(make_gaussians(3000, 4, seed=11, size=-3.0))
        rendering = render(gaussians, make_view(150, 110, (120.0, 120.0, 70.0, 50.0)))
        weighted_sum(images(rendering)).backward()
        statistics = rendering.statistics
        results.append(
            [
                *images(rendering),
                *(getattr(gaussians, name).grad for name in NAMES),
                statistics.gradient,
                statistics.absolute_gradient,
                statistics.weight,
                statistics.max_transmittance,
                rendering.radii,
            ]
        )
    numba.set_num_threads(before)
    assert all(torch.equal(first, second) for first, second in zip(*results, strict=True))


@pytest.mark.parametrize("count", [0, 1, 40])
def test_nothing_visible_gives_background_and_zero_gradients(count):
    gaussians = make_gaussians(count, 4, seed=12)
    gaussians.means[:, 2] = -20.0  # behind the camera
    gaussians = with_gradients(gaussians)
    rendering = render(gaussians, make_view(), background=BACKGROUND)
    assert torch.equal(rendering.color, BACKGROUND.expand(37, 45, 3))
    assert (rendering.radii == 0).all()
    weighted_sum(images(rendering)).backward()
    assert all((getattr(gaussians, name).grad == 0).all() for name in NAMES)


def test_extreme_parameters_stay_finite():
    gaussians = make_gaussians(64, 4, seed=13)
    gaussians.log_scales[:8], gaussians.log_scales[8:16] = 12.0, -30.0
    gaussians.opacity_logits[16:24], gaussians.opacity_logits[24:32] = 60.0, -60.0
    gaussians.quats[32:40] *= 1e-4
    gaussians.means[40:48, 2], gaussians.means[48:56, 0] = -4.98, 1e6
    gaussians = with_gradients(gaussians)
    rendering = render(gaussians, make_view())
    weighted_sum(images(rendering)).backward()
    assert all(torch.isfinite(image).all() for image in images(rendering))
    assert all(torch.isfinite(getattr(gaussians, name).grad).all() for name in NAMES)


def test_statistics():
    gaussians, view = with_gradients(make_gaussians(300, 1, seed=14)), make_view()
    rendering = render(gaussians, view)
    statistics = rendering.statistics
    assert float(statistics.weight.sum()) == pytest.approx(float(rendering.alpha.detach().sum()), rel=1e-5)
    assert ((statistics.max_transmittance > 0) == (statistics.weight > 0)).all()
    assert ((statistics.weight == 0) | (rendering.radii > 0)).all()
    nearest = (gaussians.means.detach().double() @ torch.tensor(view.cam_from_world[2, :3]))[
        statistics.weight > 0
    ].argmin()
    assert statistics.max_transmittance[statistics.weight > 0][nearest] == 1.0
    assert statistics.max_transmittance.max() == 1.0
    weighted_sum(images(rendering)).backward()
    assert (statistics.absolute_gradient >= statistics.gradient * (1 - 1e-5)).all()
    assert (statistics.gradient > 0).sum() > 200


def test_gradient_statistic_is_the_derivative_by_the_2d_mean():
    """A principal point that moves by one pixel moves every 2D mean by one pixel (the Jacobian moves with it,
    far from its clamp).
    """
    gaussians = make_gaussians(1, 1, seed=15)
    gaussians.means[:], gaussians.opacity_logits[:] = torch.tensor([[0.2, 0.1, 0.0]]), 1.0
    fast = with_gradients(gaussians)
    rendering = render(fast, make_view())
    weighted_sum(images(rendering)[:1]).backward()
    double, step = with_gradients(gaussians, torch.float64), 1e-4
    slopes = []
    for dx, dy in ((step, 0.0), (0.0, step)):
        views = [make_view(calibration=(40.0, 42.0, 27.3 + sign * dx, 15.1 + sign * dy)) for sign in (-1, 1)]
        shifted = [weighted_sum(render_reference(double, shifted_view)[:1]).item() for shifted_view in views]
        slopes.append((shifted[1] - shifted[0]) / (2 * step))
    expected = np.hypot(slopes[0] * 45 / 2, slopes[1] * 37 / 2)
    assert float(rendering.statistics.gradient[0]) == pytest.approx(expected, rel=1e-3)


def test_geometry_can_be_left_out():
    gaussians, view = make_gaussians(100, 1, seed=16), make_view()
    whole, part = render(gaussians, view), render(gaussians, view, geometry=False)
    assert torch.equal(whole.color, part.color)
    assert torch.equal(whole.alpha, part.alpha)
    assert (part.normal == 0).all()


def test_unusable_input_is_refused():
    gaussians = make_gaussians(3, 1)
    view = make_view()
    doubles = Gaussians(*(getattr(gaussians, name).double() for name in NAMES))
    with pytest.raises(ValueError, match="float32"):
        render(doubles, view)
    lens = pycolmap.Camera(model="SIMPLE_RADIAL", width=45, height=37, params=[40.0, 22.0, 18.0, 0.1])
    with pytest.raises(ValueError, match="undistorted"):
        render(gaussians, replace(view, camera=lens))
