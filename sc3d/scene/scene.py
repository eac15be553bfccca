"""The scene folder: where every file of a scene lies, and the cameras in it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from sc3d.errors import InputError
from sc3d.io.images import check_photo, find_photos, image_size, read_index_image, require_within
from sc3d.io.limits import FARTHEST, MAX_MASK_PIXELS
from sc3d.scene.class_table import CONTROL, ClassTable, read_classes


@dataclass(frozen=True)
class Scene:
    """A scene folder; the properties are paths that may or may not exist yet."""

    path: Path

    @property
    def images(self) -> Path:
        return self.path / "images"

    @property
    def sparse(self) -> Path:
        return self.path / "sparse" / "0"

    @property
    def mapped(self) -> Path:
        """The model before it is brought to its place."""
        return self.path / "mapped"

    @property
    def gaussians(self) -> Path:
        return self.path / "gaussians.ply"

    @property
    def mesh(self) -> Path:
        return self.path / "mesh.ply"

    @property
    def cloud(self) -> Path:
        return self.path / "cloud.ply"

    @property
    def classes(self) -> Path:
        return self.path / "classes.json"

    @property
    def masks(self) -> Path:
        return self.path / "masks"

    @property
    def confidence(self) -> Path:
        return self.path / "confidence"

    @property
    def confidence_refined(self) -> Path:
        return self.path / "confidence_refined"

    @property
    def strokes(self) -> Path:
        return self.path / "strokes"

    @property
    def instances(self) -> Path:
        return self.path / "instances"

    @property
    def export(self) -> Path:
        return self.path / "export"

    @property
    def labelled_splats(self) -> Path:
        return self.export / "splats.ply"

    @property
    def truth(self) -> Path:
        return self.path / "truth"

    @property
    def votes(self) -> Path:
        return self.path / "votes.npz"

    def votes_of(self, output: Path | None) -> Path:
        """The voxel field beside an output of `label`: votes.npz, or a name of its own."""
        return self.votes if output is None else output.with_suffix(".votes.npz")

    @property
    def seeds(self) -> Path:
        return self.path / "seeds.ply"

    @property
    def labelled(self) -> Path:
        return self.path / "labelled.ply"

    @property
    def metrics(self) -> Path:
        return self.path / "metrics.json"

    @property
    def report(self) -> Path:
        return self.path / "report.html"

    @property
    def best_cloud(self) -> Path | None:
        """The labelled cloud, else the seeds, else the bare cloud; None if there is none."""
        return next((path for path in (self.labelled, self.seeds, self.cloud) if path.exists()), None)

    def require(self, *paths: Path, hint: str) -> None:
        """Raise InputError naming the first of `paths` that is missing, and what to do."""
        if not self.path.is_dir():
            raise InputError(f"the scene folder {self.path} does not exist")
        for path in paths:
            if not path.exists():
                raise InputError(f"{path} is missing: {hint}")

    def class_table(self) -> ClassTable:
        """The scene's classes."""
        return read_classes(self.classes)

    @cached_property
    def model(self) -> SparseModel:
        """Cameras and sparse points of `sparse/0`."""
        return read_sparse_model(self.sparse)

    def photo(self, name: str) -> Path:
        """Path of the photo that a view is named after."""
        return self.images / name

    def mask_files(self, folder: Path, class_table: ClassTable | None = None) -> dict[str, Path]:
        """Masks (or truth masks, or confidence maps) of the views, by view name; all checked.

        Raises InputError for an empty folder, a mask without a view, another aspect than the photo, or ids
        outside the class table.
        """
        return match_masks(
            folder, {view.name: (view.width, view.height) for view in self.model.views}, class_table
        )


@dataclass(frozen=True)
class SparseModel:
    """A COLMAP model: M views and P points.

    views: ordered by name
    points: (P, 3) float64 world; colors: (P, 3) uint8
    tracks: per view, (K,) int rows of `points` that it sees
    """

    views: list
    points: np.ndarray
    colors: np.ndarray
    tracks: list[np.ndarray]


def read_sparse_model(path: Path) -> SparseModel:
    """Read a COLMAP model, binary or text; InputError if it is missing, broken or names photos outside the
    scene.
    """
    from sc3d.geometry.cameras import View
    from sc3d.io import colmap

    model = colmap.load_model(path)
    cameras = colmap.copy_cameras(model)
    point_ids, xyz, colors = colmap.point_arrays(model)
    views, tracks = [], []
    for image in colmap.registered_images(model):
        _check_name(image.name, path)
        views.append(View(image.name, cameras[image.camera_id], colmap.cam_from_world(image)))
        rows = colmap.observed_rows(image, point_ids)
        tracks.append(np.unique(rows[rows >= 0]))
    stems = [Path(view.name).stem for view in views]
    if len(set(stems)) < len(stems):
        raise InputError(
            f"{path}: two photos share a name up to the suffix, by which masks are found; rename one"
        )
    if not (np.abs(xyz) < FARTHEST).all():
        raise InputError(
            f"{path} holds positions that are not finite numbers, or more than {FARTHEST:g} from the origin"
        )
    return SparseModel(views, xyz, colors, tracks)


def match_masks(
    folder: Path, photo_sizes: dict[str, tuple[int, int]], class_table: ClassTable | None
) -> dict[str, Path]:
    """Match `<photo stem>.png` files of a folder to photos and check them.

    photo_sizes: (width, height) px by photo name
    returns: path of the mask by photo name, for photos that have one
    """
    files = (
        sorted(
            file
            for file in folder.iterdir()
            if file.suffix.lower() == ".png" and not file.name.startswith(".")
        )
        if folder.is_dir()
        else []
    )
    if not files:
        raise InputError(f"no masks in {folder}: PNG files named like the photos are expected")
    names = {Path(name).stem: name for name in photo_sizes}
    matched: dict[str, Path] = {}
    for file in files:
        name = names.get(file.stem)
        if name is None:
            raise InputError(
                f"{file} belongs to no photo: {len(names)} photos are known, such as {next(iter(photo_sizes))}"
            )
        require_within(file, folder)
        check_mask_aspect(file, image_size(file), photo_sizes[name])
        if class_table is not None:
            unknown = class_table.unknown(read_index_image(file))
            if unknown:
                raise InputError(
                    f"{file} has class id {unknown[0]}, which is not in the class table (ids {[entry.id for entry in class_table]})"
                )
        matched[name] = file
    return matched


def check_mask_aspect(file: Path | str, mask_size: tuple[int, int], photo_size: tuple[int, int]) -> None:
    """Raise InputError unless a mask has the aspect of its photo within 1 px of the smaller of the two."""
    (width, height), (photo_width, photo_height) = mask_size, photo_size
    if width * height > max(MAX_MASK_PIXELS, photo_width * photo_height):
        raise InputError(
            f"{file} is {width}x{height}, but its photo is {photo_width}x{photo_height}: more than {MAX_MASK_PIXELS // 10**6} megapixels are refused"
        )
    scale = min(1.0, min(photo_width / width, photo_height / height))
    if abs(width * photo_height - height * photo_width) * scale > max(photo_width, photo_height):
        raise InputError(
            f"{file} is {width}x{height}, but its photo is {photo_width}x{photo_height}: the aspect must be the same within 1 px"
        )


def check_photos(scene: Scene, names: list[str]) -> None:
    """Raise InputError if a photo of the model is not in `images/`, cannot be read, is cut off, or is a link
    that leads elsewhere.
    """
    for name in names:
        check_photo(scene.photo(name))
        require_within(scene.photo(name), scene.images)


def photo_sizes(folder: Path) -> dict[str, tuple[int, int]]:
    """(width, height) of all photos of a folder, by name relative to it."""
    return {str(photo.relative_to(folder)): image_size(photo) for photo in find_photos(folder)}


def _check_name(name: str, origin: Path) -> None:
    path = Path(name)
    if not path.name or path.is_absolute() or ".." in path.parts or "\\" in name or CONTROL.search(name):
        raise InputError(f"{origin} names the photo {name!r}, which lies outside the scene")
