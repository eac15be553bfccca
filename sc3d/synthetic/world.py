"""The synthetic world: triangles with materials and labels, ready for ray casting."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import open3d as o3d

from sc3d.settings.synthesize import Synthesize
from sc3d.synthetic.close_up import add_grain, cloudy_sky
from sc3d.synthetic.ground import Ground, add_ground, plan_ground
from sc3d.synthetic.layout import build_fences, park_cars, place_buildings, plant
from sc3d.synthetic.mesh import BUILDING, LEAF, TREE, MeshBuilder, face_normals
from sc3d.synthetic.objects import Building, add_building
from sc3d.synthetic.shading import SKY, SUN, shade, surface_labels, truth_labels

COUNTED = 2.0  # lower bushes and hedges are no objects, m


@dataclass(frozen=True)
class World:
    """A site centered on the origin, z up, meters.

    corners: (T, 3, 3) float32 triangles; floats: (T, 17) float32 and ints: (T, 3) int32 as
        `MeshBuilder.finish` returns them
    street: along the x axis, seen from near: surfaces have grain, the sky has clouds
    """

    seed: int
    ground: Ground
    buildings: list[Building]
    corners: np.ndarray
    floats: np.ndarray
    ints: np.ndarray
    scene: o3d.t.geometry.RaycastingScene = field(repr=False)
    street: bool = False

    def cast(self, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """First hits of rays (N, 3): (N,) float32 range in units of the direction, inf = none; (N,) int64
        triangle, -1 = none.
        """
        hits = self.scene.cast_rays(ray_tensor(origins, directions), nthreads=0)
        triangles = hits["primitive_ids"].numpy()
        triangles = np.where(
            triangles == o3d.t.geometry.RaycastingScene.INVALID_ID, -1, triangles.astype(np.int64)
        )
        return hits["t_hit"].numpy(), triangles

    def hidden(self, origins: np.ndarray, directions: np.ndarray, far: float = float("inf")) -> np.ndarray:
        """(N,) bool: rays (N, 3) that hit anything before `far` times their direction."""
        return self.scene.test_occlusions(ray_tensor(origins, directions), tnear=0.0, tfar=far).numpy()

    def labels(self, points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
        """(N,) uint8 labels of surface points (N, 3) on triangles (N,); 0 = other objects, sky, anything
        outside the site.
        """
        return surface_labels(
            points,
            triangles,
            self.ints,
            self.ground.half,
            self.ground.extent / 2,
            self.ground.rasters,
            self.ground.rects,
        )

    def instances(self, triangles: np.ndarray) -> np.ndarray:
        """(N,) int32 object that triangles (N,) belong to, of what is counted: buildings, and plants at
        least `COUNTED` m tall; else 0.
        """
        objects, heights = self.ints[:, 2], self.corners[:, :, 2]
        low, high = (np.full(objects.max() + 1, value) for value in (np.inf, -np.inf))
        np.minimum.at(low, objects, heights.min(axis=1))
        np.maximum.at(high, objects, heights.max(axis=1))
        counted = np.isin(self.ints[:, 1], (BUILDING, TREE)) & (high - low >= COUNTED)[objects]
        return np.where(counted, objects, 0)[triangles].astype(np.int32)

    def truth(self, points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
        """(N,) uint8 as `labels`, but other objects and sky are told from what lies outside the site, as in
        `truth_labels`.
        """
        return truth_labels(self.labels(points, triangles), points, triangles, self.ground.extent / 2)

    def light(self, points: np.ndarray, triangles: np.ndarray, footprints: np.ndarray) -> np.ndarray:
        """(N, 3) float32 linear RGB of surface points (N, 3) float32 in sun and shadow; `footprints` (N,)
        float32 sample sizes, m.
        """
        offset = 0.02 * SUN + 0.01 * self.floats[triangles, 9:12]
        lit = ~self.hidden(points + offset, np.broadcast_to(SUN, points.shape))
        ground = self.ground
        plan = (ground.half, ground.rasters, ground.rects)
        light = shade(points, triangles, lit.view(np.uint8), footprints, self.floats, self.ints, *plan, SUN)
        if self.street:
            add_grain(light, points, triangles, footprints, self.floats, self.ints, *plan)
        return light

    def sky(self, directions: np.ndarray) -> np.ndarray:
        """(N, 3) float32 linear RGB of the sky in unit directions (N, 3)."""
        return cloudy_sky(directions) if self.street else np.tile(SKY, (len(directions), 1))

    def normals(self, triangles: np.ndarray) -> np.ndarray:
        """(N, 3) outward unit normals of triangles (N,); leaves have two sides, theirs point out of the
        crown.
        """
        normals = face_normals(self.corners[triangles].astype(np.float64))
        leaf = self.ints[triangles, 0] == LEAF
        inward = (normals * self.floats[triangles, 9:12]).sum(1) < 0
        normals[leaf & inward] *= -1
        return normals


def build_world(settings: Synthesize, level_edges: bool = False) -> World:
    """Build the site of `settings.seed` and `settings.side`: ground, roads, buildings, plants, cars.
    level_edges: as in `Ground`.
    """
    streams = np.random.default_rng([settings.seed, 1]).spawn(6)
    ground = plan_ground(settings.side, streams[0], level_edges)
    buildings = place_buildings(ground, streams[1])
    builder = MeshBuilder()
    add_ground(builder, ground)
    for building in buildings:
        add_building(builder, building, streams[2])
    plant(builder, ground, buildings, streams[3])
    park_cars(builder, ground, streams[4])
    build_fences(builder, ground, buildings, streams[5])
    return finish_world(settings.seed, ground, buildings, builder)


def finish_world(
    seed: int, ground: Ground, buildings: list[Building], builder: MeshBuilder, street: bool = False
) -> World:
    """The world of all triangles of `builder`."""
    corners, floats, ints = builder.finish()
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(
        o3d.core.Tensor(corners.reshape(-1, 3)),
        o3d.core.Tensor(np.arange(3 * len(corners), dtype=np.uint32).reshape(-1, 3)),
    )
    return World(seed, ground, buildings, corners, floats, ints, scene, street)


def ray_tensor(origins: np.ndarray, directions: np.ndarray) -> o3d.core.Tensor:
    """(N, 6) float32 rays from origins (N, 3) along directions (N, 3), as Open3D takes them."""
    table = np.empty((len(directions), 6), np.float32)
    table[:, :3], table[:, 3:] = origins, directions
    return o3d.core.Tensor(table)
