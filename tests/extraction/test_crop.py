"""Which views see a point, against rays and a roof worked out by hand; and the surface cropped to that."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import open3d as o3d
import pytest

from sc3d.errors import InputError, Sc3dError
from sc3d.extraction.crop import count_views, cropped
from sc3d.extraction.evidence import EvidenceStore
from sc3d.geometry.raycast import Surface
from sc3d.settings.reconstruction import Extract
from tests.extraction.builders import data, flat_square, surface_of

ROOF, HALF = 3.0, 1.0  # height and half width of a square above the ground
BORDER = 0.3  # around shadows and image borders, where a pixel decides


def square(half: float, height: float, cells: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and triangles, facing up."""
    x, y = np.meshgrid(np.linspace(-half, half, cells + 1), np.linspace(-half, half, cells + 1))
    vertices = np.stack([x.ravel(), y.ravel(), np.full(x.size, height)], axis=1)
    first = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).ravel()[:, None]
    lower, upper = first + [0, 1, cells + 2], first + [0, cells + 2, cells + 1]
    return vertices, np.concatenate([lower, upper])


def site() -> tuple[np.ndarray, np.ndarray]:
    """Ground of 16 by 16 with the roof above its middle."""
    (ground, low), (roof, high) = square(8.0, 0.0, 64), square(HALF, ROOF, 8)
    return np.concatenate([ground, roof]), np.concatenate([low, high + len(ground)])


def seen_by_hand(view, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(N,) bool: in the image and not below the roof; (N,) bool: clear of both borders."""
    local = points @ view.cam_from_world[:3, :3].T + view.cam_from_world[:3, 3]
    pixels = (local @ view.matrix.T)[:, :2] / local[:, 2:]
    beside = np.abs(pixels - [80, 60]) - [80, 60]
    share = (ROOF - points[:, 2]) / (view.center[2] - points[:, 2])
    crossing = points + share[:, None] * (view.center - points)
    under = (points[:, 2] < ROOF - 0.5) & (np.abs(crossing[:, :2]).max(axis=1) < HALF)
    clear = (np.abs(beside).min(axis=1) > 1.5) & (
        (np.abs(np.abs(crossing[:, :2]).max(axis=1) - HALF) > BORDER) | (points[:, 2] > ROOF - 0.5)
    )
    return (beside < 0).all(axis=1) & ~under, clear


@pytest.fixture
def store(tmp_path) -> EvidenceStore:
    found = EvidenceStore(tmp_path)
    for row in range(5):
        found.save(row, "sky", np.zeros((120, 160), bool))
    return found


def middles(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    return vertices[triangles].mean(axis=1)


def points_on_site() -> tuple[np.ndarray, np.ndarray, Surface]:
    """The middles of the triangles, their normals, and the surface."""
    vertices, triangles = site()
    points = middles(vertices, triangles)
    up = np.tile([0.0, 0.0, 1.0], (len(points), 1))
    return points, up, Surface.from_mesh(vertices, triangles, np.zeros(3))


def test_views_that_see_a_point_are_counted(store):
    points, up, surface = points_on_site()
    counts = count_views(data(), store, surface, points, up, 0.1)
    found = [seen_by_hand(view, points) for view in data().views]
    clear = np.all([clear for _, clear in found], axis=0)
    expected = np.sum([seen for seen, _ in found], axis=0)
    assert clear.sum() > 2000 and len(np.unique(expected[clear])) == 6
    np.testing.assert_array_equal(counts[clear], expected[clear])
    assert count_views(data(), store, surface, points, -up, 0.1).max() == 0  # from behind


def test_pixels_of_sky_and_transparent_ones_see_nothing(store):
    points, up, surface = points_on_site()
    whole = count_views(data(), store, surface, points, up, 0.1)
    store.save(2, "sky", np.ones((120, 160), bool))
    clear = replace(data(), opaque=lambda row: np.full((120, 160), row != 4) if row > 2 else None)
    fewer = count_views(clear, store, surface, points, up, 0.1)
    seen, certain = zip(*(seen_by_hand(data().views[row], points) for row in (2, 4)), strict=True)
    certain = certain[0] & certain[1]
    np.testing.assert_array_equal((whole - fewer)[certain], (seen[0].astype(int) + seen[1])[certain])


def test_mesh_and_cloud_are_cropped_and_the_area_is_told(store):
    vertices, triangles = site()
    mesh = o3d.t.geometry.TriangleMesh(
        o3d.core.Tensor(vertices.astype(np.float32)), o3d.core.Tensor(triangles.astype(np.int32))
    )
    cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor(vertices.astype(np.float32)))
    cloud.point.normals = o3d.core.Tensor(np.tile(np.float32([0, 0, 1]), (len(vertices), 1)))
    surface, points = Surface.from_mesh(vertices, triangles, np.zeros(3)), middles(vertices, triangles)
    up = np.tile([0.0, 0.0, 1.0], (len(points), 1))
    kept = count_views(data(), store, surface, points, up, 0.1) >= 3
    nothing = (mesh.select_faces_by_mask(o3d.core.Tensor(np.zeros(len(triangles), bool))), cloud)
    ((small, fewer), (none, _)), share = cropped(((mesh, cloud), nothing), surface, data(), store, 0.1, 3)
    assert not len(none.triangle.indices)
    np.testing.assert_allclose(
        middles(small.vertex.positions.numpy(), small.triangle.indices.numpy()), points[kept], atol=1e-5
    )
    assert share == pytest.approx(1 - kept.mean(), rel=1e-5) and 0.2 < share < 0.9  # all of one size
    up = np.tile([0.0, 0.0, 1.0], (len(vertices), 1))
    counts = count_views(data(), store, surface, vertices, up, 0.1)
    np.testing.assert_array_equal(fewer.point.positions.numpy(), np.float32(vertices)[counts >= 3])
    with pytest.raises(Sc3dError, match="lower --crop"):
        cropped(((mesh, cloud), nothing), surface, data(), store, 0.1, 6)


def test_extracted_surface_is_what_three_views_see():
    ground = flat_square(6.0, 0.0)
    whole, small = (surface_of(ground, data(), "nothing", crop=number) for number in (0, 3))
    points = whole.cloud.point.positions.numpy().astype(np.float64)
    kept = small.cloud.point.positions.numpy().astype(np.float64)
    assert views_in_sight(kept).min() >= 3
    assert len(points) > len(kept) >= (views_in_sight(points, inside=3.0) >= 3).sum() > 1000
    assert whole.cropped == 0 < small.cropped < 1 and small.coverage < whole.coverage


def views_in_sight(points: np.ndarray, inside: float = -3.0) -> np.ndarray:
    """(N,) views in whose image a point of flat ground lies, `inside` px from its border."""
    counts = np.zeros(len(points), int)
    for view in data().views:
        local = points @ view.cam_from_world[:3, :3].T + view.cam_from_world[:3, 3]
        pixels = (local @ view.matrix.T)[:, :2] / local[:, 2:]
        counts += ((pixels > inside) & (pixels < [160 - inside, 120 - inside])).all(axis=1)
    return counts


def test_crop_that_cannot_be_is_refused():
    with pytest.raises(InputError, match="crop must be"):
        Extract(crop=-1)
    with pytest.raises(InputError, match="--from tsdf or depth"):
        Extract(method="centers", crop=3)
