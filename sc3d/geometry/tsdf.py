"""Depth maps to a surface: a truncated signed distance field (TSDF) on Open3D's `VoxelBlockGrid`, then mesh
and cloud.
"""

from __future__ import annotations

import numba
import numpy as np
import open3d as o3d
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from sc3d.geometry.cameras import View

BLOCK = 8
TRUNCATION = 4.0  # voxels
SLANTED = 1.5  # largest ratio of depths within the quadrilateral of a pixel
CPU = o3d.core.Device("CPU:0")
QUERIES_AT_ONCE = 100_000  # points per call, which lets nothing else run: lines of progress come in between

Part = tuple[o3d.t.geometry.TriangleMesh, o3d.t.geometry.PointCloud]  # a surface, as mesh and as cloud


class DepthFusion:
    """Fuses float32 depth maps of pinhole views. The views' world must be local (float32-safe); `voxel_size`
    in its units.
    """

    def __init__(self, voxel_size: float, block_count: int = 50_000) -> None:
        self.voxel_size = voxel_size
        self._grid = o3d.t.geometry.VoxelBlockGrid(
            ("tsdf", "weight", "color"),
            (o3d.core.float32,) * 3,
            ((1,), (1,), (3,)),
            voxel_size,
            BLOCK,
            block_count,
            CPU,
        )

    def integrate(self, view: View, depth: np.ndarray, color: np.ndarray, depth_max: float) -> bool:
        """Add one view; returns whether it adds anything: Open3D finds the blocks that a view touches by a
        sample of its pixels, so a view with a depth in range at a few only may add nothing.

        depth: (H, W) float32 z, world units, 0 = no surface known; color: (H, W, 3) uint8 RGB; depth_max:
            farther depths are ignored
        """
        if not view.camera.is_undistorted():
            raise ValueError("depth fusion needs a pinhole view: use cameras.undistorted")
        if not ((depth > 0) & (depth < depth_max)).any():
            return False
        matrix = view.matrix.copy()
        matrix[:2, 2] -= 0.5  # Open3D counts pixel centers as whole numbers
        intrinsic, extrinsic = o3d.core.Tensor(matrix), o3d.core.Tensor(view.cam_from_world)
        depth_image = o3d.t.geometry.Image(
            o3d.core.Tensor(np.ascontiguousarray(depth, np.float32)[..., None])
        )
        color_image = o3d.t.geometry.Image(
            o3d.core.Tensor(np.ascontiguousarray(color, np.float32) / np.float32(255))
        )
        try:
            blocks = self._grid.compute_unique_block_coordinates(
                depth_image, intrinsic, extrinsic, 1.0, depth_max, TRUNCATION
            )
        except RuntimeError as error:
            if "No block is touched" not in str(error):
                raise
            return False
        self._grid.integrate(
            blocks, depth_image, color_image, intrinsic, extrinsic, 1.0, depth_max, TRUNCATION
        )
        return True

    def mesh(self, min_weight: float = 0.5) -> o3d.t.geometry.TriangleMesh:
        """Triangles of the zero level set seen by more than `min_weight` views."""
        if not self._grid.hashmap().size():
            return o3d.t.geometry.TriangleMesh(
                o3d.core.Tensor.zeros((0, 3)), o3d.core.Tensor.zeros((0, 3), o3d.core.int32)
            )
        mesh = self._grid.extract_triangle_mesh(min_weight)
        if "colors" in mesh.vertex:  # interpolation overshoots a little
            mesh.vertex.colors = mesh.vertex.colors.clip(0, 1)
        return mesh_in_order(mesh)

    def cloud(self, min_weight: float = 0.5) -> o3d.t.geometry.PointCloud:
        """Points where the zero level set crosses the grid's edges: positions, colors uint8, unit normals out
        of the surface.
        """
        if not self._grid.hashmap().size():
            return o3d.t.geometry.PointCloud(o3d.core.Tensor.zeros((0, 3)))
        cloud = self._grid.extract_point_cloud(min_weight)
        if "colors" in cloud.point:
            colors = np.clip(np.round(cloud.point.colors.numpy() * 255), 0, 255).astype(np.uint8)
            cloud.point.colors = o3d.core.Tensor(colors)
        if "normals" in cloud.point:
            normals = cloud.point.normals.numpy()
            cloud.point.normals = o3d.core.Tensor(
                normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12).astype(np.float32)
            )
        return cloud_in_order(cloud)


def cloud_in_order(cloud: o3d.t.geometry.PointCloud) -> o3d.t.geometry.PointCloud:
    """The same points ordered by z, y, x: Open3D's hash maps return them in an order that depends on the
    threads.
    """
    return cloud.select_by_index(o3d.core.Tensor(np.lexsort(cloud.point.positions.numpy().T)))


def mesh_in_order(mesh: o3d.t.geometry.TriangleMesh) -> o3d.t.geometry.TriangleMesh:
    """The same for a mesh: vertices by z, y, x, triangles by their vertices, each from its first one on in
    the sense that it had.
    """
    order = np.lexsort(mesh.vertex.positions.numpy().T)
    place = np.empty(len(order), np.int64)
    place[order] = np.arange(len(order))
    triangles = place[mesh.triangle.indices.numpy()]
    first = triangles.argmin(axis=1)[:, None]
    triangles = np.take_along_axis(triangles, (first + [0, 1, 2]) % 3, axis=1)
    sorted_mesh = o3d.t.geometry.TriangleMesh()
    for name, values in mesh.vertex.items():
        sorted_mesh.vertex[name] = o3d.core.Tensor(np.ascontiguousarray(values.numpy()[order]))
    sorted_mesh.triangle.indices = o3d.core.Tensor(np.ascontiguousarray(triangles[np.lexsort(triangles.T)]))
    return sorted_mesh


def pixel_squares(
    view: View, depth: np.ndarray, color: np.ndarray, wanted: np.ndarray, normals: np.ndarray | None = None
) -> Part:
    """The surface that a single depth map shows, where nothing better is known: a quadrilateral over each
    pixel.

    Quadrilaterals, not a connected sheet: between leaves, a sheet would hang in the air along the view's rays
    and hide things from other views. They overlap a little, so that other views do not look between them.

    view: pinhole; depth: (H, W) z, world units, 0 = none; color: (H, W, 3) uint8; wanted: (H, W) bool
    normals: (H, W, 3) any numbers, of any length, camera frame, of the surface in which each lies; 0 or None:
        it faces the camera
    returns: mesh with vertex colors and normals, and cloud of the middles with colors uint8 and normals; both
        may be empty
    """
    rows, columns = np.nonzero(wanted & (depth > 0))
    z, rotation = depth[rows, columns].astype(np.float64)[:, None], view.cam_from_world[:3, :3]
    pixels = np.stack([columns + 0.5, rows + 0.5, np.ones(len(rows))], axis=1)
    corners = pixels[:, None] + 0.75 * np.array([[-1, -1, 0], [-1, 1, 0], [1, 1, 0], [1, -1, 0]])
    inverse = np.linalg.inv(view.matrix).T
    rays_cam, corners_cam = pixels @ inverse, corners @ inverse
    facing = np.array([0.0, 0.0, -1.0])
    n = np.tile(facing, (len(rows), 1)) if normals is None else normals[rows, columns].astype(np.float64)
    length = np.linalg.norm(n, axis=1, keepdims=True)
    n = np.where(length > 0, n / np.maximum(length, 1e-12), facing)
    across = np.einsum("pk,pck->pc", n, corners_cam)
    ratio = (n * rays_cam).sum(axis=1, keepdims=True) / np.where(across < -1e-9, across, -1e-9)
    ratio = np.clip(ratio, 1 / SLANTED, SLANTED)
    start = view.cam_from_world[:3, 3]
    points = (rays_cam * z - start) @ rotation
    vertices = (corners_cam * (ratio * z)[..., None] - start) @ rotation
    base = 4 * np.arange(len(points))[:, None]
    triangles = np.concatenate([base + [[0, 1, 2]], base + [[0, 2, 3]]], axis=1).reshape(-1, 3)
    normal = (n @ rotation).astype(np.float32)
    mesh = o3d.t.geometry.TriangleMesh(
        o3d.core.Tensor(vertices.reshape(-1, 3).astype(np.float32)),
        o3d.core.Tensor(triangles.astype(np.int32)),
    )
    mesh.vertex.normals = o3d.core.Tensor(np.repeat(normal, 4, axis=0))
    mesh.vertex.colors = o3d.core.Tensor(
        np.repeat(color[rows, columns].astype(np.float32) / np.float32(255), 4, axis=0)
    )
    cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor(points.astype(np.float32)))
    cloud.point.normals = o3d.core.Tensor(normal)
    cloud.point.colors = o3d.core.Tensor(color[rows, columns])
    return mesh, cloud


def drop_small_parts(mesh: o3d.t.geometry.TriangleMesh, min_triangles: int) -> o3d.t.geometry.TriangleMesh:
    """Remove connected components of fewer than `min_triangles` triangles (floaters); those that share a
    vertex are connected.
    """
    if not len(mesh.vertex.positions):
        return mesh  # Open3D cannot choose from nothing
    triangles = mesh.triangle.indices.numpy()
    ends, num_vertices = triangles[:, [1, 2]].ravel(), len(mesh.vertex.positions)
    edges = coo_array(
        (np.ones(len(ends), bool), (triangles[:, [0, 0]].ravel(), ends)), (num_vertices, num_vertices)
    )
    labels = connected_components(edges, directed=False)[1][triangles[:, 0]]
    keep = np.bincount(labels)[labels] >= min_triangles
    return mesh.select_faces_by_mask(o3d.core.Tensor(keep))


def near_mesh(points: np.ndarray, mesh: o3d.t.geometry.TriangleMesh, distance: float) -> np.ndarray:
    """(N,) bool: which of the (N, 3) points lie within `distance` of the mesh, in the mesh's own frame. Its
    own vertices do, and are known at once where both are in the order of `cloud_in_order`, as most points
    of a field are.
    """
    points = np.ascontiguousarray(points, np.float32)
    near = _found_in(points, np.ascontiguousarray(used_vertices(mesh), np.float32))
    others = np.flatnonzero(~near)
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(mesh)
    for start in range(0, len(others), QUERIES_AT_ONCE):
        rows = others[start : start + QUERIES_AT_ONCE]
        near[rows] = scene.compute_distance(o3d.core.Tensor(points[rows])).numpy() <= distance
    return near


def used_vertices(mesh: o3d.t.geometry.TriangleMesh) -> np.ndarray:
    """(V, 3) positions of the corners of triangles, in the order of the mesh."""
    used = np.zeros(len(mesh.vertex.positions), bool)
    used[mesh.triangle.indices.numpy().ravel()] = True
    return mesh.vertex.positions.numpy()[used]


@numba.njit(cache=True)
def _found_in(points, others):
    """(N,) bool: which points (N, 3) are one of the others (M, 3), found in one pass if both are ordered by
    z, y, x; of points in another order, some are not found.
    """
    found, at = np.zeros(len(points), np.bool_), 0
    for k in range(len(points)):
        x, y, z = points[k, 0], points[k, 1], points[k, 2]
        while at < len(others) and (
            others[at, 2] < z
            or (others[at, 2] == z and (others[at, 1] < y or (others[at, 1] == y and others[at, 0] < x)))
        ):
            at += 1
        found[k] = at < len(others) and others[at, 0] == x and others[at, 1] == y and others[at, 2] == z
    return found
