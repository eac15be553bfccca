"""What people have corrected in 3D: shapes in the frame of the scene whose points are of a class, or of none.

`corrections.json` is a log to which entries are added: corrections, and what was undone or redone of them.
Shapes hold no rows of a cloud, so they are as good for any other cloud of the scene.
"""

from __future__ import annotations

import logging
import uuid
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from sc3d.errors import InputError, examples
from sc3d.io.file_lock import locked
from sc3d.io.json_files import read_json, write_json
from sc3d.io.limits import FARTHEST
from sc3d.scene.class_table import ClassTable
from sc3d.scene.frame_reference import Move, Reference, move_into, reference_of
from sc3d.scene.labels import CORRECTED, Labels
from sc3d.scene.scene import Scene

VERSION = 1
MAX_BYTES = 256 << 20
MAX_SIZES, MAX_CENTERS = 64, 100_000  # of the balls of one correction: different radii, and balls of each
MAX_ERROR = 0.01  # of a frame, as `Move.error`
KINDS = ("balls", "polygon", "undo", "redo")  # by the one of these keys that it has, an entry is what it is

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Balls:
    """All that lies in one of many balls. groups: per size, the centers (B, 3), world, and the radius
    of balls.
    """

    groups: tuple[tuple[np.ndarray, float], ...]

    def contain(self, points: np.ndarray) -> np.ndarray:
        """(N,) bool of points (N, 3) float64 world; each is judged by itself. On the surface is inside."""
        inside = np.zeros(len(points), bool)
        for centers, radius in self.groups:
            low, high = centers.min(axis=0) - radius, centers.max(axis=0) + radius
            near = np.flatnonzero(~inside & ((points >= low) & (points <= high)).all(axis=1))
            distances, _ = cKDTree(centers).query(points[near])
            inside[near[distances <= radius]] = True
        return inside

    def as_json(self) -> dict[str, object]:
        return {"balls": [{"radius": radius, "centers": centers.tolist()} for centers, radius in self.groups]}


@dataclass(frozen=True)
class Prism:
    """All that lies over or under a polygon (K, 2) of the ground plane, x and y, and from `low` to
    `high` in z, world. Where the polygon crosses itself, the even-odd rule counts.
    """

    polygon: np.ndarray
    low: float
    high: float

    def contain(self, points: np.ndarray) -> np.ndarray:
        """As `Balls.contain`."""
        z = points[:, 2]
        return in_polygon(self.polygon, points[:, :2]) & (z >= self.low) & (z <= self.high)

    def as_json(self) -> dict[str, object]:
        return {"polygon": self.polygon.tolist(), "z": [self.low, self.high]}


def in_polygon(polygon: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(N,) bool of points (N, 2): in a polygon (K, 2), by the even-odd rule."""
    x, y = points.T
    inside = np.zeros(len(points), bool)
    for (x0, y0), (x1, y1) in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        if y0 != y1:
            inside ^= ((y0 > y) != (y1 > y)) & (x < (x1 - x0) * (y - y0) / (y1 - y0) + x0)
    return inside


@dataclass(frozen=True)
class Correction:
    """The points in a shape are of a class. name: of the class, None = of none; time: ISO 8601, when it
    was made; reference: in whose frame the shape is, empty = in that of the scene
    """

    key: str
    time: str
    name: str | None
    shape: Balls | Prism
    reference: Reference = field(default_factory=dict)


@dataclass(frozen=True)
class Corrections:
    """The corrections of a scene that stand, in the order in which they were made; where two overlap,
    the later one counts. ids: (C,) int of their classes, 0 = none of them; moves: (C,) ways into the
    frames of their shapes; origin: their file
    """

    corrections: tuple[Correction, ...] = ()
    ids: tuple[int, ...] = ()
    moves: tuple[Move | None, ...] = ()
    origin: Path | None = None

    @classmethod
    def of_scene(cls, scene: Scene) -> Corrections:
        """InputError for a broken file, or a class that no point can be of."""
        path = scene.corrections
        if not path.exists():
            return cls()
        found = standing(read_log(path))
        table = scene.class_table() if any(one.name is not None for one in found) else None
        ids = tuple(_class_id(one.name, table, path) for one in found)
        return cls(found, ids, _moves(found, scene), path)

    def contain(self, row: int, points: np.ndarray) -> np.ndarray:
        """(N,) bool which of the points (N, 3) float64 world lie in a correction; row: which one"""
        move = self.moves[row]
        return self.corrections[row].shape.contain(points if move is None else move(points))

    @property
    def files(self) -> list[Path]:
        """What they were read from, if it is there."""
        return [] if self.origin is None else [self.origin, self.origin.with_name("classes.json")]

    def apply(self, labels: Labels, points: np.ndarray) -> tuple[Labels, np.ndarray]:
        """Labels (N,), ids, of points (N, 3) float64 world with what was corrected, state
        `CORRECTED`; and (C,) int64 how many points lie in each correction.
        """
        label, counts = labels.label.copy(), np.zeros(len(self.ids), np.int64)
        touched = np.zeros(len(points), bool)
        for row, given in enumerate(self.ids):
            inside = self.contain(row, points)
            label[inside], counts[row] = given, np.count_nonzero(inside)
            touched |= inside
        confidence = np.where(touched, label > 0, labels.confidence).astype(labels.confidence.dtype)
        state = np.where(touched, CORRECTED, labels.state).astype(labels.state.dtype)
        return Labels(label, confidence, state, labels.num_views), counts

    def warn_of_missing(self, counts: np.ndarray, cloud: Path) -> None:
        """One line for those that no point of the cloud lies in. counts: (C,) from `apply`"""
        missing = [
            f"{one.name or 'none'} of {one.time}"
            for one, count in zip(self.corrections, counts, strict=True)
            if not count
        ]
        if missing:
            logger.warning(
                "%d of %d corrections in %s touch no point of %s, as those of another frame would: %s",
                len(missing),
                len(self.ids),
                self.origin,
                cloud,
                examples(missing),
            )


def _moves(found: tuple[Correction, ...], scene: Scene) -> tuple[Move | None, ...]:
    """How points come into the frames of the corrections; a warning for those that cannot be followed."""
    views = scene.model.views if scene.sparse.is_dir() else []
    moves, lost, worst = list[Move | None](), 0, 0.0
    for one in found:
        move = None
        try:
            move = move_into(one.reference, views)
        except KeyError:
            lost += 1
        worst = max(worst, 0.0 if move is None else move.error)
        moves.append(move)
    if lost:
        logger.warning(
            "%d of %d corrections were made with cameras that the scene does not have now:"
            " they are taken to be in its present frame",
            lost,
            len(found),
        )
    if worst > MAX_ERROR:
        logger.warning(
            "corrections were made with cameras that lie otherwise to one another now,"
            " by %.1f%% of their distance, so that they may have slipped: look at them in sc3d view --web",
            100 * worst,
        )
    return tuple(moves)


def _class_id(name: str | None, table: ClassTable | None, origin: Path) -> int:
    if name is None or table is None:
        return 0
    found = table.find(name)
    if found is None:
        raise InputError(f"{origin} corrects to {name!r}, which is no class of the scene (classes.json)")
    if any(entry.id == found for entry in table.without_surface):
        raise InputError(f"{origin} corrects to {name!r}, a class that no point can be of (classes.json)")
    return found


def add_correction(scene: Scene, name: str | None, shape: Balls | Prism) -> str:
    """Write down that the points in a shape are of a class (None: of none), at once and after whatever
    others wrote. Returns the key of the correction.

    Raises InputError for a class that no point can be of, a shape that is none, or a broken file.
    """
    if name is not None:
        _class_id(name, scene.class_table(), scene.corrections)
    entry = {"class": name} | shape.as_json()
    if scene.sparse.is_dir():
        entry["cameras"] = {name: pose.tolist() for name, pose in reference_of(scene.model.views).items()}
    return _append(scene.corrections, lambda _: entry)


def undo(scene: Scene, key: str | None = None) -> Correction | None:
    """Take the last correction that stands back, or the one of that key, and return it; None if there is
    none.
    """
    return _revoke(
        scene,
        "undo",
        lambda log: next((one for one in reversed(standing(log)) if key in (None, one.key)), None),
    )


def redo(scene: Scene) -> Correction | None:
    """The opposite of the last `undo`, unless a correction was added since; None if there is none."""
    return _revoke(scene, "redo", _last_undone)


def _revoke(scene: Scene, kind: str, choose: Callable[[list[dict]], Correction | None]) -> Correction | None:
    chosen: list[Correction] = []

    def entry(log: list[dict]) -> dict[str, object] | None:
        found = choose(log)
        chosen.extend([] if found is None else [found])
        return None if found is None else {kind: found.key}

    _append(scene.corrections, entry)
    return chosen[0] if chosen else None


def _last_undone(log: list[dict]) -> Correction | None:
    undone: list[str] = []
    for entry in log:
        if "undo" in entry:
            undone.append(entry["undo"])
        elif "redo" in entry:
            undone.remove(entry["redo"])
        else:
            undone.clear()
    return next((_correction(entry) for entry in log if undone and entry["id"] == undone[-1]), None)


def standing(log: Sequence[dict]) -> tuple[Correction, ...]:
    """The corrections of a checked log that are not undone, in the order in which they were made."""
    undone = set[str]()
    for entry in log:
        if "undo" in entry:
            undone.add(entry["undo"])
        undone.discard(entry.get("redo", ""))
    return tuple(_correction(entry) for entry in log if _is_made(entry) and entry["id"] not in undone)


def _is_made(entry: dict) -> bool:
    """Whether an entry is a correction."""
    return "balls" in entry or "polygon" in entry


def _append(path: Path, make: Callable[[list[dict]], dict[str, object] | None]) -> str:
    """Add the entry that `make` gives for the present log, if it gives one; nobody else writes meanwhile.
    Returns its key, "" without one.
    """
    with locked(path):
        log = read_log(path) if path.exists() else []
        entry = make(log)
        if entry is None:
            return ""
        now = datetime.now(timezone.utc).isoformat(timespec="seconds").replace("+00:00", "Z")
        key = uuid.uuid4().hex
        write_json(
            path, {"version": VERSION, "log": _checked([*log, entry | {"id": key, "time": now}], path)}
        )
        return key


def read_log(path: Path) -> list[dict]:
    """The entries of a `corrections.json`, all checked; InputError that names the first that is none."""
    content = read_json(path, MAX_BYTES)
    version = content.get("version") if isinstance(content, dict) else None
    if not isinstance(content, dict) or version != VERSION or not isinstance(content.get("log"), list):
        raise InputError(
            f"{path} is no log of corrections of version {VERSION}:"
            f' {{"version": {VERSION}, "log": [...]}} is expected'
        )
    return _checked(content["log"], path)


def _checked(log: list[Any], path: Path) -> list[dict]:
    made, undone, keys = set[str](), set[str](), set[str]()
    for number, entry in enumerate(log, 1):
        reason = _fault(entry, made, undone, keys)
        if reason is not None:
            raise InputError(f"{path}: entry {number} {reason}")
        keys.add(entry["id"])
        if _is_made(entry):
            made.add(entry["id"])
        elif "undo" in entry:
            undone.add(entry["undo"])
        else:
            undone.remove(entry["redo"])
    return log


def _fault(entry: Any, made: set[str], undone: set[str], keys: set[str]) -> str | None:
    """Why an entry is none, in words that complete "entry 1"; made, undone, keys: of the entries before."""
    if not isinstance(entry, dict) or sum(kind in entry for kind in KINDS) != 1:
        return f"needs one of {', '.join(KINDS)}"
    if not isinstance(entry.get("id"), str) or entry["id"] in keys:
        return "needs an id of its own"
    if not _is_time(entry.get("time")):
        return "needs a time such as 2026-05-01T12:00:00Z"
    if "undo" in entry or "redo" in entry:
        kind, possible = ("undo", made - undone) if "undo" in entry else ("redo", undone)
        known = isinstance(entry[kind], str) and entry[kind] in possible
        return None if known else f"has nothing to {kind} under that id"
    name = entry.get("class", 0)
    if name is not None and not isinstance(name, str):
        return "needs a class: a name, or null for none"
    if not _is_reference(entry.get("cameras", {})):
        return "needs cameras: a pose of three rows of four numbers by the name of a photo"
    if "polygon" in entry:
        return _prism_fault(entry)
    return _balls_fault(entry["balls"])


def _balls_fault(groups: object) -> str | None:
    if not isinstance(groups, list) or not 1 <= len(groups) <= MAX_SIZES:
        return f"needs balls: 1 to {MAX_SIZES} objects with a radius and centers"
    for group in groups:
        if not isinstance(group, dict) or not _is_table(group.get("centers"), 3, 1, MAX_CENTERS):
            return f"needs centers: 1 to {MAX_CENTERS} positions of three numbers"
        if not _is_table([[group.get("radius")]], 1) or group["radius"] <= 0:
            return "needs a radius above 0"
    return None


def _prism_fault(entry: dict) -> str | None:
    if not _is_table(entry["polygon"], 2, 3, MAX_CENTERS):
        return f"needs a polygon: 3 to {MAX_CENTERS} corners of two numbers"
    if not _is_table([entry.get("z")], 2) or entry["z"][0] > entry["z"][1]:
        return "needs z: its lower and upper end"
    return None


def _is_reference(cameras: object) -> bool:
    return isinstance(cameras, dict) and all(
        _is_table(pose, 4, 3, 3) and np.allclose(_rotation(pose) @ _rotation(pose).T, np.eye(3), atol=1e-6)
        for pose in cameras.values()
    )


def _rotation(pose: list[list[float]]) -> np.ndarray:
    return np.array(pose, np.float64)[:, :3]


def _is_time(value: object) -> bool:
    try:
        return (
            isinstance(value, str)
            and len(value) < 50
            and bool(datetime.fromisoformat(value.replace("Z", "+00:00")))
        )
    except ValueError:
        return False


def _is_table(rows: object, columns: int, least: int = 1, most: int = 1) -> bool:
    """Whether these are so many rows of so many numbers, none farther than `FARTHEST` from 0."""
    return (
        isinstance(rows, list)
        and least <= len(rows) <= most
        and all(isinstance(row, list) and len(row) == columns for row in rows)
        and all(
            isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < FARTHEST
            for row in rows
            for value in row
        )
    )


def _correction(entry: dict[str, Any]) -> Correction:
    """Of a checked entry."""
    if "polygon" in entry:
        shape: Balls | Prism = Prism(np.array(entry["polygon"], np.float64), *map(float, entry["z"]))
    else:
        groups = entry["balls"]
        shape = Balls(tuple((np.array(one["centers"], np.float64), float(one["radius"])) for one in groups))
    cameras = {name: np.array(pose, np.float64) for name, pose in entry.get("cameras", {}).items()}
    return Correction(entry["id"], entry["time"], entry["class"], shape, cameras)
