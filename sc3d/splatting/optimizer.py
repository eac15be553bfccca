"""Adam over rows: one row per Gaussian (or photo), so that rows can be skipped, reordered and added together
with their moments.
"""

from __future__ import annotations

import math

import numba
import numpy as np
import torch

from sc3d.splatting import device

BETAS = (0.9, 0.999)
EPSILON = 1e-15


class RowAdam:
    """Adam for named float32 tensors with the same number of rows.

    parameters: contiguous leaf tensors (N, ...), changed in place by `step`
    rates: per name a float, or one rate per column of the flattened (N, C) tensor
    """

    def __init__(self, parameters: dict[str, torch.Tensor], rates: dict[str, float | np.ndarray]) -> None:
        self.parameters = parameters
        self.rates = dict(rates)
        self.count = 0
        self.means = {
            name: torch.zeros_like(tensor, requires_grad=False) for name, tensor in parameters.items()
        }
        self.squares = {
            name: torch.zeros_like(tensor, requires_grad=False) for name, tensor in parameters.items()
        }

    def step(self, rows: torch.Tensor | None = None) -> None:
        """One update from the tensors' `.grad`, which is cleared. rows: (N,) bool; the others keep values and
        moments; None = all.
        """
        self.count += 1
        corrections = 1 - BETAS[0] ** self.count, math.sqrt(1 - BETAS[1] ** self.count)
        for name, tensor in self.parameters.items():
            if tensor.grad is None or not len(tensor):
                continue
            rates = np.broadcast_to(np.float32(self.rates[name]), tensor.numel() // len(tensor)) * np.float32(
                corrections[1] / corrections[0]
            )
            rates, epsilon = (
                torch.from_numpy(np.ascontiguousarray(rates, np.float32)),
                np.float32(EPSILON * corrections[1]),
            )
            flat = [
                part.detach().view(len(tensor), -1)
                for part in (tensor, tensor.grad.contiguous(), self.means[name], self.squares[name])
            ]
            chosen = (
                tensor.new_ones(len(tensor), dtype=torch.bool) if rows is None else rows.to(tensor.device)
            )
            if device.has_kernels(tensor):
                _update_rows(*(part.numpy() for part in (*flat, rates, chosen)), epsilon)
            else:
                _update_rows_torch(flat, rates.to(tensor.device), chosen, float(epsilon))
            tensor.grad = None

    def take(self, source: torch.Tensor, fresh: torch.Tensor) -> None:
        """Rebuild every tensor from rows of the present one: new[i] = old[source[i]]; its moments too, but
        zero where `fresh`.

        source: (M,) int64; fresh: (M,) bool; on any device. The entries of `parameters` are replaced by new
            leaves.
        """
        for name, tensor in self.parameters.items():
            source, fresh = source.to(tensor.device), fresh.to(tensor.device)
            self.parameters[name] = tensor.detach()[source].requires_grad_(tensor.requires_grad)
            for moments in (self.means, self.squares):
                moments[name] = moments[name][source]
                moments[name][fresh] = 0

    def state(self) -> dict:
        """Moments and step count, as tensors and plain numbers."""
        return {"count": self.count, "means": dict(self.means), "squares": dict(self.squares)}

    def restore(self, state: dict) -> None:
        """Undo `state`; moments go to the device of their parameters."""
        self.count = state["count"]
        for kept, saved in ((self.means, state["means"]), (self.squares, state["squares"])):
            kept.update({name: moments.to(self.parameters[name].device) for name, moments in saved.items()})


def _update_rows_torch(
    flat: list[torch.Tensor], rates: torch.Tensor, chosen: torch.Tensor, epsilon: float
) -> None:
    """`_update_rows` in torch operations, for GPUs. flat: (N, C) values, gradient, means and squares."""
    values, gradient, means, squares = flat
    chosen = chosen[:, None]
    means.copy_(torch.where(chosen, BETAS[0] * means + (1 - BETAS[0]) * gradient, means))
    squares.copy_(torch.where(chosen, BETAS[1] * squares + (1 - BETAS[1]) * gradient.square(), squares))
    values.sub_(torch.where(chosen, rates * means / (squares.sqrt() + epsilon), 0))


@numba.njit(parallel=True, cache=True, fastmath={"contract", "nsz", "arcp"})
def _update_rows(values, gradient, means, squares, rates, chosen, epsilon):
    """values -= rate * m / (sqrt(v) + epsilon); the bias corrections are inside `rates` and `epsilon`."""
    for row in numba.prange(values.shape[0]):
        if chosen[row]:
            for column in range(values.shape[1]):
                slope = gradient[row, column]
                mean = np.float32(0.9) * means[row, column] + np.float32(0.1) * slope
                square = np.float32(0.999) * squares[row, column] + np.float32(0.001) * slope * slope
                means[row, column] = mean
                squares[row, column] = square
                values[row, column] -= rates[column] * mean / (np.sqrt(square) + epsilon)
