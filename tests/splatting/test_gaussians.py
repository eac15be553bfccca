"""Gaussians: initialization and accessors."""

import numpy as np
import pytest
import torch

from sc3d.errors import InputError
from sc3d.splatting.gaussians import SH_C0, Gaussians


def random_gaussians(count: int, degree: int, seed: int = 0) -> Gaussians:
    generator = torch.Generator().manual_seed(seed)
    shapes = [(count, 3), (count, 3), (count, 4), (count,), (count, 3), (count, (degree + 1) ** 2 - 1, 3)]
    return Gaussians(*(torch.randn(shape, generator=generator) for shape in shapes))


def test_scale_is_the_rms_distance_to_three_neighbors():
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3], [100, 100, 100]], float)
    gaussians = Gaussians.from_points(points, np.full((5, 3), 128, np.uint8), sh_degree=1)
    assert gaussians.scales[0].numpy() == pytest.approx(np.full(3, np.sqrt((1 + 4 + 9) / 3)), rel=1e-6)
    assert gaussians.opacities.numpy() == pytest.approx(np.full(5, 0.1), rel=1e-5)
    assert gaussians.sh_rest.shape == (5, 3, 3) and not gaussians.sh_rest.any()
    assert (0.5 + SH_C0 * gaussians.sh_dc).numpy() == pytest.approx(np.full((5, 3), 128 / 255), rel=1e-6)


def test_duplicate_points_get_a_finite_scale():
    points = np.concatenate([np.zeros((6, 3)), np.random.default_rng(0).random((50, 3))])
    assert torch.isfinite(Gaussians.from_points(points, np.zeros((56, 3), np.uint8)).log_scales).all()
    assert torch.isfinite(
        Gaussians.from_points(np.zeros((9, 3)), np.zeros((9, 3), np.uint8)).log_scales
    ).all()
    assert len(Gaussians.from_points(np.eye(3)[:2], np.zeros((2, 3), np.uint8))) == 2
    with pytest.raises(InputError, match="sparse points"):
        Gaussians.from_points(np.zeros((1, 3)), np.zeros((1, 3), np.uint8))


def test_first_axis_starts_along_the_surface_normal():
    points = np.random.default_rng(0).uniform(-1, 1, (300, 3))
    points[:, 2] = 0.3 * points[:, 0] - 0.8 * points[:, 1]
    gaussians = Gaussians.from_points(points, np.zeros((300, 3), np.uint8))
    normal = np.array([0.3, -0.8, -1]) / np.linalg.norm([0.3, -0.8, -1])
    assert np.abs(gaussians.rotations[:, :, 0].numpy() @ normal).min() > 0.9999
    assert np.abs(gaussians.normals.numpy() @ normal).min() > 0.9999  # of equal scales the first counts


def test_normals_are_the_thin_axis_of_the_covariance():
    gaussians = random_gaussians(50, 0)
    values, vectors = torch.linalg.eigh(gaussians.covariances.double())
    assert torch.allclose(values.sqrt().float(), gaussians.scales.sort(1).values, rtol=1e-2)
    assert ((vectors[:, :, 0].float() * gaussians.normals).sum(1).abs() > 0.999).all()
    assert torch.allclose(torch.linalg.det(gaussians.rotations), torch.ones(50), atol=1e-5)
