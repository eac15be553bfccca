"""Trains a small scene and prints a digest of all that came out: for processes with different numbers of threads.

python -m tests.splatting.train_with_threads STEPS EXPOSURE
"""

import hashlib
import sys

import numpy as np
import torch

from sc3d.geometry.cameras import look_at, pinhole_view
from sc3d.settings.train import Exposure, TrainSettings
from sc3d.splatting.trainer import Trainer
from tests.splatting.scenes import photographed, valley

SIZE = (288, 192)  # torch splits tensors of more than 32768 numbers


def main(steps: int, exposure: Exposure) -> None:
    centers = [np.array([4 * np.cos(angle), 3 * np.sin(angle), 9.5]) for angle in np.arange(4) * np.pi / 2]
    views = [
        pinhole_view(f"{row}.png", SIZE, (270.0, 270.0, 150.0, 93.0), look_at(center, center * [0.2, 0, 0]))
        for row, center in enumerate(centers)
    ]
    data, _, _ = photographed(views, valley(), 1.5, 0.01, 36_000)
    trainer = Trainer(
        data, TrainSettings(iterations=steps, device="cpu", surface_from=0.3, exposure=exposure)
    )
    while trainer.iteration < steps:
        trainer.step()
    log = [{name: value for name, value in row.items() if name != "seconds"} for row in trainer.log]
    state = hashlib.sha256(repr(log).encode())
    for values in [*trainer.gaussians.parameters().values(), trainer.exposures]:
        state.update(values.detach().numpy().tobytes())
    print(torch.get_num_threads(), len(trainer.gaussians), state.hexdigest())


if __name__ == "__main__":
    main(int(sys.argv[1]), sys.argv[2])
