"""Which way is up in a model that nothing outside the photos has leveled. This is the one place that says so.

People, tripods and gimbals hold cameras level: the rows of a photo as shown are horizontal, whatever the
camera's pitch. So up is the direction across the rows of all photos, which is sure as far as the photos look
in different directions. It is unsure where they all look the same way; there up is against the view of
photos that look down, or the top of those that look ahead. The main plane of the points is no witness: on a
flight it is the ground, or its slope; before a house it is the facade.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pycolmap

from sc3d.geometry.cameras import View
from sc3d.georeferencing.alignment import main_plane, subsets
from sc3d.georeferencing.geotags import read_drone_xmp
from sc3d.io.colmap import cam_from_world, registered_images
from sc3d.io.images import read_orientation
from sc3d.io.orientation import turned_points
from sc3d.scene.scene import Scene

logger = logging.getLogger(__name__)

# all in degrees
HELD_LEVEL = 2.0  # standard deviation of rows from the horizon, before any is seen
OFF_LEVEL = 8.0  # rows that lie farther off are those of a camera that was not held level
SAME_WAY = 30.0  # optical axes that differ by less, on average, look the same way
POINTED_DOWN = 3.0  # standard deviation of what is meant to look straight down
GIMBAL = 1.0  # smallest standard deviation of stated angles
UNSURE = 5.0  # beyond, planes in the points may turn up a little
AGREED = 0.6  # of the photos agree on up, or what they say is worth nothing
VAGUE = 20.0  # beyond, rows do not even tell level photos from those that look down
LEVEL_PITCH, GROUND, WALL, WALK = (
    10.0,
    5.0,
    2.0,
    5.0,
)  # standard deviations: pitch of level photos, slopes, ...
LOOKING_DOWN = 0.9  # cosine: photos that look along the vertical by more have no top
NEAR = 15.0  # planes that lean by less may be ground
GUESS = 45.0  # what a guess is worth
LEVEL_PRIOR = 4  # photos that HELD_LEVEL counts as much as
THIN = 0.01  # thickness of a plane, in distances of the points from the cameras
MIN_SUPPORT = 0.2  # of the points in question lie on a plane that counts
APART = 10.0  # witnesses that differ by more contradict one another
MANY, TRIALS = 2000, 1500  # points at most, and triples of them, that planes are looked for in


@dataclass(frozen=True)
class Stated:
    """What a photo says of its own: EXIF orientation, 1 to 8, and (3,) up in the frame of its camera by the
    angles of a drone's gimbal; None = not stated.
    """

    orientation: int = 1
    up: np.ndarray | None = None


@dataclass(frozen=True)
class Poses:
    """Cameras of a model by what up needs of them.

    right, down, forward: (N, 3) unit, world: along the rows and columns of the photo as shown, into the scene
    centers: (N, 3) world; stated: (N, 3) up by the gimbal, world, NaN = not stated
    """

    right: np.ndarray
    down: np.ndarray
    forward: np.ndarray
    centers: np.ndarray
    stated: np.ndarray

    @classmethod
    def from_cameras(
        cls, rotations: np.ndarray, centers: np.ndarray, stated: list[Stated] | None = None
    ) -> Poses:
        """rotations: (N, 3, 3) cam_from_world of the photos as stored; centers: (N, 3); stated: of each"""
        stated = stated or [Stated()] * len(rotations)
        shown = np.stack([_shown_axes(each.orientation) for each in stated]) @ rotations[:, :2]
        up = [np.full(3, np.nan) if each.up is None else each.up for each in stated]
        return cls(
            shown[:, 0],
            shown[:, 1],
            rotations[:, 2],
            centers,
            np.einsum("nij,ni->nj", rotations, np.stack(up)),
        )


@dataclass(frozen=True)
class UpDirection:
    """up: (3,) unit, world; deviation: its standard deviation in the worst direction, degrees; how: it was
    found, in words; doubt: what speaks against it, in words
    """

    up: np.ndarray
    deviation: float
    how: str
    doubt: str = ""

    @property
    def figures(self) -> dict[str, object]:
        """What a stage reports."""
        return {"up_from": self.how, "up_deviation_deg": round(self.deviation, 1)}

    def tell(self) -> None:
        """One warning, where there is a doubt."""
        if self.doubt:
            logger.warning("%s", self.doubt)


def read_stated(photos: Path, names: list[str]) -> list[Stated]:
    """What photos (names relative to the folder) say of their own; nothing of those that are not there."""
    return [_read(photos / name) if (photos / name).is_file() else Stated() for name in names]


def model_poses(model: pycolmap.Reconstruction, images: Path | None) -> Poses:
    """Those of the registered photos, by name. images: folder of the photos; None = it is not known, they lie
    as stored
    """
    registered = registered_images(model)
    return Poses.from_cameras(
        np.array([cam_from_world(image)[:3, :3] for image in registered]),
        np.array([image.projection_center() for image in registered]),
        None if images is None else read_stated(images, [image.name for image in registered]),
    )


def view_poses(views: list[View], images: Path) -> Poses:
    """Those of views, in their order. images: folder of the photos"""
    return Poses.from_cameras(
        np.array([view.cam_from_world[:3, :3] for view in views]),
        np.array([view.center for view in views]),
        read_stated(images, [view.name for view in views]),
    )


def scene_up(scene: Scene) -> np.ndarray | None:
    """(3,) up in the world of a scene, by its cameras, whatever frame it is in; None if it has none, or
    they do not say.
    """
    found = _scene_direction(scene)
    return None if found is None else found.up


def tell_tilt(scene: Scene) -> None:
    """One warning where z, which stands for up in a scene without a place, is not up by its cameras."""
    found = _scene_direction(scene)
    if found is None:
        return
    tilt = angle(found.up, np.array([0.0, 0.0, 1.0]))
    if tilt > max(2 * APART, 3 * found.deviation):
        logger.warning(
            "z of %s is %.0f degrees off up by its cameras (%s): views and exports take z as up, so turn the "
            "model in the program that made it, or give it a place (`sc3d georeference`)",
            scene.path,
            tilt,
            found.how,
        )


def _scene_direction(scene: Scene) -> UpDirection | None:
    if not scene.sparse.is_dir():
        return None
    found = find_up(view_poses(scene.model.views, scene.images), scene.model.points)
    return found if found.deviation < VAGUE else None


def _read(photo: Path) -> Stated:
    orientation, numbers = read_orientation(photo), read_drone_xmp(photo)
    pitch, roll = numbers.get("GimbalPitchDegree"), numbers.get("GimbalRollDegree", 0.0)
    # a turned photo does not say which of the two frames its angles belong to; a file of zeros was not filled
    if orientation != 1 or pitch is None or (pitch == 0 and roll == 0):
        return Stated(orientation)
    return Stated(orientation, gimbal_up(pitch, roll))


def gimbal_up(pitch: float, roll: float) -> np.ndarray:
    """(3,) up in the frame of a camera by the angles of DJI's XMP, degrees: pitch 0 looks at the horizon, -90
    straight down; yaw, pitch and roll turn north, east, down in this order.
    """
    pitch, roll = np.radians(pitch), np.radians(roll)
    return np.array([-np.cos(pitch) * np.sin(roll), -np.cos(pitch) * np.cos(roll), np.sin(pitch)])


def settle_up(poses: Poses, points: np.ndarray) -> UpDirection:
    """As `find_up`, for a model that is leveled by it: with a warning where there is a doubt."""
    found = find_up(poses, points)
    found.tell()
    return found


def find_up(poses: Poses, points: np.ndarray) -> UpDirection:
    """Up, from the cameras; where they leave it unsure, planes in the sparse points (P, 3) help."""
    rows, gimbal = _from_rows(poses), _from_gimbal(poses)
    if gimbal is not None and gimbal.deviation < UNSURE:
        found = gimbal
    else:
        found = _from_cameras(poses, rows, points)
    found = _refine(found, poses, points)
    return replace(found, doubt=found.doubt or _doubt(found, rows, gimbal))


def _from_cameras(poses: Poses, rows: UpDirection | None, points: np.ndarray) -> UpDirection:
    """The surest of what rows, viewing directions and positions say."""
    walk = _from_walk(poses, points)
    view = _from_view(poses, rows, walk)
    known = [each for each in (view, rows) if each is not None and each.deviation < VAGUE]
    if view is None and known and known[0].deviation > UNSURE:
        other = _from_tops(poses, points) if walk is None else walk
        known += [] if other is None else [other]
    return min(known, key=lambda each: each.deviation) if known else _from_kind(poses, walk, points)


def _doubt(found: UpDirection, rows: UpDirection | None, gimbal: UpDirection | None) -> str:
    if gimbal is not None and gimbal.deviation > UNSURE:
        return (
            f"gimbal angles in XMP do not fit the cameras, by about {gimbal.deviation:.0f} degrees: "
            f"they are not used, up is from {found.how}"
        )
    apart = 0.0 if rows is None else angle(found.up, rows.up)
    if rows is not None and apart > max(APART, 3 * rows.deviation):
        return (
            f"up from {found.how} and up from {rows.how} are {apart:.0f} degrees apart: the former is taken"
        )
    if found.deviation > 2 * UNSURE:
        return (
            f"up is not sure, by about {found.deviation:.0f} degrees: it is from {found.how}; "
            "control points or GPS would tell"
        )
    return ""


def upside_down(poses: Poses, up: np.ndarray) -> bool:
    """Whether `up` (3,) puts the cameras on their heads: looking up, photos with the ground on top."""
    return bool(_upright(up, poses) @ up < 0)


def angle(one: np.ndarray, other: np.ndarray) -> float:
    """Degrees between two unit vectors (3,)."""
    return float(np.degrees(np.arccos(np.clip(one @ other, -1, 1))))


def _shown_axes(orientation: int) -> np.ndarray:
    """(2, 2) rows: right and down of a photo as shown, in its frame as stored."""
    corner = turned_points(np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]), (1, 1), orientation)
    return (corner[1:] - corner[0]).T


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.maximum(np.linalg.norm(vector), 1e-12)


def _from_gimbal(poses: Poses) -> UpDirection | None:
    """Up by the gimbal angles, if half of the photos state them; a large deviation if they do not agree."""
    stated = poses.stated[np.isfinite(poses.stated).all(axis=1)]
    if len(stated) < max(3, len(poses.centers) / 2):
        return None
    up = _unit(np.median(stated, axis=0))
    off = np.degrees(np.arccos(np.clip(stated @ up, -1, 1)))
    near = off < OFF_LEVEL
    if near.mean() < AGREED:
        return UpDirection(up, float(np.median(off)), "gimbal angles")
    spread = np.sqrt((off[near] ** 2).mean() / near.sum())
    how = f"gimbal angles of {near.sum()} photos"
    return UpDirection(_unit(stated[near].mean(axis=0)), float(np.hypot(GIMBAL, spread)), how)


def _from_rows(poses: Poses) -> UpDirection | None:
    """Up across the rows of the photos; None if fewer than AGREED of them agree on any."""
    found = _across(poses.right, poses.down)
    around = np.linalg.norm(poses.forward.mean(axis=0)) < 0.6  # no camera pitches that far: it went around
    if around and (found is None or found.deviation > VAGUE):
        # photos that stand on their sides, and do not say so
        found = _across(poses.down, poses.right)
        if found is None or found.deviation > UNSURE:
            return None
        return replace(found, up=found.up * _side(found.up, poses), how=f"columns of {found.how}")
    return None if found is None else replace(found, up=_upright(found.up, poses), how=f"rows of {found.how}")


def _side(up: np.ndarray, poses: Poses) -> float:
    """1 or -1, as photos are taken from above."""
    return -1.0 if poses.forward.mean(axis=0) @ up > 0 else 1.0


def _upright(up: np.ndarray, poses: Poses) -> np.ndarray:
    """`up` or its opposite: the tops of the photos are up; photos that look along it look down."""
    down, forward = float((poses.down @ up).mean()), float((poses.forward @ up).mean())
    return -up if (forward if abs(forward) > LOOKING_DOWN else down) > 0 else up


def _across(level: np.ndarray, other: np.ndarray) -> UpDirection | None:
    """Direction across the `level` axes (N, 3) of most cameras, and across the `other` of the rest, which
    were held on their sides; sign open. None if that holds for fewer than AGREED of them.
    """
    num, limit = len(level), np.sin(np.radians(OFF_LEVEL))
    if num < 2:
        return None
    pairs = np.array(subsets(num, 2))
    crossed = np.cross(level[pairs[:, 0]], level[pairs[:, 1]])
    sines = np.linalg.norm(crossed, axis=1)
    tried = np.concatenate([np.linalg.svd(level)[2][2:], crossed[sines > 0.02] / sines[sines > 0.02, None]])
    upright = np.minimum((level @ tried.T / limit) ** 2, 1)
    turned = np.minimum(0.25 + (other @ tried.T / limit) ** 2, 1)
    up = tried[np.minimum(upright, turned).sum(axis=0).argmin()]
    for _ in range(5):
        aside = np.abs(level @ up) > limit
        axes = np.where((aside & (np.abs(other @ up) < limit))[:, None], other, level)
        kept = np.abs(axes @ up) < limit
        if kept.mean() < AGREED or kept.sum() < 2:
            return None
        up = np.linalg.svd(axes[kept])[2][2]
    return UpDirection(up, _deviation(axes[kept], up), _counted(kept, aside & kept))


def _counted(kept: np.ndarray, turned: np.ndarray) -> str:
    words = f"{kept.sum()} of {len(kept)} photos"
    return f"{words}, {turned.sum()} of them turned without saying so" if turned.any() else words


def _deviation(axes: np.ndarray, up: np.ndarray) -> float:
    """Standard deviation, degrees, of `up` across horizontal axes (N, 3).

    Errors of the rows go with the direction of view (wind, one photographer), so many photos do not make them
    smaller; the less the directions differ, the more an error tips what is across all of them.
    """
    squares = np.degrees(np.arcsin(np.clip(axes @ up, -1, 1))) ** 2
    error = np.sqrt((squares.sum() + LEVEL_PRIOR * HELD_LEVEL**2) / (len(axes) + LEVEL_PRIOR - 2))
    spread = np.linalg.svd(axes, compute_uv=False)[1] / np.sqrt(len(axes))
    return float(min(error / max(spread, 1e-6), 90.0))


def _from_view(poses: Poses, rows: UpDirection | None, walk: UpDirection | None) -> UpDirection | None:
    """Up against the mean viewing direction, if the photos look the same way and neither the rows nor the way
    of the cameras says that this is level or oblique; None otherwise, or if nothing tells.
    """
    mean = poses.forward.mean(axis=0)
    alike = float(np.linalg.norm(mean))
    if alike < np.cos(np.radians(SAME_WAY)):
        return None
    up = -mean / alike
    if _all_headings(poses):
        known = True
    else:
        known = rows is not None and rows.deviation < VAGUE and angle(up, rows.up) < 45
    tilt = 0.0 if walk is None else angle(up, walk.up)  # of the cameras, or of the slope that they followed
    if walk is not None and tilt > max(APART, 2 * walk.deviation):
        known = False
    spread = np.degrees(np.arccos(min(alike, 1.0)))
    found = UpDirection(
        up, float(np.linalg.norm([POINTED_DOWN, spread / 2, tilt / 2])), "the view of photos that look down"
    )
    return found if known else None


def _all_headings(poses: Poses) -> bool:
    """Whether the tops of the photos point many ways, as they do only where photos look down."""
    return bool(np.linalg.norm(poses.down.mean(axis=0)) < 0.5)


def _from_kind(poses: Poses, walk: UpDirection | None, points: np.ndarray) -> UpDirection:
    """Up where rows tell one direction at most: photos that look ahead, or down, by what their cameras and
    the ground below them are like.
    """
    if np.linalg.norm(poses.down.mean(axis=0)) < np.cos(np.radians(SAME_WAY)):
        return _guess(poses, points)
    forward, tops = poses.forward.mean(axis=0), _from_tops(poses, points)
    below = UpDirection(-_unit(forward), POINTED_DOWN, "the view of photos that look down")
    same_way = np.linalg.norm(forward) > np.cos(np.radians(SAME_WAY))
    if walk is not None:
        tilt = angle(walk.up, below.up)
        below = replace(below, deviation=float(np.hypot(POINTED_DOWN, tilt / 2)))
        return below if same_way and tilt < max(APART, 2 * walk.deviation) else walk
    if tops is not None:
        return tops
    doubt = (
        "up is not sure: all photos look the same way, from one line, and nothing tells whether ahead or "
        "down. Down is taken; control points or GPS would tell"
    )
    return replace(below, deviation=VAGUE, doubt=doubt) if same_way else _guess(poses, points)


def _from_tops(poses: Poses, points: np.ndarray) -> UpDirection | None:
    """Up by the tops of photos that look ahead, if there is ground below their cameras; else None."""
    up = -_unit(poses.down.mean(axis=0))
    ground = _ground(poses, points, up)
    return None if ground is None else UpDirection(up, LEVEL_PITCH, "the tops of photos that look ahead")


def _from_walk(poses: Poses, points: np.ndarray) -> UpDirection | None:
    """Up across the rows and the way of the cameras, if they kept one height; None if they moved along the
    rows only.
    """
    side = np.linalg.svd(poses.right)[2][0]
    top = -_unit(np.cross(np.cross(side, poses.down.mean(axis=0)), side))
    back = np.cross(side, top) * np.sign(np.cross(side, top) @ -poses.forward.mean(axis=0))
    plane = np.stack([top, back])
    moved = (poses.centers - poses.centers.mean(axis=0)) @ plane.T
    spread, ways = np.linalg.svd(moved / np.sqrt(len(moved)), full_matrices=False)[1:]
    if spread[0] < 0.05 * _distance(poses, points) or spread[1] > 0.3 * spread[0]:
        return None
    up = ways[1] * np.sign(ways[1].sum()) @ plane
    deviation = np.hypot(WALK, np.degrees(np.arctan2(spread[1], spread[0])))
    return UpDirection(up, float(deviation), "the height that the cameras kept")


def _guess(poses: Poses, points: np.ndarray) -> UpDirection:
    """The main plane of the points, cameras above it, as of a flight."""
    if len(points) < 3:
        return UpDirection(-_unit(poses.down.mean(axis=0)), GUESS, "the tops of the photos")
    axes, middle = main_plane(points)
    up = axes[2] if axes[2] @ (poses.centers.mean(axis=0) - middle) > 0 else -axes[2]
    return UpDirection(up, GUESS, "the main plane of the points: the cameras are not held level")


def _refine(found: UpDirection, poses: Poses, points: np.ndarray) -> UpDirection:
    """Up turned away from a wall before photos that look ahead, and, where it is unsure, towards a ground
    below the cameras: as much as they are surer.
    """
    ahead = abs((poses.forward @ found.up).mean()) < 0.5
    if found.deviation >= GUESS:
        return found
    wall = _wall(poses, points, found) if ahead and found.deviation > WALL else None
    ground = _ground(poses, points, found.up) if found.deviation > UNSURE else None
    if wall is None and ground is None:
        return found
    known, words = [(np.eye(3) - np.outer(found.up, found.up), found.deviation)], [found.how]
    level = poses.right[np.abs(poses.right @ found.up) < np.sin(np.radians(OFF_LEVEL))]
    if 2 * len(level) > len(poses.right):
        side = np.linalg.svd(level)[2][0]
        known.append((np.outer(side, side), HELD_LEVEL))
    if ground is not None:
        known.append((np.eye(3) - np.outer(ground, ground), GROUND))
        words.append("the ground")
    if wall is not None:
        known.append((np.outer(wall, wall), WALL))
        words.append("an upright wall")
    weights, axes = np.linalg.eigh(sum(part / deviation**2 for part, deviation in known))
    up = axes[:, 0] * np.sign(axes[:, 0] @ found.up)
    return replace(found, up=up, deviation=float(weights[1] ** -0.5), how=", ".join(words))


def _distance(poses: Poses, points: np.ndarray) -> float:
    """Median distance of the points from the middle camera; infinite without points."""
    if not len(points):
        return float("inf")
    return float(np.median(np.linalg.norm(points - np.median(poses.centers, axis=0), axis=1)))


def _ground(poses: Poses, points: np.ndarray, up: np.ndarray) -> np.ndarray | None:
    """(3,) normal of a plane below all cameras, with little under it, that leans by less than NEAR."""
    low = points[points @ up < (poses.centers @ up).min()]
    thickness = THIN * _distance(poses, points)
    found = _plane(low, thickness, lambda normals: np.abs(normals @ up) > np.cos(np.radians(NEAR)))
    if found is None:
        return None
    normal = found[0] * np.sign(found[0] @ up)
    under = (points - found[1]) @ normal < -3 * thickness
    above = ((poses.centers - found[1]) @ normal > 0).all()
    return normal if above and under.mean() < 0.1 else None


def _wall(poses: Poses, points: np.ndarray, found: UpDirection) -> np.ndarray | None:
    """(3,) normal of a plane that holds MIN_SUPPORT of the points and is upright within what up is known to;
    or None.
    """
    lean = np.sin(np.radians(min(found.deviation, NEAR)))
    plane = _plane(points, THIN * _distance(poses, points), lambda normals: np.abs(normals @ found.up) < lean)
    return None if plane is None else plane[0]


def _plane(
    points: np.ndarray, thickness: float, likely: Callable[[np.ndarray], np.ndarray]
) -> tuple[np.ndarray, np.ndarray] | None:
    """Normal and point of the plane with most of the points (N, 3) within `thickness`, of those whose normals
    (T, 3) are `likely` (T,); None if fewer than MIN_SUPPORT of the points lie on it.
    """
    if len(points) < 30:
        return None
    rng = np.random.default_rng(0)
    some = points[rng.choice(len(points), min(len(points), MANY), replace=False)]
    corners = some[rng.integers(0, len(some), (TRIALS, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    normals = normals / np.maximum(lengths, 1e-300)[:, None]
    good = (lengths > 0) & likely(normals)
    if not good.any():
        return None
    normals, starts = normals[good], np.einsum("ti,ti->t", normals[good], corners[good, 0])
    counts = (np.abs(some @ normals.T - starts) < thickness).sum(axis=0)
    best = counts.argmax()
    on = some[np.abs(some @ normals[best] - starts[best]) < thickness]
    if len(on) < MIN_SUPPORT * len(some):
        return None
    normal = np.linalg.svd(on - on.mean(axis=0), full_matrices=False)[2][2]
    return (normal, on.mean(axis=0)) if likely(normal[None])[0] else None
