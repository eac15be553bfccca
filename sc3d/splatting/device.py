"""Where the numbers live: the numba kernels work on the CPU; on a GPU gsplat renders and plain torch does the
rest.
"""

from __future__ import annotations

import importlib.util

import torch

from sc3d.errors import InputError, MissingPackageError

INSTALL = "the GPU renderer needs gsplat: pip install 'sc3d[cuda]' (or use --device cpu)"


def has_kernels(tensor: torch.Tensor) -> bool:
    """Whether the numba kernels can work on this tensor; if not, each has a twin in torch operations."""
    return tensor.device.type == "cpu"


def device_type(name: str) -> str:
    """cpu or cuda. name: either, or auto = cuda if torch finds a GPU and gsplat is installed, else the CPU."""
    if name != "auto":
        return name
    return "cuda" if torch.cuda.is_available() and importlib.util.find_spec("gsplat") is not None else "cpu"


def pick_device(name: str) -> torch.device:
    """The device to train on, that of `device_type`.

    Choosing CUDA switches TF32 convolutions off: the variances of SSIM are differences of large numbers,
    which TF32 cannot hold.
    Raises InputError if `cuda` is asked for and torch finds no GPU, MissingPackageError if gsplat is not
    installed.
    """
    if device_type(name) == "cpu":
        return torch.device("cpu")
    if not torch.cuda.is_available():
        raise InputError("torch finds no CUDA device here: use --device cpu (or auto)")
    if importlib.util.find_spec("gsplat") is None:
        raise MissingPackageError(INSTALL)
    torch.backends.cudnn.allow_tf32 = False
    return torch.device("cuda")
