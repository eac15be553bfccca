"""Sums in an order that does not depend on the number of threads: torch cuts a sum of everything into as many parts
as it has threads, but gives each row of a table to one thread.
"""

from __future__ import annotations

import torch

ROW = 1024  # summed by one thread; up to this many rows, so are their sums


def steady_mean(values: torch.Tensor) -> torch.Tensor:
    """The mean of a tensor of any shape, differentiable: a scalar, NaN if it is empty."""
    return steady_sum(values) / values.numel()


def steady_sum(values: torch.Tensor) -> torch.Tensor:
    """The sum of a tensor of any shape, differentiable: a scalar."""
    flat = values.reshape(-1)
    while flat.numel() > ROW:
        whole = flat.numel() // ROW * ROW
        flat = torch.cat([flat[:whole].reshape(-1, ROW).sum(1), flat[whole:]])
    return flat.sum()


def per_row(value: torch.Tensor, table: torch.Tensor) -> torch.Tensor:
    """A scalar for each row of a table, shaped to be multiplied with it or added to it: its gradient is summed row
    by row.
    """
    return value.expand(len(table)).reshape(-1, *(1 for _ in table.shape[1:]))
