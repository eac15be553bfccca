"""Optimizers in checkpoints, and what a checkpoint must be like before training goes on from it: the kernels
believe the shapes of the tensors that it holds.
"""

from __future__ import annotations

from dataclasses import fields

import torch

from sc3d.geometry.cameras import View
from sc3d.io.splats import check_splats
from sc3d.splatting.strategy import MOMENTS, Statistics


def optimizer_state(optimizer: torch.optim.Optimizer) -> list[dict]:
    """Step count and moments of every tensor, in the order of the groups; empty before the first step."""
    return [dict(optimizer.state[group["params"][0]]) for group in optimizer.param_groups]


def restore_optimizer(optimizer: torch.optim.Optimizer, saved: list[dict]) -> None:
    """Undo `optimizer_state`; tensors go to the device of their parameter."""
    for group, state in zip(optimizer.param_groups, saved, strict=True):
        (tensor,) = group["params"]
        optimizer.state[tensor] = {
            name: value.to(tensor.device) if isinstance(value, torch.Tensor) else value
            for name, value in state.items()
        }


def check_state(
    state: dict, parameters: dict[str, torch.Tensor], exposures: torch.Tensor, views: list[View], path: str
) -> None:
    """Raise ValueError, KeyError, RuntimeError, TypeError or InputError unless a state has the shapes and
    ranges of one that `Trainer.save` wrote.

    state: as loaded, with tensors and plain values only; parameters, exposures: as a fresh run has them; views:
        all of them
    """
    size = len(state["parameters"]["means"])
    shapes = {name: (size, *tensor.shape[1:]) for name, tensor in parameters.items()}
    _check_tensors(state["parameters"], shapes)
    check_splats({name: tensor.numpy() for name, tensor in state["parameters"].items()}, path)
    _check_optimizer(state["optimizer"], list(shapes.values()))
    _check_tensors({"exposures": state["exposures"]}, {"exposures": exposures.shape})
    _check_optimizer(state["exposure_optimizer"], [exposures.shape])
    _check_tensors(state["statistics"], {field.name: (size,) for field in fields(Statistics)})
    _check_tensors(
        state["depths"], {index: (views[index].height, views[index].width) for index in state["depths"]}
    )
    torch.Generator().set_state(state["generator"])  # RuntimeError for a state that cannot be
    indices = [*state["queue"], *state["depths"]]
    if not all(type(number) is int and number >= 0 for number in [state["iteration"], *indices]):
        raise ValueError("no counts")
    if any(index >= len(views) for index in indices):
        raise ValueError("views that do not exist")
    if [type(state[name]) for name in ("log", "recent", "seconds")] != [list, list, float]:
        raise ValueError("no log")


def _check_optimizer(saved: list[dict], shapes: list[tuple[int, ...]]) -> None:
    for state, shape in zip(saved, shapes, strict=True):
        if state:
            step = torch.as_tensor(state["step"]).float()
            _check_tensors({**state, "step": step}, {"step": (), **dict.fromkeys(MOMENTS, shape)})
            if not 0 <= step.item() < 2**31:
                raise ValueError("no steps")


def _check_tensors(tensors: dict, shapes: dict) -> None:
    if tensors.keys() != shapes.keys():
        raise ValueError("other tensors")
    for name, tensor in tensors.items():
        kind = torch.float32, torch.strided, shapes[name]
        if not isinstance(tensor, torch.Tensor) or (tensor.dtype, tensor.layout, tensor.shape) != kind:
            raise ValueError(f"{name} has another shape or type")
