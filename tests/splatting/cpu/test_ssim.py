"""Fused SSIM and image loss against a float64 grouped convolution."""

import numba
import pytest
import torch

from sc3d.splatting.losses import image_loss


def reference_ssim(x, y):
    """Mean SSIM of (H, W, 3) images: 11 x 11 Gaussian window, sigma 1.5, zero padding."""
    taps = torch.exp(-0.5 * ((torch.arange(11, dtype=x.dtype) - 5) / 1.5) ** 2)
    taps = taps / taps.sum()
    window = (taps[:, None] * taps).expand(3, 1, 11, 11)

    def blur(image):
        return torch.nn.functional.conv2d(image.permute(2, 0, 1)[None], window, padding=5, groups=3)

    mean_x, mean_y = blur(x), blur(y)
    variance_x, variance_y, covariance = (
        blur(x * x) - mean_x**2,
        blur(y * y) - mean_y**2,
        blur(x * y) - mean_x * mean_y,
    )
    top = (2 * mean_x * mean_y + 0.01**2) * (2 * covariance + 0.03**2)
    return (top / ((mean_x**2 + mean_y**2 + 0.01**2) * (variance_x + variance_y + 0.03**2))).mean()


def make_images(height, width, seed=0):
    generator = torch.Generator().manual_seed(seed)
    image = torch.rand(height, width, 3, generator=generator)
    return image, (image + 0.2 * torch.randn(height, width, 3, generator=generator)).clamp(0, 1)


@pytest.mark.parametrize("size", [(37, 45), (70, 260), (3, 5), (64, 128), (1, 1), (65, 129)])
def test_value_and_gradient_equal_the_convolution(size):
    image, target = make_images(*size)
    fast, slow = image.clone().requires_grad_(), image.double().requires_grad_()
    for weight in (0.0, 0.2, 1.0):
        fast.grad = slow.grad = None
        loss = image_loss(fast, target, weight)
        expected = (1 - weight) * (slow - target.double()).abs().mean() + weight * (
            1 - reference_ssim(slow, target.double())
        )
        assert loss.item() == pytest.approx(expected.item(), abs=1e-6)
        (3 * loss).backward()
        (3 * expected).backward()
        assert (fast.grad - slow.grad).norm() < 1e-5 * slow.grad.norm()
    assert image_loss(image, target, 1.0).item() == pytest.approx(
        1 - reference_ssim(image.double(), target.double()).item(), abs=1e-6
    )


def test_flat_and_equal_images():
    flat = torch.full((40, 30, 3), 0.7).requires_grad_()
    loss = image_loss(flat, flat.detach().clone())
    assert abs(loss.item()) < 1e-6
    loss.backward()
    assert flat.grad.abs().max() < 1e-6


def test_memory_layout_does_not_matter():
    image, target = make_images(50, 70)
    planes = [tensor.permute(2, 0, 1).contiguous().permute(1, 2, 0) for tensor in (image, target)]
    assert torch.equal(image_loss(image, target), image_loss(*planes))


@pytest.mark.skipif(numba.config.NUMBA_NUM_THREADS < 2, reason="one processor")
def test_threads_do_not_change_a_bit():
    before, results = numba.get_num_threads(), []
    image, target = make_images(200, 300)
    for threads in (1, 2):
        numba.set_num_threads(threads)
        fast = image.clone().requires_grad_()
        loss = image_loss(fast, target)
        loss.backward()
        results.append((loss.detach(), fast.grad))
    numba.set_num_threads(before)
    assert torch.equal(results[0][0], results[1][0])
    assert torch.equal(results[0][1], results[1][1])
