"""Gaussians on known planes come out as mesh and cloud where they are; what one view sees is added or left out."""

from dataclasses import replace

import numpy as np
import open3d as o3d
import pytest
import torch

from sc3d.errors import InputError, Sc3dError
from sc3d.extraction.centers import center_cloud
from sc3d.extraction.evidence import EvidenceStore
from sc3d.extraction.fusion import fuse_views
from sc3d.extraction.rendered import write_rendered
from sc3d.geometry.raycast import first_surface
from sc3d.geometry.tsdf import drop_small_parts
from sc3d.io.clouds import read_mesh, write_geometry
from sc3d.io.ply import num_triangles
from sc3d.scene.labelled_cloud import read_surface
from sc3d.splatting.gaussians import Gaussians
from tests.extraction.builders import data, flat_square, surface_of, views


def test_plane_comes_out_flat_closed_and_upwards():
    surfaces = surface_of(flat_square(4.0, 0.5), data())
    points = surfaces.cloud.point.positions.numpy()
    inner = np.abs(points[:, :2]).max(axis=1) < 3.5
    assert inner.sum() > 1000 and np.abs(points[inner, 2] - 0.5).max() < 0.05
    assert surfaces.cloud.point.normals.numpy()[inner, 2].min() > 0.95
    assert np.abs(surfaces.cloud.point.colors.numpy().astype(int) - 90).max() <= 1
    cells = np.floor(points[inner, :2] / 0.3).astype(int)
    assert len(np.unique(cells, axis=0)) >= 23**2
    assert 0 < surfaces.confirmed <= 1 and surfaces.coverage >= surfaces.confirmed - 0.02


def test_completion_covers_what_only_one_view_sees():
    lonely = replace(
        data(), neighbors=[np.array([4]), np.array([4]), np.array([4]), np.array([4]), np.array([0])]
    )
    without = surface_of(flat_square(8.0, 0.0), lonely, "nothing")
    completed = surface_of(flat_square(8.0, 0.0), lonely, "continued")
    assert completed.covered > without.covered + 0.02
    assert completed.confirmed == without.confirmed and completed.occluders == without.continued == 0
    assert completed.covered - without.covered > completed.continued - 0.01  # others see it, too
    assert np.abs(completed.cloud.point.positions.numpy()[:, 2]).max() < 0.1
    assert surface_of(flat_square(8.0, 0.0), lonely).occluders < 0.001  # nothing is before the plane


def test_median_depth_sees_through_a_veil():
    """Faint discs 2 m above the middle of the ground: blended depth mixes the two, and no two views agree."""
    ground, veil = flat_square(4.0, 0.5), flat_square(1.0, 2.5)
    veil.opacity_logits[:] = -3.0
    joined = {
        name: torch.cat([values, veil.parameters()[name]]) for name, values in ground.parameters().items()
    }
    errors = {}
    for mode in ("blended", "median"):
        points = surface_of(Gaussians(**joined), data(), "nothing", mode).cloud.point.positions.numpy()
        errors[mode] = np.abs(points[np.abs(points[:, :2]).max(axis=1) < 3.5, 2] - 0.5)
    assert errors["median"].max() < 0.05 and len(errors["median"]) > 1000
    assert errors["blended"].max() > 0.2


def test_nothing_to_see_is_said():
    with pytest.raises(Sc3dError, match="no view shows a surface"):
        surface_of(flat_square(1.0, 50.0), data())


def test_centers_with_colors_and_normals_towards_the_cameras():
    gaussians = flat_square(2.0, 0.0)
    cloud = center_cloud(gaussians, np.array([view.center for view in views()]), 0.3)
    assert len(cloud.point.positions) == len(gaussians)
    assert (cloud.point.normals.numpy()[:, 2] > 0.99).all()
    assert np.abs(cloud.point.colors.numpy().astype(int) - [200, 120, 40]).max() <= 1
    with pytest.raises(Sc3dError, match="min-opacity"):
        center_cloud(gaussians, np.zeros((1, 3)), 0.99)


def test_nothing_unconfirmed_is_a_mesh_file_without_triangles(tmp_path):
    surfaces = surface_of(flat_square(4.0, 0.5), data(), "nothing")
    files = [tmp_path / "mesh.ply", tmp_path / "unconfirmed.ply"]
    for path, mesh in zip(files, (surfaces.mesh, surfaces.unconfirmed), strict=True):
        write_geometry(path, mesh)
    count = len(surfaces.mesh.triangle.indices)
    assert num_triangles(files[1:]) == 0 and num_triangles(files) == count
    with pytest.raises(InputError, match="holds no triangles"):
        read_mesh(files[1])
    points = surfaces.cloud.point.positions.numpy().astype(np.float64)
    target = read_surface(files, points, None, np.zeros(3))
    assert np.isfinite(first_surface(target, views()[0]).range).any()


@pytest.mark.parametrize("voxel_size", [0.5, 40.0])
def test_a_surface_of_loose_parts_only_is_said(tmp_path, voxel_size):
    """Small enough to be dropped, or no triangle at all."""
    store = EvidenceStore(tmp_path)
    write_rendered(flat_square(0.4, 0.0), data(), store, 1, "blended")
    with pytest.raises(Sc3dError, match="loose parts"):
        fuse_views(data(), store, voxel_size, "nothing")


def test_no_parts_of_nothing():
    empty = o3d.t.geometry.TriangleMesh(
        o3d.core.Tensor.zeros((0, 3)), o3d.core.Tensor.zeros((0, 3), o3d.core.int32)
    )
    assert not len(drop_small_parts(empty, 100).triangle.indices)
