"""Which device is picked; training on another one, without one: every tensor is where it should be."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from sc3d.errors import InputError, MissingPackageError
from sc3d.scene.held_out import mean_scores
from sc3d.settings.train import TrainSettings
from sc3d.splatting import device, trainer
from sc3d.splatting.gpu import gsplat_backend
from sc3d.splatting.trainer import train
from tests.pretend_device import PretendDevice
from tests.splatting.gpu.test_gsplat_backend import functions, reference  # noqa: F401, fixtures
from tests.splatting.scenes import photographed, ring, valley


def test_the_pretended_device_refuses_to_mix():
    with PretendDevice():
        there = torch.arange(3.0).to("meta").requires_grad_()
        (there * there).sum().backward()
        assert there.device.type == "meta" and there.grad.cpu().tolist() == [0, 2, 4]
        with pytest.raises(RuntimeError, match="two devices"):
            there + torch.ones(3)


def isect_tiles(means2d, radii, depths, tile_size, columns, rows):
    """gsplat's, without its slow loop in Python: the Gaussians whose boxes touch each tile, near to far."""
    order = torch.argsort(depths[0])
    order = order[(radii[0, order] > 0).all(1)]
    first, last = ((means2d[0, order] + sign * radii[0, order]) / tile_size for sign in (-1, 1))
    tiles = torch.arange(columns * rows, device=order.device)
    corners = torch.stack([tiles % columns, tiles // columns], 1)[:, None]
    tile, entry = torch.nonzero(((first < corners + 1) & (last > corners)).all(2), as_tuple=True)
    return None, tile << 32, order[entry].int()


def test_training_stays_on_its_device(functions, monkeypatch):  # noqa: F811
    monkeypatch.setattr(trainer, "pick_device", lambda name: torch.device("meta"))
    monkeypatch.setattr(gsplat_backend, "cuda_functions", lambda: replace(functions, isect_tiles=isect_tiles))
    data, *_ = photographed([view.resized(32, 24) for view in ring()], valley(), 3.0, 0.05, 400)
    data = replace(data, masks=lambda index: np.ones((24, 32), bool))
    settings = TrainSettings(
        8,
        800,
        sh_degree=1,
        num_patches=16,
        test_every=8,
        fill=False,
        coarse_until=0.2,
        surface_from=0.3,
        densify_from=0.1,
        densify_until=1.0,
        gradient_threshold=1e-6,
        absolute_gradient_threshold=1e-6,
    )
    with PretendDevice():
        result = train(data, settings, progress=False)
    assert result.gaussians.means.device.type == "cpu" and len(result.gaussians) > 400
    assert np.isfinite(mean_scores(result.held_out)["psnr"]) and np.isfinite(result.exposures).all()


def test_device_is_picked_by_what_is_there(monkeypatch):
    precision = torch.backends.cudnn.allow_tf32
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert device.pick_device("cpu").type == device.pick_device("auto").type == "cpu"
    assert [device.device_type(name) for name in ("cpu", "auto", "cuda")] == ["cpu", "cpu", "cuda"]
    with pytest.raises(InputError, match="no CUDA device"):
        device.pick_device("cuda")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(device.importlib.util, "find_spec", lambda name: None)
    assert device.pick_device("auto").type == device.device_type("auto") == "cpu"
    with pytest.raises(MissingPackageError, match="gsplat"):
        device.pick_device("cuda")
    monkeypatch.setattr(device.importlib.util, "find_spec", lambda name: name)
    assert device.pick_device("auto").type == device.pick_device("cuda").type == "cuda"
    assert [device.device_type(name) for name in ("cpu", "auto")] == ["cpu", "cuda"]
    torch.backends.cudnn.allow_tf32 = precision
