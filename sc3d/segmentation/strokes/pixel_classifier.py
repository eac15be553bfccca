"""A classifier of feature vectors: small neural networks and randomized trees, which err in different places,
trained crosswise.

Strokes are dealt out to as many folds as there are members; each member learns from all folds but its own. So
every stroke is judged by a member that has not seen it, which is what calibration needs, and all members
together have seen all strokes.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from sklearn.ensemble import ExtraTreesClassifier

from sc3d.segmentation.strokes.forest import Forest

_PIXELS_AT_ONCE = 1 << 17  # pixels at once
_BATCH = 512
_RATE = 6e-3  # peak of the learning rate
# temperature; strokes lie where it is easy, so that all may be right and still say nothing of edges
_SHARPEST = 0.4
# the networks see features within these quantiles of the strokes: far outside, they would be sure of anything
_CLIP = 0.05


@dataclass(frozen=True)
class Samples:
    """Pixels under strokes. features: (N, F) float32; codes: (N,) int64 0 to num_codes - 1, all present;
    folds: (N,) int64, -1 = in every training set.
    """

    features: np.ndarray
    codes: np.ndarray
    folds: np.ndarray


@dataclass(frozen=True)
class Member:
    """One network and one forest, which learned from the same pixels."""

    network: torch.nn.Module
    forest: Forest

    NUM_PARAMETERS: ClassVar[int] = 6  # arrays of a network

    def parameters(self) -> list[np.ndarray]:
        """Weights and offsets of the network's layers."""
        return [values.detach().numpy() for values in self.network.parameters()]

    @classmethod
    def from_parameters(
        cls, num_features: int, num_codes: int, layers: list[np.ndarray], forest: Forest
    ) -> Member:
        """The opposite of `parameters`; ValueError for arrays of other shapes."""
        network = _network(num_features, num_codes)
        for given, values in zip(network.parameters(), layers, strict=True):
            if tuple(given.shape) != values.shape or not np.isfinite(values).all():
                raise ValueError("layers")
            given.data = torch.from_numpy(np.ascontiguousarray(values, np.float32))
        return cls(network.eval(), forest)


@dataclass(frozen=True)
class PixelClassifier:
    """The members, and how features are scaled for the networks. low, high, center, scale: (F,) float32."""

    members: tuple[Member, ...]
    low: np.ndarray
    high: np.ndarray
    center: np.ndarray
    scale: np.ndarray

    def probabilities(self, features: np.ndarray, member: int | None = None) -> np.ndarray:
        """Probability of each code, by all members or by one.

        features: (..., F) float32
        returns: (..., num_codes) float32, sums to 1
        """
        rows = features.reshape(-1, features.shape[-1])
        members = self.members if member is None else self.members[member : member + 1]
        found = [
            self._classify(rows[start : start + _PIXELS_AT_ONCE], members)
            for start in range(0, len(rows), _PIXELS_AT_ONCE)
        ]
        return np.concatenate(found).reshape(*features.shape[:-1], -1)

    def _classify(self, rows: np.ndarray, members: tuple[Member, ...]) -> np.ndarray:
        scaled = torch.from_numpy((np.clip(rows, self.low, self.high) - self.center) / self.scale)
        with torch.inference_mode():
            by_networks = sum(member.network(scaled).softmax(dim=1) for member in members).numpy()
        by_forests = sum(member.forest.probabilities(rows) for member in members)
        return (by_networks + by_forests) / (2 * len(members))


def train(samples: Samples, num_members: int, num_trees: int, num_steps: int, seed: int) -> PixelClassifier:
    """Train all members; the result depends on the samples and the seed alone.

    num_trees: of all members together; num_steps: of gradient descent, per member
    """
    low, high = (
        np.quantile(samples.features, share, axis=0).astype(np.float32) for share in (_CLIP, 1 - _CLIP)
    )
    clipped = np.clip(samples.features, low, high)
    center, scale = clipped.mean(axis=0), clipped.std(axis=0) + 1e-3
    scaled, members = (clipped - center) / scale, []
    for index in range(num_members):
        used = samples.folds != index
        codes = samples.codes[used]
        # rare classes count more, but not as much as frequent ones
        weights = (1 / np.sqrt(np.bincount(codes)))[codes]
        network = _train_network(scaled[used], codes, weights, num_steps, seed + index)
        forest = ExtraTreesClassifier(
            max(1, num_trees // num_members),
            min_samples_leaf=5,
            max_features="sqrt",
            random_state=seed + index,
        )
        grown = Forest.from_sklearn(forest.fit(samples.features[used], codes, weights))
        members.append(Member(network, grown))
    return PixelClassifier(tuple(members), low, high, center, scale)


def _train_network(
    scaled: np.ndarray, codes: np.ndarray, weights: np.ndarray, num_steps: int, seed: int
) -> torch.nn.Module:
    """Two hidden layers; batches are drawn by weight."""
    with _one_thread(), torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = _network(scaled.shape[1], int(codes.max()) + 1)
        optimizer = torch.optim.AdamW(network.parameters(), _RATE, weight_decay=1e-2)
        schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, _RATE, num_steps)
        inputs, targets = torch.from_numpy(scaled), torch.from_numpy(codes)
        batches = torch.multinomial(torch.from_numpy(weights), num_steps * _BATCH, replacement=True).view(
            num_steps, _BATCH
        )
        for batch in batches:
            optimizer.zero_grad()
            torch.nn.functional.cross_entropy(
                network(inputs[batch]), targets[batch], label_smoothing=0.02
            ).backward()
            optimizer.step()
            schedule.step()
    return network.eval()


def _network(num_features: int, num_codes: int, width: int = 64) -> torch.nn.Module:
    layers = []
    for inputs in (num_features, width):
        layers += [torch.nn.Linear(inputs, width), torch.nn.ReLU(), torch.nn.Dropout(0.1)]
    return torch.nn.Sequential(*layers, torch.nn.Linear(width, num_codes))


@contextmanager
def _one_thread() -> Iterator[None]:
    """Sums over a batch must not depend on the number of threads, and threads do not pay for matrices this
    small.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def best_temperature(probabilities: np.ndarray, codes: np.ndarray) -> float:
    """The exponent's inverse T for which p ** (1 / T), normalized, describes (N, C) probabilities of known
    (N,) codes best; 1 if there are none.

    Source: Guo et al., "On calibration of modern neural networks" (2017).
    """
    if not len(codes):
        return 1.0
    logarithms, rows = np.log(np.maximum(probabilities.astype(np.float64), 1e-6)), np.arange(len(codes))

    def loss(temperature: float) -> float:
        scaled = logarithms / temperature
        return float(
            (
                np.log(np.exp(scaled - scaled.max(axis=1, keepdims=True)).sum(axis=1))
                + scaled.max(axis=1)
                - scaled[rows, codes]
            ).mean()
        )

    candidates = np.geomspace(_SHARPEST, 5, 65)
    return float(candidates[np.argmin([loss(candidate) for candidate in candidates])])
