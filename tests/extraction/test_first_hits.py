"""Surface that is added bit by bit is met as if it had been there at once."""

import numpy as np
import open3d as o3d
import pytest

from sc3d.extraction.evidence import EvidenceStore
from sc3d.extraction.first_hits import FirstHits, surface_of
from sc3d.geometry.raycast import first_surface
from sc3d.geometry.tsdf import Part
from tests.extraction.builders import data


def part(height: float, half: float, shift: float = 0.0) -> Part:
    """A slanted square."""
    corners = half * np.array([[-1, -1, 0.1], [1, -1, 0], [1, 1, 0.2], [-1, 1, 0]])
    positions = (corners + [shift, 0, height]).astype(np.float32)
    mesh = o3d.t.geometry.TriangleMesh(
        o3d.core.Tensor(positions), o3d.core.Tensor(np.array([[0, 1, 2], [0, 2, 3]], np.int32))
    )
    return mesh, o3d.t.geometry.PointCloud(o3d.core.Tensor(positions))


def nothing() -> Part:
    mesh = o3d.t.geometry.TriangleMesh(
        o3d.core.Tensor.zeros((0, 3)), o3d.core.Tensor.zeros((0, 3), o3d.core.int32)
    )
    return mesh, o3d.t.geometry.PointCloud(o3d.core.Tensor.zeros((0, 3)))


@pytest.mark.parametrize("when", [1, 3, 4])  # a view may look after each addition, or late
def test_hits_are_those_of_all_surface_so_far(tmp_path, when):
    views, store = data(), EvidenceStore(tmp_path)
    ground, rounds = part(0.0, 4.0), [[part(1.0, 1.0, -1.0), nothing()], [nothing()], [part(0.5, 2.0)]]
    for row, view in enumerate(views.views):
        store.save(row, "hit", first_surface(surface_of([ground]), view).depth)
    hits, so_far = FirstHits(views, store), [ground]
    for number, added in enumerate(rounds, 1):
        hits.add(added)
        so_far += added
        if number % when == 0:
            for row, view in enumerate(views.views):
                expected = first_surface(surface_of(so_far), view).depth
                assert np.array_equal(hits.depth(row), expected)
    expected = first_surface(surface_of(so_far), views.views[0]).depth
    assert (
        np.isfinite(expected) & (expected < first_surface(surface_of([ground]), views.views[0]).depth)
    ).any()
    for _ in range(2):
        assert np.array_equal(hits.depth(0), expected)
