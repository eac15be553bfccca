"""What a checkpoint must be like before training goes on from it: the kernels believe the shapes of the
tensors that it holds.
"""

from __future__ import annotations

from dataclasses import fields

import torch

from sc3d.geometry.cameras import View
from sc3d.io.splats import check_splats
from sc3d.splatting.strategy import Statistics


def check_state(state: dict, parameters: dict[str, torch.Tensor], views: list[View], path: str) -> None:
    """Raise ValueError, KeyError, RuntimeError or InputError unless a state has the shapes and ranges of one
    that `Trainer.save` wrote.

    state: as loaded, with tensors and plain values only; parameters: as a fresh run has them; views: all of
        them
    """
    size = len(state["parameters"]["means"])
    shapes = {name: (size, *tensor.shape[1:]) for name, tensor in parameters.items()}
    _check_tensors(state["parameters"], shapes)
    check_splats({name: tensor.numpy() for name, tensor in state["parameters"].items()}, path)
    _check_adam(state["optimizer"], shapes)
    exposure = {"exposure": (len(views), 2)}
    _check_tensors({"exposure": state["exposure"]}, exposure)
    _check_adam(state["exposure_optimizer"], exposure)
    _check_tensors(state["statistics"], {field.name: (size,) for field in fields(Statistics)})
    _check_tensors(
        state["depths"], {index: (views[index].height, views[index].width) for index in state["depths"]}
    )
    torch.Generator().set_state(state["generator"])  # RuntimeError for a state that cannot be
    numbers = [
        state["iteration"],
        state["optimizer"]["count"],
        state["exposure_optimizer"]["count"],
        *state["queue"],
        *state["depths"],
    ]
    if not all(type(number) is int and number >= 0 for number in numbers) or any(
        index >= len(views) for index in [*state["queue"], *state["depths"]]
    ):
        raise ValueError("counts or views that do not exist")
    if (
        not isinstance(state["log"], list)
        or not isinstance(state["recent"], list)
        or not isinstance(state["seconds"], float)
    ):
        raise ValueError("no log")


def _check_adam(state: dict, shapes: dict[str, tuple[int, ...]]) -> None:
    for moments in ("means", "squares"):
        _check_tensors(state[moments], shapes)


def _check_tensors(tensors: dict, shapes: dict) -> None:
    if tensors.keys() != shapes.keys():
        raise ValueError("other tensors")
    for name, tensor in tensors.items():
        if (
            not isinstance(tensor, torch.Tensor)
            or tensor.shape != shapes[name]
            or tensor.dtype != torch.float32
            or tensor.layout != torch.strided
        ):
            raise ValueError(f"{name} has another shape or type")
