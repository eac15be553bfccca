"""The geometry utilities alone, without scene folder, classes or photos: what a camera sees of a box on a block.

    python data/manual/examples/03_geometry_utilities.py

Cameras and rays, the first surface, normals, curvature, a sparse voxel grid; more in `geometry-by-example.md`.
"""

import numpy as np
import open3d as o3d
import pycolmap

from sc3d.geometry.cameras import View, look_at, project, rays
from sc3d.geometry.neighbors import NeighborIndex, curvature, estimate_normals, orient_normals
from sc3d.geometry.raycast import Surface, first_surface, see_points
from sc3d.geometry.voxels import LabelGrid, sort_by_voxel


def main() -> tuple[np.ndarray, ...]:
    # a box of 4 x 4 x 3 m on a block of 20 x 20 m, far from the world's zero, as in UTM
    origin = np.array([500_000.0, 5_200_000.0, 100.0])
    mesh = o3d.geometry.TriangleMesh.create_box(20, 20, 2).translate((-10, -10, -2))
    mesh += o3d.geometry.TriangleMesh.create_box(4, 4, 3).translate((-2, -2, 0))
    o3d.utility.random.seed(0)
    local = np.asarray(mesh.sample_points_uniformly(60_000).points)
    points = local + origin

    # a camera with lens distortion looks at it from the side; rays and projection undo one another
    lens = pycolmap.Camera(model="RADIAL", width=400, height=300, params=[350, 200, 150, -0.05, 0.01])
    view = View("photo.jpg", lens, look_at(origin + [0.0, -14.0, 8.0], origin))
    pixels = np.array([[10.5, 20.5], [200.0, 150.0]])
    again, _ = project(view, view.center + 12.0 * rays(view, pixels)[0])
    print(f"pixel {pixels[0]} -> ray -> pixel {again[0].round(6)}")
    assert np.abs(again - pixels).max() < 1e-6

    # the first surface hides what lies behind the box
    surface = Surface.from_mesh(np.asarray(mesh.vertices) + origin, np.asarray(mesh.triangles), origin)
    seen = see_points(view, points, None, first_surface(surface, view), voxel_size=0.05).points
    behind = (np.abs(local - [0, 2.6, 0]) < [1, 0.5, 0.1]).all(axis=1)
    print(f"{len(seen)} points are seen, {behind[seen].sum()} of {behind.sum()} behind the box")
    assert behind.sum() > 50 and not behind[seen].any()

    # normals (eq. 5) and curvature (eq. 6): flat faces have none, edges have some
    neighbors, _ = NeighborIndex(points).nearest(points, 16)
    normals = orient_normals(points, estimate_normals(points, neighbors), view.center[None])
    bend = curvature(normals, neighbors)
    rim = (np.abs(local[:, 2] - 3) < 0.05) & (np.abs(local[:, :2]).max(axis=1) > 1.95)
    print(f"median curvature {np.median(bend):.4f}, at the upper rim of the box {np.median(bend[rim]):.4f}")
    assert np.median(bend) < 0.01 < 0.1 < np.median(bend[rim])

    # a sparse grid of whole numbers: points per voxel of half a meter
    grid = LabelGrid.from_voxels(sort_by_voxel(points, voxel_size=0.5), num_channels=1)
    grid.add(grid.find(points), np.ones((len(points), 1), np.int32))
    print(f"{(grid.votes[:, 0] > 0).sum()} voxels of 0.5 m hold points, {grid.votes[:, 0].max()} at most")
    assert grid.votes[:, 0].sum() == len(points) and grid.find(view.center[None])[0] == -1
    return points, seen, bend


if __name__ == "__main__":
    main()
