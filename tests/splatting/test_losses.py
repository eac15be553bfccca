"""Loss terms on analytic planes, where the right answer is known."""

import numpy as np
import pytest
import torch

from sc3d.geometry.cameras import look_at, pinhole_view, pixel_centers, rays
from sc3d.splatting import device, losses
from sc3d.splatting.consistency import pinhole
from sc3d.splatting.cpu import normal_loss
from sc3d.splatting.gpu import losses as gpu_losses

SIZE, CALIBRATION = (96, 64), (90.0, 85.0, 50.0, 30.0)
PLANE = np.array([0.2, -0.1, 1.0]) / np.linalg.norm([0.2, -0.1, 1.0])


def camera(x: float, y: float, z: float = 10.0, size=SIZE, calibration=CALIBRATION):
    return pinhole_view(
        f"{x},{y}", size, calibration, look_at(np.array([x, y, z]), np.array([0.1 * x, 0.2 * y, 0.0]))
    )


def plane_depth(view) -> torch.Tensor:
    """Depth of the plane PLANE . x = 0."""
    directions, along = rays(view)
    distance = -(view.center @ PLANE) / (directions @ PLANE)
    return torch.from_numpy((distance * along).reshape(view.height, view.width)).float()


def texture(points: np.ndarray) -> np.ndarray:
    x, y = points[..., 0], points[..., 1]
    return (
        0.5 + 0.2 * np.sin(3.1 * x + 0.5 * y) + 0.2 * np.cos(2.3 * y - x) + 0.1 * np.sin(5 * x * 0.7 + 4 * y)
    )


def plane_photo(view) -> torch.Tensor:
    directions, _ = rays(view)
    distance = -(view.center @ PLANE) / (directions @ PLANE)
    return torch.from_numpy(
        texture(view.center + distance[:, None] * directions).reshape(view.height, view.width)
    ).float()


def plane_maps(view) -> tuple[torch.Tensor, torch.Tensor]:
    """N (H, W, 3) and D (H, W) of the plane, scaled by an arbitrary alpha."""
    normal = view.cam_from_world[:3, :3] @ PLANE
    alpha = 0.3 + 0.7 * torch.rand(view.height, view.width, generator=torch.Generator().manual_seed(0))
    return alpha[..., None] * torch.from_numpy(normal).float(), alpha * float(view.center @ PLANE)


def test_normals_from_depth_are_exact_on_a_tilted_plane():
    view = camera(2, 1)
    normals = gpu_losses.normals_from_depth(plane_depth(view).requires_grad_(), pinhole(view)).detach()
    expected = torch.from_numpy(view.cam_from_world[:3, :3] @ PLANE).float()
    assert expected[2] < 0  # towards the camera
    assert (normals[1:-1, 1:-1] - expected).abs().max() < 1e-3
    assert not normals[0].any() and not normals[:, -1].any()


def test_normal_loss_is_zero_on_a_plane_and_positive_off_it():
    view = camera(2, 1)
    normal, distance = plane_maps(view)
    alpha, edges = normal.norm(dim=2), torch.zeros(view.height, view.width)
    depth, calibration = plane_depth(view), pinhole(view)
    tilted = normal @ torch.from_numpy(look_at(np.zeros(3), np.array([0.1, 1.0, 0.2]))[:3, :3]).float()
    for loss in (normal_loss.depth_normal_loss, gpu_losses.depth_normal_loss):
        assert loss(normal, depth, alpha, edges, calibration) < 1e-3
        assert loss(tilted, depth, alpha, edges, calibration) > 0.1
        assert loss(tilted, depth, alpha, edges + 1, calibration) == 0


def test_normal_kernel_equals_its_reference():
    view = camera(2, 1)
    generator = torch.Generator().manual_seed(0)
    start = plane_depth(view) * (1 + 0.02 * torch.rand(view.height, view.width, generator=generator))
    start[10:14, 20:25] = 0
    normal, _ = plane_maps(view)
    alpha, edges = (
        torch.rand(view.height, view.width, generator=generator),
        torch.rand(view.height, view.width, generator=generator),
    )
    results = []
    for kernels in (normal_loss, gpu_losses):
        depth, normals = start.clone().requires_grad_(), normal.clone().requires_grad_()
        loss = kernels.depth_normal_loss(normals, depth, alpha, edges, pinhole(view))
        (3 * loss).backward()
        results.append((loss.detach(), depth.grad, normals.grad))
    for one, other in zip(*results, strict=True):
        assert torch.allclose(one, other, atol=2e-4 * float(other.abs().max()), rtol=1e-3)


def test_warped_plane_correlates():
    view, other = camera(2, 1), camera(-1, 2, 11)
    normal, distance = plane_maps(view)
    pixels = torch.from_numpy(pixel_centers(*SIZE).astype(np.int64))
    planes = normal.reshape(-1, 3).requires_grad_(), distance.reshape(-1).requires_grad_()
    dissimilarity, inside = losses.patch_dissimilarity(
        planes, pixels, (plane_photo(view), view), (plane_photo(other), other)
    )
    assert inside.float().mean() > 0.4
    assert dissimilarity[inside].median() < 0.005 and dissimilarity[inside].quantile(0.9) < 0.01  # NCC > 0.99
    wrong = planes[0], planes[1] * 1.1
    assert (
        losses.patch_dissimilarity(wrong, pixels, (plane_photo(view), view), (plane_photo(other), other))[0][
            inside
        ].median()
        > 0.05
    )


def test_patch_kernel_equals_its_reference(monkeypatch):
    view, other = camera(2, 1), camera(-1, 2, 11, (80, 70), (100.0, 99.0, 41.0, 33.0))
    normal, distance = plane_maps(view)
    pixels = torch.from_numpy(pixel_centers(*SIZE).astype(np.int64))
    grays = (plane_photo(view), view), (plane_photo(other), other)
    results = []
    for there in (False, True):
        monkeypatch.setattr(device, "has_kernels", lambda tensor, there=there: not there)
        planes = (
            (normal * torch.tensor([1.0, 1.1, 0.98])).reshape(-1, 3).requires_grad_(),
            (distance * 1.02).reshape(-1).requires_grad_(),
        )
        values, inside = losses.patch_dissimilarity(planes, pixels, *grays)
        (values * inside * torch.linspace(0, 1, len(values))).sum().backward()
        results.append((values.detach() * inside, inside, planes[0].grad, planes[1].grad))
    ours, reference = results
    assert torch.equal(ours[1], reference[1])
    assert torch.allclose(ours[0], reference[0], atol=1e-4)
    for one, other in zip(ours[2:], reference[2:], strict=True):
        assert torch.allclose(one, other, atol=2e-3 * other.abs().max(), rtol=1e-2)


def test_photometric_gradient_leads_to_the_plane():
    view, other = camera(2, 1), camera(-1, 2, 11)
    normal, distance = plane_maps(view)
    pixels = torch.from_numpy(pixel_centers(*SIZE).astype(np.int64))
    for factor, sign in ((1.01, 1), (0.99, -1)):
        planes = normal.reshape(-1, 3), (distance.reshape(-1) * factor).requires_grad_()
        loss = losses.photometric_loss(
            planes, pixels, torch.ones(len(pixels)), (plane_photo(view), view), (plane_photo(other), other)
        )
        loss.backward()
        gradient = planes[1].grad
        assert torch.isfinite(gradient).all() and loss > 0
        assert (gradient[gradient != 0].sign() == sign).float().mean() > 0.8


def test_flat_patches_do_not_correlate_and_do_not_explode():
    flat = torch.full((5, 49), 0.4, requires_grad=True)
    correlation = gpu_losses.normalized_correlation(flat, torch.rand(5, 49))
    correlation.sum().backward()
    assert correlation.abs().max() < 1e-3 and torch.isfinite(flat.grad).all()


def test_flatten_loss_presses_the_smallest_scale_only():
    log_scales = torch.log(torch.tensor([[1.0, 2.0, 3.0], [4.0, 0.5, 6.0], [0.1, 0.1, 0.1]])).requires_grad_()
    loss = losses.flatten_loss(log_scales, torch.tensor([True, True, False]), extent=10.0)
    assert loss.item() == pytest.approx((1.0 + 0.5) / 2 / 10)
    loss.backward()
    assert (log_scales.grad != 0).nonzero().tolist() == [[0, 0], [1, 1]]
    assert losses.flatten_loss(log_scales, torch.zeros(3, dtype=torch.bool), 10.0) == 0


def test_exposure_is_recovered():
    image = torch.rand(20, 30, 3, generator=torch.Generator().manual_seed(0))
    exposure = torch.tensor([0.2, -0.05])
    photo = losses.apply_exposure(image, exposure)
    assert torch.allclose(losses.fit_exposure(image, photo), exposure, atol=1e-5)
    assert torch.equal(losses.apply_exposure(image, torch.zeros(2)), image)


@pytest.mark.parametrize("shape", [(7, 11, 3), (40, 3)])
def test_affine_colors_and_their_gradients_are_those_of_a_matrix(shape):
    random = torch.Generator().manual_seed(1)
    image, weight = (torch.rand(shape, generator=random) for _ in range(2))
    exposure = 0.2 * torch.randn(12, generator=random)
    found = [
        leaf.clone().to(kind).requires_grad_()
        for kind in (torch.float32, torch.float64)
        for leaf in (image, exposure)
    ]
    ours = losses.apply_exposure(*found[:2])
    change = found[3].reshape(3, 4)
    dense = found[2] @ (torch.eye(3) + change[:, :3]).T + change[:, 3]
    torch.testing.assert_close(ours.double(), dense, atol=1e-6, rtol=1e-6)
    for result in (ours, dense):
        (result.square() * weight.to(result)).sum().backward()
    for one, other in zip(found[:2], found[2:], strict=True):
        torch.testing.assert_close(one.grad.double(), other.grad, atol=1e-5, rtol=1e-5)
    assert torch.equal(losses.apply_exposure(image, torch.zeros(12)), image)


def test_gain_is_an_affine_transform_of_equal_channels():
    image = torch.rand(6, 9, 3, generator=torch.Generator().manual_seed(2))
    rows = torch.cat([(np.exp(0.2) - 1) * torch.eye(3), torch.full((3, 1), -0.05)], 1)
    torch.testing.assert_close(
        losses.apply_exposure(image, rows.flatten()),
        losses.apply_exposure(image, torch.tensor([0.2, -0.05])),
    )


def test_image_edges_are_relative():
    image = torch.zeros(10, 12, 3)
    image[:, 6:] = 0.3
    edges = losses.image_edges(image)
    assert edges.max() == 1 and not edges[:, :5].any() and not edges[:, 7:].any()
