"""What every importer returns, and which importer reads a path."""

from __future__ import annotations

import importlib
import logging
from collections.abc import Collection
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pycolmap

from sc3d.errors import InputError, examples
from sc3d.geometry.cameras import View
from sc3d.georeferencing.georeference import Georeference, read_georeference
from sc3d.io.limits import FARTHEST
from sc3d.scene.scene import Scene
from sc3d.settings.reconstruction import Import

logger = logging.getLogger(__name__)

# in the order in which they are tried
PROGRAMS = ("nerfstudio", "opensfm", "odm", "metashape", "pix4d", "opf", "colmap")
MODULES = {"odm": "opensfm"}


@dataclass(frozen=True)
class Project:
    """A reconstruction of another program, in one frame.

    program: one of PROGRAMS; views: named as the project names its photos, which may be without folder or
        suffix
    points, colors: (P, 3) float64 world; (P, 3) uint8
    observations: per view, rows of `points` that it sees (K,) and where (K, 2) px; None = the project does
        not say
    photos: folder that the names are relative to; None = unknown
    georeference: of the frame; notes: for the summary
    model: the COLMAP model that all this was read from, whose further contents are kept; None = another
        program's
    offset: (3,) what was subtracted from the coordinates of `model`
    left_out: names of the photos that are not among the views, by reason
    """

    program: str
    views: list[View]
    points: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    colors: np.ndarray = field(default_factory=lambda: np.zeros((0, 3), np.uint8))
    observations: list[tuple[np.ndarray, np.ndarray]] | None = None
    photos: Path | None = None
    georeference: Georeference | None = None
    notes: dict[str, object] = field(default_factory=dict)
    model: pycolmap.Reconstruction | None = None
    offset: np.ndarray = field(default_factory=lambda: np.zeros(3))
    left_out: dict[str, list[str]] = field(default_factory=dict)

    def without(self, rows: Collection[int], reason: str) -> Project:
        """The project without the views of some rows; `model` goes if there are any, as it holds them."""
        if not rows:
            return self
        out = set(rows)
        kept = [row for row in range(len(self.views)) if row not in out]
        names = [self.views[row].name for row in sorted(rows)]
        return replace(
            self,
            views=[self.views[row] for row in kept],
            observations=None if self.observations is None else [self.observations[row] for row in kept],
            model=None,
            left_out=self.left_out | {reason: self.left_out.get(reason, []) + names},
        )

    def counts_left_out(self) -> dict[str, int]:
        """How many photos are left out, by reason."""
        return {reason: len(names) for reason, names in self.left_out.items()}


def warn_of_left_out(project: Project, path: Path) -> None:
    """Say in one line how many photos are left out, why, and which."""
    count = sum(project.counts_left_out().values())
    if count:
        logger.warning(
            "%s: %d of %d photos left out: %s",
            path,
            count,
            count + len(project.views),
            _told(project),
        )


def _told(project: Project) -> str:
    return "; ".join(
        f"{len(names)} {reason} ({examples(names)})" for reason, names in project.left_out.items()
    )


def read_project(path: Path, settings: Import) -> Project:
    """Read a project with the importer that `settings.source` names, or the first that knows the path.
    InputError if none does.
    """
    try:
        project = find_importer(path, settings.source).read(path, settings)
    # other values than the importer looks for
    except (
        AttributeError,
        TypeError,
        LookupError,
        ValueError,
        ArithmeticError,
        np.linalg.LinAlgError,
    ) as error:
        raise InputError(
            f"{path} is damaged or of another layout: {type(error).__name__}, {str(error)[:200]}"
        ) from error
    if not project.views:
        told = f" ({_told(project)})" if project.left_out else ""
        raise InputError(f"{path} has no photo with a position{told}: orient the photos first")
    folder = path if path.is_dir() else path.parent
    # as our own exports have it beside them
    return (
        project if project.georeference else replace(project, georeference=read_georeference(Scene(folder)))
    )


def project_files(path: Path, settings: Import) -> list[Path]:
    """Files of a project that `read_project` reads; some may not exist."""
    return find_importer(path, settings.source).files(path)


def find_importer(path: Path, source: str) -> ModuleType:
    """The module of sc3d.importers that reads a path: that of `source`, or for "auto" the first that knows
    the path. InputError if none does.
    """
    names = PROGRAMS if source == "auto" else (source,)
    modules = [importlib.import_module(f"sc3d.importers.{MODULES.get(name, name)}") for name in names]
    for module in modules:
        if module.matches(path):
            return module
    if source == "auto":
        raise InputError(
            f"{path} is no project that is known here: transforms.json (nerfstudio), an OpenSfM or ODM folder, cameras as XML (Metashape), "
            "*_calibrated_camera_parameters.txt (Pix4D), a .opf file or a COLMAP model is expected"
        )
    raise InputError(f"{path} is no {source} project: {modules[0].EXPECTED}")


def require_found(found: Path | None, path: Path, expected: str) -> Path:
    """What an importer looks for in a path; InputError that says what is `expected` if it is not there."""
    if found is None:
        raise InputError(f"{path} is another project: {expected}")
    return found


def rigid(rotation: np.ndarray, center: np.ndarray, where: str) -> np.ndarray:
    """(4, 4) cam_from_world of a camera at `center` (3,); `rotation` (3, 3) cam from world up to rounding.
    InputError if it is none.
    """
    if not np.isfinite(rotation).all() or not (np.abs(center) < FARTHEST).all():
        raise InputError(
            f"{where}: orientation or position is not made of finite numbers, or is more than {FARTHEST:g} from the origin"
        )
    left, stretch, right = np.linalg.svd(np.asarray(rotation, np.float64))
    if not np.isfinite(stretch).all() or abs(stretch - 1).max() > 0.01 or np.linalg.det(rotation) < 0:
        raise InputError(f"{where}: the orientation is no rotation")
    matrix = np.eye(4)
    matrix[:3, :3] = left @ right
    matrix[:3, 3] = -matrix[:3, :3] @ center
    return matrix
