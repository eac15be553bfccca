"""What is fused of exact depth of a wall, of what stands before it and of the sky beside it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from sc3d.errors import Sc3dError
from sc3d.extraction.evidence import DepthViews, EvidenceStore, ViewEvidence
from sc3d.extraction.free_space import count_opposed
from sc3d.extraction.fusion import Surfaces, fuse_views
from sc3d.geometry.raycast import FirstSurface, Surface, first_surface
from sc3d.settings.reconstruction import Fill
from tests.extraction.builders import views

SHAPE = (120, 160)
PATCH = np.s_[40:60, 60:90]  # of the first view: what stands before the wall
VOXEL = 0.15


def quad(half: float) -> Surface:
    """The wall z = 0."""
    corners = half * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], float)
    return Surface.from_mesh(corners, np.array([[0, 1, 2], [0, 2, 3]]), np.zeros(3))


def depth_of(first: FirstSurface) -> np.ndarray:
    return np.where(np.isfinite(first.range), first.range * first.ray_z, 0).astype(np.float32)


@dataclass
class Wall:
    """The wall as five views see it; a test changes what they know, then fuses it."""

    store: EvidenceStore
    data: DepthViews
    depths: list[np.ndarray]
    images: list[np.ndarray]
    evidence: list[ViewEvidence]

    def fused(self, fill: Fill) -> Surfaces:
        for row, evidence in enumerate(self.evidence):
            self.store.write(row, evidence)
        return fuse_views(self.data, self.store, VOXEL, fill)

    def seen(self, surfaces: Surfaces, row: int) -> np.ndarray:
        meshes = [
            (mesh.vertex.positions.numpy(), mesh.triangle.indices.numpy())
            for mesh in (surfaces.mesh, surfaces.unconfirmed)
        ]
        surface = Surface.from_meshes([mesh for mesh in meshes if len(mesh[1])], np.zeros(3))
        return depth_of(first_surface(surface, self.data.views[row]))


def wall(folder: Path, half: float = 9.0) -> Wall:
    depths = [depth_of(first_surface(quad(half), view)) for view in views()]
    normals = [
        np.tile(np.round(127 * view.cam_from_world[:3, 2]).astype(np.int8), (*SHAPE, 1)) for view in views()
    ]
    images = [np.full((*SHAPE, 3), 90, np.uint8) for _ in depths]
    evidence = [
        ViewEvidence(depth.copy(), np.zeros_like(depth), normal, np.zeros(SHAPE, bool))
        for depth, normal in zip(depths, normals, strict=True)
    ]
    neighbors = [np.array([other for other in range(5) if other != row]) for row in range(5)]
    data = DepthViews(views(), lambda row: images[row], neighbors, (1.0, 30.0))
    return Wall(EvidenceStore(folder), data, depths, images, evidence)


def test_what_one_view_shows_before_the_wall_is_put_where_nobody_looks_through(tmp_path):
    scene = wall(tmp_path)
    scene.images[0][PATCH] = (20, 160, 30)
    scene.evidence[0].confirmed[PATCH] = 0
    found = scene.fused("occluders")
    seen = scene.seen(found, 0)
    before = seen < 0.9 * scene.depths[0]
    patch = np.zeros(SHAPE, bool)
    patch[PATCH] = True
    assert before[42:58, 62:88].mean() > 0.95 and not (before & ~patch)[:, :55].any()
    assert found.occluders == pytest.approx(patch.mean() / 5, rel=0.2)
    normals = np.tile(np.int8([0, 0, -127]), (*SHAPE, 1))
    depth = np.where(before & patch, seen, 0)
    known = [scene.store.read(row, "known") for row in range(1, 5)]
    opposed = count_opposed(depth, normals, scene.data.views[0], known, scene.data.views[1:])
    assert not opposed[42:58, 62:88].any()
    for row in range(1, 5):  # it hides nothing from the others
        other = scene.seen(found, row)
        gap = np.abs(other - scene.depths[row]) / 12
        assert (gap < 0.02)[4:-4, 4:-4].mean() > 0.995


def test_nothing_is_put_where_a_view_has_sky(tmp_path):
    """Though the wall behind has another color: a mask says that there is no surface."""
    scene = wall(tmp_path)
    scene.images[0][PATCH] = (20, 160, 30)
    scene.evidence[0].confirmed[PATCH] = 0
    scene.evidence[0].sky[PATCH] = True
    found = scene.fused("occluders")
    assert found.occluders == 0 and not (scene.seen(found, 0)[PATCH] < 0.9 * scene.depths[0][PATCH]).any()


@pytest.mark.parametrize("fill", ["nothing", "continued"])
def test_without_occluders_the_wall_stays_whole_behind(tmp_path, fill):
    scene = wall(tmp_path)
    scene.images[0][PATCH] = (20, 160, 30)
    scene.evidence[0].confirmed[PATCH] = 0
    found = scene.fused(fill)
    assert found.occluders == 0
    assert np.abs(scene.seen(found, 0)[PATCH] / scene.depths[0][PATCH] - 1).max() < 0.02


def test_continued_depth_that_others_look_through_is_left_out(tmp_path):
    scene = wall(tmp_path)
    scene.evidence[0].confirmed[PATCH] = 0
    plain = scene.fused("continued")
    scene.evidence[0].continued[PATCH] = 8.0  # in the air, before the wall that all others see
    found = scene.fused("continued")
    assert found.continued == pytest.approx(plain.continued, abs=1e-4)
    assert np.abs(scene.seen(found, 0)[PATCH] / scene.depths[0][PATCH] - 1).max() < 0.02


def test_continued_depth_where_nobody_looks_is_added(tmp_path):
    scene = wall(tmp_path)
    hole = np.abs(points_of(scene, 0)[..., :2]).max(axis=2) < 1
    for row, evidence in enumerate(scene.evidence):
        evidence.confirmed[np.abs(points_of(scene, row)[..., :2]).max(axis=2) < 1] = 0
    scene.evidence[0].continued[hole] = scene.depths[0][hole]
    without, found = scene.fused("nothing"), scene.fused("continued")
    assert not scene.seen(without, 0)[hole].all()
    np.testing.assert_allclose(scene.seen(found, 0)[hole], scene.depths[0][hole], rtol=0.02)
    assert found.confirmed == without.confirmed and found.continued > 0.001
    points, flags = found.cloud.point.positions.numpy(), found.cloud.point.unconfirmed.numpy().ravel()
    inside = np.abs(points[:, :2]).max(axis=1) < 1
    assert flags[inside].all() and not flags[~inside & (np.abs(points[:, :2]).max(axis=1) > 1.2)].any()
    middles = found.mesh.vertex.positions.numpy()[found.mesh.triangle.indices.numpy()].mean(axis=1)
    assert (np.abs(middles[:, :2]).max(axis=1) < 0.8).mean() < 0.001  # the mesh has the hole


def points_of(scene: Wall, row: int) -> np.ndarray:
    """(H, W, 3) points of the wall that a view sees."""
    view = scene.data.views[row]
    columns, rows = np.meshgrid(np.arange(160) + 0.5, np.arange(120) + 0.5)
    rays_cam = np.stack([columns, rows, np.ones(SHAPE)], axis=2) @ np.linalg.inv(view.matrix).T
    return (rays_cam * scene.depths[row][..., None] - view.cam_from_world[:3, 3]) @ view.cam_from_world[
        :3, :3
    ]


def test_sky_never_becomes_a_surface_and_what_is_no_sky_may(tmp_path):
    """A wall of 8 x 8 with nothing around it in any photo."""
    for folder, sky in (("sky", True), ("unknown", False)):
        (tmp_path / folder).mkdir()
        scene = wall(tmp_path / folder, half=4.0)
        for row, depth in enumerate(scene.depths):
            scene.images[row][depth == 0] = 250
            scene.evidence[row].sky[:] = sky & (depth == 0)
        found = scene.fused("occluders")
        beside = [
            far_from(depth > 0) & (scene.seen(found, row) > 0) for row, depth in enumerate(scene.depths)
        ]
        assert found.sky == (np.mean([depth == 0 for depth in scene.depths]) if sky else 0)
        assert not np.any(beside) if sky else found.occluders >= 0
        total = found.confirmed + found.continued + found.occluders
        assert found.coverage == pytest.approx(total, abs=0.02)
        assert found.confirmed + found.sky <= 1
    assert found.confirmed == pytest.approx(np.mean([depth > 0 for depth in scene.depths]))


def far_from(mask: np.ndarray, reach: int = 4) -> np.ndarray:
    import cv2

    return cv2.dilate(mask.astype(np.uint8), np.ones((2 * reach + 1,) * 2, np.uint8)) == 0


def test_photos_with_little_confirmed_depth_are_named_and_without_any_nothing_is_fused(tmp_path, caplog):
    scene = wall(tmp_path)
    scene.evidence[1].confirmed[:] = 0
    scene.evidence[3].confirmed[:] = 100.0  # out of range: Open3D finds no block
    scene.evidence[4].confirmed[5:] = 0
    found = scene.fused("nothing")
    assert "3 of 5 photos have under 5% confirmed depth: 1.jpg, 3.jpg, 4.jpg" in caplog.text
    fused = [scene.depths[0] > 0, scene.depths[2] > 0, scene.depths[4][:5] > 0]
    assert found.confirmed == pytest.approx(sum(each.sum() for each in fused) / (5 * 120 * 160))
    for evidence in scene.evidence:
        evidence.confirmed[:] = 0
    with pytest.raises(Sc3dError, match="no depth is confirmed"):
        scene.fused("occluders")


def test_triangles_are_those_that_are_hit_and_where():
    view = views()[0]
    rows, uv, hit = quad(3.0).triangles(view)
    first = first_surface(quad(3.0), view)
    np.testing.assert_array_equal(hit, first.depth)
    np.testing.assert_array_equal(rows >= 0, np.isfinite(first.range))
    assert set(np.unique(rows)) == {-1, 0, 1}
    corners = 3.0 * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], float)
    triangles = corners[np.array([[0, 1, 2], [0, 2, 3]])[np.maximum(rows, 0)]]
    weights = np.concatenate([1 - uv.sum(axis=2, keepdims=True), uv], axis=2)
    points = (triangles * weights[..., None]).sum(axis=2)
    depth = (points @ view.cam_from_world[:3, :3].T + view.cam_from_world[:3, 3])[..., 2]
    np.testing.assert_allclose(depth[rows >= 0], depth_of(first)[rows >= 0], rtol=1e-4)
