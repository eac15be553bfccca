"""Training gives the same bytes whatever the number of threads."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from sc3d.splatting import losses
from sc3d.splatting.cpu.steady_sums import steady_mean, steady_sum

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize("shape", [(1,), (7, 3), (1024,), (1025,), (300, 500, 3)])
def test_sums_and_their_gradients_are_right(shape):
    values = torch.rand(shape, generator=torch.Generator().manual_seed(0), requires_grad=True)
    assert steady_sum(values).item() == pytest.approx(values.double().sum().item(), rel=1e-6)
    mean = steady_mean(values)
    assert mean.item() == pytest.approx(values.double().mean().item(), rel=1e-6)
    mean.backward()
    torch.testing.assert_close(values.grad, torch.full(shape, 1 / values.numel()))


def test_nothing_has_no_mean():
    assert steady_mean(torch.empty(0)).isnan() and steady_sum(torch.empty(0)) == 0


@pytest.mark.parametrize("planes", [False, True])
@pytest.mark.parametrize("exposure", [[0.1, -0.02], [0.05 * number - 0.3 for number in range(12)]])
def test_sums_and_exposures_do_not_depend_on_threads(planes, exposure):
    generator = torch.Generator().manual_seed(1)
    image = torch.rand(3, 400, 300, generator=generator).permute(1, 2, 0)
    image, found, before = image if planes else image.contiguous(), [], torch.get_num_threads()
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            leaf = torch.tensor(exposure, requires_grad=True)
            (losses.apply_exposure(image, leaf) * image.flip(0)).sum().backward()
            found.append([*leaf.grad.tolist(), steady_sum(image).item()])
    finally:
        torch.set_num_threads(before)
    assert found[0] == found[1] == found[2]


@pytest.mark.parametrize("exposure", ["gain", "affine"])
def test_one_and_two_threads_train_the_same_bytes(exposure):
    told = []
    for threads in ("1", "2"):
        found = subprocess.run(
            [sys.executable, "-m", "tests.splatting.train_with_threads", "6", exposure],
            cwd=ROOT,
            env=os.environ | {"OMP_NUM_THREADS": threads, "NUMBA_NUM_THREADS": threads},
            capture_output=True,
            text=True,
            check=True,
        )
        told.append(found.stdout.split())
    assert [words[0] for words in told] == ["1", "2"] and told[0][1:] == told[1][1:]
