"""The renderer against gsplat's pure-torch functions on the CPU, and the GPU backend with them in place of
gsplat's CUDA kernels.

gsplat's image is put together here: its projection, spherical harmonics and tile lists; the fragments of each
pixel by the rules of its CUDA kernels (listed below in torch, because gsplat lists them on a GPU only); its
`accumulate`, with a stand-in for the two nerfacc functions that it calls.
Both renderers keep every fragment with alpha >= 1/255: gsplat's boxes of 3.33 sigma hold them all, since 255
exp(-3.33^2 / 2) < 1. They limit alpha differently (0.99 here, 0.999 there) and end a pixel one fragment
apart, so opacities stay below 0.99 and transmittances above 1e-4.
"""

import sys
import types

import numpy as np
import pytest
import torch

from sc3d.errors import MissingPackageError
from sc3d.geometry.cameras import look_at, pinhole_view
from sc3d.settings.train import TrainSettings
from sc3d.splatting import device
from sc3d.splatting.gpu import gsplat_backend
from sc3d.splatting.gpu.gsplat_backend import Functions, render_gpu, transmittances
from sc3d.splatting.losses import image_loss
from sc3d.splatting.rendering import render
from sc3d.splatting.trainer import Trainer
from tests.splatting.scenes import photographed, ring, valley
from tests.splatting.test_rendering import (
    BACKGROUND,
    NAMES,
    images,
    make_gaussians,
    weighted_sum,
    with_gradients,
)

TILE = 16


def make_view():
    pose = look_at(np.array([0.5, -1.0, -5.0]), np.zeros(3), up=(0, -1, 0))
    return pinhole_view("view", (96, 64), (80.0, 84.0, 60.3, 22.1), pose)


def make_scene(count=1000, coefficients=16, seed=0, size=-2.6):
    gaussians = make_gaussians(count, coefficients, seed, size)
    gaussians.opacity_logits.clamp_(max=4.5)  # 0.989
    gaussians.means[:, 2] += 0.5
    return gaussians


def list_fragments(first, last, start, means2d, conics, opacities, width, height, tile_size, offsets, ids):
    """`rasterize_to_indices_in_range` of one view in torch: every Gaussian of a tile against every pixel of
    it.
    """
    assert (first, tile_size) == (0, TILE) and last > 1e6
    columns = offsets.shape[2]
    bounds = [*map(int, offsets.flatten()), len(ids)]
    found = []
    for tile, (begin, end) in enumerate(zip(bounds[:-1], bounds[1:], strict=True)):
        rows = torch.arange(
            tile // columns * TILE, min(tile // columns * TILE + TILE, height), device=ids.device
        )
        cols = torch.arange(
            tile % columns * TILE, min(tile % columns * TILE + TILE, width), device=ids.device
        )
        pixels = (rows[:, None] * width + cols).reshape(-1)
        chosen = ids[begin:end].long()
        delta = torch.stack([pixels % width, pixels // width], 1)[:, None] + 0.5 - means2d[0, chosen]
        (x, y), (a, b, c) = delta.unbind(2), conics[0, chosen].unbind(1)
        alpha = (opacities[0, chosen] * torch.exp(-0.5 * (a * x * x + c * y * y) - b * x * y)).clamp_max(
            0.999
        )
        kept = alpha >= 1 / 255
        after = start.reshape(-1)[pixels, None] * torch.cumprod(torch.where(kept, 1 - alpha, 1.0), 1)
        pixel, entry = torch.nonzero(kept & (after > 1e-4), as_tuple=True)
        found.append((chosen[entry], pixels[pixel]))
    gaussian_ids, pixel_ids = (torch.cat(parts) for parts in zip(*found, strict=True))
    order = torch.argsort(pixel_ids, stable=True)
    return gaussian_ids[order], pixel_ids[order], torch.zeros_like(pixel_ids)


def nerfacc_stand_in():
    """A module with the two functions that gsplat's `accumulate` calls; fragments of a ray lie side by side,
    near to far.
    """

    def render_weight_from_alpha(alphas, ray_indices, n_rays):
        counts = torch.bincount(ray_indices, minlength=n_rays)
        rank = torch.arange(len(alphas), device=alphas.device) - (counts.cumsum(0) - counts)[ray_indices]
        table = alphas.new_zeros(n_rays, int(counts.max()) + 1).index_put((ray_indices, rank + 1), alphas)
        reached = torch.cumprod(1 - table, 1)[ray_indices, rank]
        return alphas * reached, reached

    def accumulate_along_rays(weights, values, ray_indices, n_rays):
        values = weights[:, None] if values is None else weights[:, None] * values
        return values.new_zeros(n_rays, values.shape[1]).index_add(0, ray_indices, values)

    module = types.ModuleType("nerfacc")
    module.render_weight_from_alpha, module.accumulate_along_rays = (
        render_weight_from_alpha,
        accumulate_along_rays,
    )
    return module


@pytest.fixture
def reference(monkeypatch):
    """gsplat's pure-torch functions."""
    pytest.importorskip("gsplat")
    monkeypatch.setitem(sys.modules, "nerfacc", nerfacc_stand_in())
    from gsplat.cuda import _torch_impl

    return _torch_impl


def gsplat_images(reference, gaussians, view, sh_degree):
    """color, alpha, normal, plane_distance of `render`, from gsplat's functions only."""
    pose, matrix = (torch.from_numpy(array).float()[None] for array in (view.cam_from_world, view.matrix))
    covariances, _ = reference._quat_scale_to_covar_preci(
        gaussians.quats, gaussians.log_scales.exp(), compute_preci=False
    )
    means_cam, _ = reference._world_to_cam(gaussians.means, covariances, pose)
    radii, means2d, depths, conics, _ = reference._fully_fused_projection(
        gaussians.means, covariances, pose, matrix, view.width, view.height
    )
    columns, rows = -(-view.width // TILE), -(-view.height // TILE)
    _, keys, ids = reference._isect_tiles(means2d.detach(), radii, depths.detach(), TILE, columns, rows)
    offsets = reference._isect_offset_encode(keys, 1, columns, rows)
    smallest = gaussians.log_scales.argmin(1)
    normals = (
        reference._quat_to_rotmat(gaussians.quats)[torch.arange(len(gaussians)), :, smallest]
        @ pose[0, :3, :3].T
    )
    facing = (normals * means_cam[0]).sum(1, keepdim=True)
    colors = (
        reference._spherical_harmonics(
            sh_degree, gaussians.means - torch.from_numpy(view.center).float(), gaussians.sh
        )
        + 0.5
    )
    features = torch.cat([colors.clamp_min(0), -normals * facing.sign(), facing.abs()], 1)[None]
    splats = means2d, conics, torch.sigmoid(gaussians.opacity_logits)[None]
    fragments = list_fragments(
        0,
        1 << 30,
        torch.ones(1, view.height, view.width),
        *(tensor.detach() for tensor in splats),
        view.width,
        view.height,
        TILE,
        offsets,
        ids,
    )
    image, alpha = reference.accumulate(*splats, features, *fragments, view.width, view.height)
    return image[0, ..., :3], alpha[0, ..., 0], image[0, ..., 3:6], image[0, ..., 6]


@pytest.fixture
def functions(reference, monkeypatch):
    """Twins of the functions that the backend calls, in their place."""

    def fully_fused_projection(
        means, covars, quats, scales, viewmats, Ks, width, height, eps2d, near_plane, opacities
    ):
        covars, _ = reference._quat_scale_to_covar_preci(quats, scales, compute_preci=False)
        return reference._fully_fused_projection(
            means, covars, viewmats, Ks, width, height, eps2d, near_plane
        )

    def rasterize_to_pixels(
        means2d, conics, colors, opacities, width, height, tile_size, offsets, ids, absgrad
    ):
        start, splats = (
            means2d.new_ones(1, height, width),
            (tensor.detach() for tensor in (means2d, conics, opacities)),
        )
        chosen, pixels, views = list_fragments(
            0, 1 << 30, start, *splats, width, height, tile_size, offsets, ids
        )
        # one row per fragment, for the absolute gradients
        splats = [tensor[:, chosen] for tensor in (means2d, conics, opacities, colors)]
        if absgrad:
            splats[0].register_hook(
                lambda slopes: setattr(
                    means2d, "absgrad", torch.zeros_like(means2d).index_add(1, chosen, slopes.abs())
                )
            )
        return reference.accumulate(
            *splats, torch.arange(len(chosen), device=chosen.device), pixels, views, width, height
        )

    twins = Functions(
        fully_fused_projection,
        reference._spherical_harmonics,
        reference._isect_tiles,
        reference._isect_offset_encode,
        rasterize_to_pixels,
        list_fragments,
    )
    monkeypatch.setattr(gsplat_backend, "cuda_functions", lambda: twins)
    return twins


@pytest.mark.parametrize(("count", "size", "sh_degree"), [(300, -1.9, 3), (2000, -3.0, 1)])
def test_image_and_gradients_equal_gsplat(reference, count, size, sh_degree):
    gaussians, view = make_scene(count, size=size), make_view()
    ours, theirs = with_gradients(gaussians), with_gradients(gaussians)
    found, expected = images(render(ours, view, sh_degree)), gsplat_images(reference, theirs, view, sh_degree)
    assert 0.3 < expected[1].mean() < 0.9 and expected[1].max() < 1 - 1e-4
    for image, truth in zip(found, expected, strict=True):
        assert (image - truth).abs().mean() < 1e-5
        assert (image - truth).abs().max() < 1e-3
    weighted_sum(found).backward()
    weighted_sum(expected).backward()
    for name in NAMES:
        gradient, truth = getattr(ours, name).grad, getattr(theirs, name).grad
        assert (gradient - truth).norm() < 1e-4 * truth.norm(), name


def test_median_depth_and_its_gradients_equal_the_kernels(functions, monkeypatch):
    monkeypatch.setattr(gsplat_backend, "BAND_PIXELS", 96 * 20)  # several bands
    gaussians, view = make_scene(300, 1, seed=4, size=-1.4), make_view()
    cpu, gpu = with_gradients(gaussians), with_gradients(gaussians)
    expected = render(cpu, view, depth_mode="median").median_depth
    found = render_gpu(gpu, view, 0, None, True, True).median_depth
    both, focal = (expected > 0) & (found > 0), view.focal
    assert both.double().mean() > 0.5 and ((expected > 0) == (found > 0)).double().mean() > 0.999
    gap = ((found - expected).abs() / expected.clamp_min(1e-6)).detach() * focal
    assert gap[both].quantile(0.99) < 0.02  # footprints
    weight = torch.randn(found.shape, generator=torch.Generator().manual_seed(3)) * (both & (gap < 1e-4))
    (expected * weight).sum().backward()
    (found * weight).sum().backward()
    for name in NAMES[:4]:
        gradient, truth = getattr(gpu, name).grad, getattr(cpu, name).grad
        assert (gradient - truth).norm() < 0.01 * truth.norm(), name


@pytest.mark.parametrize("geometry", [True, False])
def test_backend_composes_the_same_rendering(functions, monkeypatch, geometry):
    monkeypatch.setattr(gsplat_backend, "BAND_PIXELS", 96 * 20)  # several bands
    gaussians, view = make_scene(400, 9, seed=1, size=-2.0), make_view()
    cpu, gpu = with_gradients(gaussians), with_gradients(gaussians)
    expected = render(cpu, view, 2, BACKGROUND, geometry)
    found = render_gpu(gpu, view, 2, BACKGROUND, geometry, False)
    assert torch.equal(found.statistics.gradient, torch.zeros(400)) and torch.equal(
        found.statistics.absolute_gradient, torch.zeros(400)
    )
    for image, truth in zip(images(found), images(expected), strict=True):
        assert image.shape == truth.shape
        assert (image - truth).abs().mean() < 1e-5
    weighted_sum(images(found)[: None if geometry else 2]).backward()
    weighted_sum(images(expected)[: None if geometry else 2]).backward()
    for name in NAMES:
        gradient, truth = getattr(gpu, name).grad, getattr(cpu, name).grad
        assert (gradient - truth).norm() < 1e-4 * truth.norm(), name
    hit = expected.statistics.weight > 0
    assert torch.allclose(found.radii[hit], expected.radii[hit], rtol=1e-3)
    for name in ("weight", "max_transmittance", "gradient", "absolute_gradient"):
        value, truth = getattr(found.statistics, name), getattr(expected.statistics, name)
        assert (value - truth).norm() < 1e-3 * truth.norm(), name


def test_backend_without_gradients_and_without_gaussians_in_view(functions, monkeypatch):
    gaussians, view = make_scene(50, 1, seed=2, size=-2.0), make_view()
    with torch.no_grad():
        rendering = render_gpu(gaussians, view, 0, None, True, True)
    assert not rendering.color.requires_grad and rendering.statistics.weight.sum() > 1
    assert rendering.median_depth.max() > 0
    gaussians.means[:, 2] = -20.0  # behind the camera
    monkeypatch.setattr(gsplat_backend, "cuda_functions", lambda: empty_safe(functions))
    rendering = render_gpu(with_gradients(gaussians), view, 0, BACKGROUND, True, True)
    assert torch.allclose(rendering.color, BACKGROUND.expand(64, 96, 3))
    assert not rendering.median_depth.any()
    assert (
        not rendering.radii.any()
        and not rendering.statistics.weight.any()
        and not rendering.statistics.max_transmittance.any()
    )


def empty_safe(functions):
    """The stand-in for nerfacc cannot take zero fragments; gsplat's kernels can."""

    def rasterize_to_pixels(
        means2d, conics, colors, opacities, width, height, tile_size, offsets, ids, absgrad
    ):
        assert not len(ids)
        return means2d.sum() * 0 + torch.zeros(1, height, width, colors.shape[2]), torch.zeros(
            1, height, width, 1
        )

    return Functions(**{**vars(functions), "rasterize_to_pixels": rasterize_to_pixels})


def test_transmittance_is_the_product_before_a_fragment():
    alphas, pixels = torch.tensor([0.5, 0.2, 0.9, 0.3, 0.3]), torch.tensor([2, 2, 2, 3, 7])
    assert torch.allclose(transmittances(alphas, pixels), torch.tensor([1.0, 0.5, 0.4, 1.0, 1.0]))
    assert len(transmittances(alphas[:0], pixels[:0])) == 0


def test_missing_gsplat_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "gsplat", None)
    monkeypatch.setattr(device, "has_kernels", lambda tensor: False)
    with pytest.raises(MissingPackageError, match=r"pip install 'sc3d\[cuda\]'"):
        render(make_scene(3), make_view())


@pytest.mark.parametrize("size", [(37, 45), (3, 5), (65, 129)])
def test_image_loss_in_torch_equals_the_kernel(size, monkeypatch):
    generator = torch.Generator().manual_seed(0)
    image, target = torch.rand(*size, 3, generator=generator), torch.rand(*size, 3, generator=generator)
    one, other = image.clone().requires_grad_(), image.clone().requires_grad_()
    expected, kernel = image_loss(other, target, 0.3), image_loss(image, target, 1.0).item()
    monkeypatch.setattr(device, "has_kernels", lambda tensor: False)
    loss = image_loss(one, target, 0.3)
    assert loss.item() == pytest.approx(expected.item(), abs=1e-6)
    loss.backward()
    expected.backward()
    assert (one.grad - other.grad).norm() < 1e-4 * other.grad.norm()
    assert image_loss(image, target, 1.0).item() == pytest.approx(kernel, abs=1e-6)


@pytest.mark.parametrize(("iterations", "weight"), [(1, 0.1), (5, 0.0)])
def test_training_without_kernels_is_the_same(functions, monkeypatch, iterations, weight):
    """What a GPU computes, on the CPU: gsplat's twins render, every loss and Adam are torch operations.

    One step with the multi-view terms, more without: they draw from the pixels with alpha > 0.5, and a last
    digit there changes the whole draw.
    """
    data, *_ = photographed([view.resized(48, 32) for view in ring()], valley(), 3.0, 0.05, 300)
    settings = TrainSettings(
        iterations,
        300,
        sh_degree=1,
        num_patches=64,
        surface_from=0.0,
        coarse_until=0.0,
        densify_until=0.0,
        flatten_weight=0.0,
        geometric_weight=weight,
        photometric_weight=weight,
    )
    states = []
    for kernels in (True, False):
        monkeypatch.setattr(device, "has_kernels", lambda tensor, answer=kernels: answer)
        trainer = Trainer(data, settings)
        for _ in range(iterations):
            trainer.step()
        states.append((trainer.log[-1], trainer.gaussians.detached().parameters()))
    (log, parameters), (other_log, other_parameters) = states
    assert log["loss"] == pytest.approx(other_log["loss"], rel=2e-3) and log["psnr"] == pytest.approx(
        other_log["psnr"], rel=2e-3
    )
    for name in ("means", "opacity_logits"):
        assert (parameters[name] - other_parameters[name]).abs().median() < 1e-4, name
