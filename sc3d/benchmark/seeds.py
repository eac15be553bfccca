"""The stages `label` and `propagate` without their files: what `fuse` leaves for `propagate`, and the completed labels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sc3d.fusion import SCALE, Cloud, Fusion, Labels
from sc3d.propagation import build_graph, propagate
from sc3d.propagation.complete import Evidence, tie_breakers
from sc3d.settings import Propagate


@dataclass(frozen=True)
class Seeds:
    """Points as `fuse` left them and their votes (N, num_ids) float32."""

    labels: Labels
    votes: np.ndarray

    @classmethod
    def of(cls, fusion: Fusion) -> Seeds:
        return cls(fusion.labels, fusion.field.votes[fusion.cells].astype(np.float32) / SCALE)


def complete(cloud: Cloud, colors: np.ndarray | None, seeds: Seeds, settings: Propagate) -> Labels:
    """As `sc3d propagate` does it. colors: (N, 3) uint8 or None."""
    evidence = Evidence(cloud.points, seeds.labels, seeds.votes, colors)
    ties = tie_breakers(evidence, cloud.normals)
    return propagate(build_graph(cloud.points, cloud.normals, settings.num_neighbors, colors if settings.color else None, ties), evidence, settings)
