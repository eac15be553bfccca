"""The scene folder: where every file of a scene lies, and the cameras in it."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sc3d.errors import InputError, examples
from sc3d.io.images import check_photo, image_size, read_image, read_opaque
from sc3d.io.limits import FARTHEST, MAX_MASK_PIXELS
from sc3d.io.mask_images import index_image_size, mask_orientation, turned_onto
from sc3d.io.orientation import turned_size
from sc3d.io.photo_folder import broken_link, find_photos, list_photos, require_within
from sc3d.scene.class_table import CONTROL, OTHER, UNJUDGED, ClassTable, read_classes
from sc3d.scene.mask_values import (
    Meanings,
    judged_labels,
    meanings_of,
    meanings_of_truth,
    read_confidence,
    read_labels,
)
from sc3d.scene.photo_names import PhotoNames, files_of_photos, photo_name

if TYPE_CHECKING:
    from sc3d.geometry.cameras import View

logger = logging.getLogger(__name__)


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
    def depth(self) -> Path:
        return self.path / "depth"

    @property
    def gaussians(self) -> Path:
        return self.path / "gaussians.ply"

    @property
    def mesh(self) -> Path:
        return self.path / "mesh.ply"

    @property
    def unconfirmed(self) -> Path:
        """Mesh of the surface that no second photo confirms: it hides things and takes labels, no more."""
        return self.path / "unconfirmed.ply"

    @property
    def surface(self) -> tuple[Path, Path]:
        """All that rays hit; the second only beside the first, and neither need exist."""
        return self.mesh, self.unconfirmed

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
    def corrections(self) -> Path:
        return self.path / "corrections.json"

    @property
    def metrics(self) -> Path:
        return self.path / "metrics.json"

    @property
    def check(self) -> Path:
        return self.path / "check.json"

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
            if path.is_symlink() and not path.exists():
                raise InputError(broken_link(path))
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
        """Path of the photo that a view is named after; its file may be spelled otherwise (see `_spellings`)."""
        path = self.images / name
        return path if path.exists() else self.images / self._spellings.get(name, name)

    def read_photo(self, name: str) -> np.ndarray:
        """(H, W, 3) uint8 RGB pixels of a photo as stored."""
        return read_image(self.photo(name), self.images)

    def read_mask(self, file: Path, name: str) -> np.ndarray:
        """(H, W) uint8 class ids of a mask of a photo, in the photo's frame as stored, 0 where the photo is
        transparent.
        """
        return self._onto_photo(read_labels(file, self._meanings), file, name)

    def read_truth(self, file: Path, name: str, zero_margin: float | None = None) -> np.ndarray:
        """(H, W) uint8 of a truth mask of a photo, in the photo's frame as stored: ids and `OTHER`; 0 = not
        judged, as where the photo is transparent. zero_margin: as in `judged_labels`
        """
        table, meanings = self._truth_meanings
        return self._onto_photo(judged_labels(read_labels(file, meanings), table, zero_margin), file, name)

    def read_confidence(self, file: Path, name: str) -> np.ndarray:
        """(H, W) uint8 of a confidence map, as `read_mask`."""
        return self._onto_photo(read_confidence(file), file, name)

    @cached_property
    def _meanings(self) -> Meanings:
        return meanings_of(self.class_table())

    @cached_property
    def _truth_meanings(self) -> tuple[ClassTable, Meanings]:
        table = self.class_table()
        return table, meanings_of_truth(table)

    def _onto_photo(self, pixels: np.ndarray, file: Path, name: str) -> np.ndarray:
        mask = turned_onto(pixels, file, self.photo(name))
        opaque = self.opaque_pixels_of(mask.shape, name)
        return mask if opaque.all() else np.where(opaque, mask, 0).astype(np.uint8)

    def opaque_pixels_of(self, shape: tuple[int, int], name: str) -> np.ndarray:
        """(H, W) bool pixels of a mask of this shape, in the photo's frame as stored, where it is opaque."""
        opaque = self._opaque(name)
        if opaque is None:
            return np.ones(shape, bool)
        rows, columns = (
            (np.arange(size) * whole) // size for size, whole in zip(shape, opaque.shape, strict=True)
        )
        return opaque[np.ix_(rows, columns)]

    def mask_size(self, file: Path, name: str) -> tuple[int, int]:
        """(width, height) of what `read_mask` gives, from the header."""
        return index_image_size(file, self.photo(name))

    def opaque_pixels(self, view: View, target: View) -> np.ndarray | None:
        """(H, W) bool pixels of `target`, a view of the same pose, that lie in the photo of `view` and are
        opaque there; None if all are.
        """
        from sc3d.geometry.cameras import in_photo, resample

        opaque, inside = self._opaque(view.name), in_photo(view, target)
        if opaque is None:
            return inside
        shown = resample(opaque.astype(np.uint8), view, target, labels=True) > 0
        return shown if inside is None else shown & inside

    def _opaque(self, name: str) -> np.ndarray | None:
        photo = self.photo(name)
        return read_opaque(photo) if photo.is_file() else None

    @cached_property
    def photo_names(self) -> PhotoNames:
        """All photos: those in `images/`, and those that cameras are named after."""
        spelled = set(self._spellings.values())
        return PhotoNames([name for name in self._listed if name not in spelled] + self._named)

    @cached_property
    def _listed(self) -> list[str]:
        photos = list_photos(self.images) if self.images.is_dir() else []
        return [photo_name(photo, self.images) for photo in photos]

    @cached_property
    def _named(self) -> list[str]:
        return [view.name for view in self.model.views] if self.sparse.is_dir() else []

    @cached_property
    def _spellings(self) -> dict[str, str]:
        """Photos in `images/` by the names of views that differ from theirs in letter case or Unicode form,
        which Windows and macOS do not tell apart.
        """
        others = PhotoNames(set(self._listed) - set(self._named))
        missing = set(self._named) - set(self._listed)
        found = {name: others.same_letters(name) for name in missing}
        return {name: photos[0] for name, photos in found.items() if len(photos) == 1}

    def mask_files(
        self, folder: Path, class_table: ClassTable | None = None, truth: bool = False
    ) -> dict[str, Path]:
        """Masks (or truth masks: `truth`, or confidence maps) of the views, by view name; all checked. Those
        of photos without a camera are left out; `warn_of_unplaced` says so.

        Raises InputError for an empty folder, a mask without a photo, one that fits several photos, another
        aspect than the photo, or ids outside the class table.
        """
        sizes = {view.name: (view.width, view.height) for view in self.model.views}
        return match_masks(folder, sizes, class_table, self.photo_names, self.images, truth)

    def mask_file(self, folder: Path, name: str) -> Path | None:
        """The mask of one photo in a folder, not looked into; None if there is none."""
        return self.photo_names.find(folder, name) or find_masks(folder, self.photo_names, strict=False).get(
            name
        )

    def warn_of_unplaced(self, *folders: Path) -> None:
        """Say in one line how many masks, or other images, in `folders` are of photos without a camera, if
        there is a model.
        """
        if not self.sparse.is_dir():
            return
        placed, unplaced = {view.name for view in self.model.views}, set()
        counts = []
        for folder in filter(Path.is_dir, folders):
            names = set(find_masks(folder, self.photo_names, strict=False)) - placed
            unplaced |= names
            counts += [f"{folder.name} {len(names)}"] if names else []
        if unplaced:
            logger.warning(
                "%d photos have no camera, as they did not register: "
                "what belongs to them is left out (%s), such as %s",
                len(unplaced),
                ", ".join(counts),
                examples(sorted(unplaced)),
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

    colmap.warn_of_larger(path)
    model = colmap.load_model(path)
    cameras = colmap.copy_cameras(model)
    point_ids, xyz, colors = colmap.point_arrays(model)
    views, tracks = [], []
    for image in colmap.registered_images(model):
        _check_name(image.name, path)
        views.append(View(image.name, cameras[image.camera_id], colmap.cam_from_world(image)))
        rows = colmap.observed_rows(image, point_ids)
        tracks.append(np.unique(rows[rows >= 0]))
    if len({view.name for view in views}) < len(views):
        raise InputError(f"{path}: two photos share a name")
    if not (np.abs(xyz) < FARTHEST).all():
        raise InputError(
            f"{path} holds positions that are not finite numbers, or more than {FARTHEST:g} from the origin"
        )
    return SparseModel(views, xyz, colors, tracks)


def find_masks(folder: Path, names: PhotoNames, strict: bool = True) -> dict[str, Path]:
    """Files of a folder of masks by photo name, none looked into yet: each at its photo's path with the
    suffix .png, or named so that it can mean one photo alone (see `sc3d.scene.photo_names`).

    Raises InputError for a file that belongs to no photo or to several, and for two of one photo; without
    `strict`, they are passed over.
    """
    found: dict[str, Path] = {}
    for file in files_of_photos(folder, names, (".png",)):
        photos = names.match_file(photo_name(file, folder), folder)
        if len(photos) == 1 and photos[0] not in found:
            found[photos[0]] = file
        elif strict:
            raise InputError(_misfit(file, folder, names, photos, found))
    return found


def _misfit(
    file: Path, folder: Path, names: PhotoNames, photos: tuple[str, ...], found: dict[str, Path]
) -> str:
    """Why a mask cannot be given to a photo; photos: those that it may mean; found: what they have already."""
    if not photos:
        advice = names.advice(photo_name(file, folder))
        example = next(iter(names.names), "none")
        return f"{file} belongs to no photo: {len(names)} photos are known, such as {example}{advice}"
    if len(photos) > 1:
        return f"{file} may belong to {names.choices(photos)}: rename it"
    return f"{found[photos[0]]} and {file} both belong to {photos[0]}: remove one"


def match_masks(
    folder: Path,
    photo_sizes: dict[str, tuple[int, int]],
    class_table: ClassTable | None,
    names: PhotoNames | None = None,
    photos: Path | None = None,
    truth: bool = False,
) -> dict[str, Path]:
    """Match the files of a folder of masks to photos and check them.

    photo_sizes: (width, height) px as stored by photo name; photos: their folder, for their EXIF orientation
    truth: truth masks, which may hold `OTHER` and `UNJUDGED` beside the ids of the table
    names: all photos, of which those without a size are not checked and not returned; None = no others
    returns: path of the mask by photo name, for photos that have one
    """
    found = find_masks(folder, PhotoNames(photo_sizes) if names is None else names)
    if not found:
        raise InputError(f"no masks in {folder}: PNG files named like the photos are expected")
    matched = {name: file for name, file in found.items() if name in photo_sizes}
    if not matched:
        raise InputError(
            f"none of the {len(found)} masks in {folder} is of a photo with a camera: "
            f"the model has {len(photo_sizes)}, such as {next(iter(photo_sizes), 'none')}"
        )
    meaning, turns = meanings_of_truth if truth else meanings_of, list[str]()
    meanings = None if class_table is None else meaning(class_table)
    reserved = {OTHER, UNJUDGED} if meanings is not None and meanings.truth else set[int]()
    for name, file in matched.items():
        require_within(file, folder)
        turn, assumed = mask_orientation(file, None if photos is None else photos / name)
        if assumed:
            turns.append(name)
        check_mask_aspect(file, turned_size(image_size(file), turn), photo_sizes[name])
        if class_table is not None and meanings is not None:
            unknown = [
                label for label in class_table.unknown(read_labels(file, meanings)) if label not in reserved
            ]
            if unknown:
                raise InputError(
                    f"{file} has class id {unknown[0]}, which is not in the class table "
                    f"(ids {[entry.id for entry in class_table]}){_advice(unknown[0], truth)}"
                )
    if class_table is not None:
        tell_of_turned(folder, len(turns), *turns[:1])
    return matched


def _advice(unknown: int, truth: bool) -> str:
    if unknown < OTHER:
        return ""
    rule = f"{OTHER} is other and {UNJUDGED} not judged in truth masks alone"
    return f"; {rule}" + (f", if all classes have ids up to {OTHER - 1}" if truth else "")


@cache  # tiles look at the same masks again and again
def tell_of_turned(source: Path, count: int, example: str = "") -> None:
    """Warn of masks that lie as their photos are shown by a rule alone (`sc3d.io.orientation`), and name one
    of the photos.
    """
    if count:
        logger.warning(
            "%s: %d masks (such as that of %s) are of photos that EXIF turns, and are read as drawn on the photo as it is shown; "
            "if they lie on the pixels as stored, give them the EXIF orientation of their photo",
            source,
            count,
            example,
        )


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


def require_views(scene: Scene) -> None:
    """InputError unless two photos at least have a camera, and, where the model tells what they see, two see the
    same: no surface comes from less. What sees nothing that others see is told.
    """
    model = scene.model
    if len(model.views) < 2:
        raise InputError(
            f"{scene.sparse} has {len(model.views)} photos with a camera: a surface needs at least 2 that overlap; take more photos, or run `sc3d reconstruct` again"
        )
    if not any(len(track) for track in model.tracks):
        return
    times = np.bincount(np.concatenate(model.tracks), minlength=len(model.points))
    alone = [
        view.name
        for view, track in zip(model.views, model.tracks, strict=True)
        if not (times[track] > 1).any()
    ]
    if len(alone) == len(model.views):
        raise InputError(
            f"no two photos of {scene.sparse} see the same sparse point: a surface needs at least 2 that overlap"
        )
    if alone:
        logger.warning(
            "%d of %d photos share no sparse point with another, so that nothing checks their depth: %s",
            len(alone),
            len(model.views),
            examples(alone),
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
    return {photo_name(photo, folder): image_size(photo) for photo in find_photos(folder)}


def _check_name(name: str, origin: Path) -> None:
    path = Path(name)
    if not path.name or path.is_absolute() or ".." in path.parts or "\\" in name or CONTROL.search(name):
        raise InputError(f"{origin} names the photo {name!r}, which lies outside the scene")
