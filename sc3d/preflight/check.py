"""What is wrong with photos, positions and masks, and what to do about it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np

from sc3d.errors import InputError, examples, left_out
from sc3d.georeferencing.geotags import read_geotags
from sc3d.georeferencing.gps import Flight, read_flight, told_distance
from sc3d.io.images import check_photo
from sc3d.io.photo_folder import find_photos
from sc3d.io.readable_photos import transparent_photos
from sc3d.preflight.appearance import exposure_of, sharpness_of
from sc3d.preflight.classes import ClassCheck, check_classes, masks_to_check
from sc3d.preflight.coverage import Coverage, coverage_of, leveled
from sc3d.preflight.looks import Look, look_at_photos
from sc3d.preflight.overlap import Overlap, overlap_of
from sc3d.preflight.pairs import Pair, groups, match_photos, pairs_of_model
from sc3d.preflight.positions import jumps
from sc3d.preflight.small_model import rough_model
from sc3d.scene.photo_names import photo_name
from sc3d.scene.scene import Scene, SparseModel

MOST_MAPPED = 300  # photos that a rough model is made of; GPS of more is held against the flight's own steps
POOR = 50  # features: a photo with less shows little that can be found again


@dataclass(frozen=True)
class Finding:
    """Something that people should know. kind: one word for scripts; photos: their names; text: what; advice:
    what to do; problem: it makes the check fail; told: the photos as the line names them, if not by name
    alone.
    """

    kind: str
    photos: tuple[str, ...]
    text: str
    advice: str
    problem: bool = True
    told: tuple[str, ...] = ()

    def line(self) -> str:
        named = self.told or self.photos
        return f"{self.text}{f': {examples(named)}' if named else ''}; {self.advice}"


@dataclass(frozen=True)
class PhotoFigures:
    """Of one photo.

    sharpness: share of the fine structure of the others where they show the same; exposure: stops brighter
        than they; partners: others that show the same; overlap: share of it that the best of them shows;
        covered: share that two others show
    position: east, north, up, m, by GPS; gps_offset: m from where the cameras are
    """

    sharpness: float | None
    exposure: float | None
    partners: int
    overlap: float
    covered: float
    position: list[float] | None = None
    gps_offset: float | None = None


@dataclass(frozen=True)
class CheckResult:
    """All that was found. sizes: width and height of the photos, px."""

    photos: dict[str, PhotoFigures]
    sizes: list[tuple[int, int]]
    findings: list[Finding]
    coverage: Coverage | None = None
    classes: list[ClassCheck] = field(default_factory=list)

    @property
    def ready(self) -> bool:
        return not any(finding.problem for finding in self.findings)

    def as_json(self) -> dict[str, object]:
        """What SCENE/check.json holds."""
        coverage = self.coverage
        return {
            "ready": self.ready,
            "findings": [asdict(finding) for finding in self.findings],
            "photos": {name: asdict(figures) for name, figures in self.photos.items()},
            "coverage": coverage
            and {
                "cell": coverage.cell,
                "metric": coverage.metric,
                "enough": coverage.enough,
                "photos": coverage.photos.tolist(),
            },
            "classes": [asdict(each) | {"weakness": each.weakness} for each in self.classes],
        }


def check_folder(folder: Path, scene: Scene | None) -> CheckResult:
    """Look at all photos of a folder, and at the cameras and masks of their scene, None = there is none.

    Raises InputError for a folder without two photos that can be read.
    """
    names = [photo_name(photo, folder) for photo in find_photos(folder)]
    findings = _unreadable(folder, names)
    broken = {name for finding in findings for name in finding.photos}
    names = [name for name in names if name not in broken]
    if len(names) < 2:
        why = f"; {left_out(sorted(broken), len(names) + len(broken), 'cannot')}" if broken else ""
        raise InputError(f"{folder} holds fewer than two photos that can be used{why}")
    looks = look_at_photos(folder, names)
    tags = read_geotags(folder, names)[0]
    flight = read_flight(folder, names, quiet=True)
    model = _model(scene) if scene is not None and scene.sparse.is_dir() else None
    pairs = _pairs(folder, names, looks, flight, model)
    placed = model if model is not None else _rough(folder, names, pairs)
    centers = {view.name: view.center for view in placed.views} if placed else {}
    offsets, wrong = jumps(flight, centers) if flight else ({}, {})
    (sharpness, blurred), (exposure, exposed) = sharpness_of(looks, pairs), exposure_of(looks, pairs)
    overlap = overlap_of(len(names), pairs)
    found = {
        "blur": [name for name, bad in zip(names, blurred, strict=True) if bad],
        "exposure": [name for name, bad in zip(names, exposed, strict=True) if bad],
    }
    findings += _unregistered(names, looks, pairs, model, found)
    findings += _missing(folder, model)
    findings += _appearance(found, sharpness, exposure, names)
    findings += _gps(wrong, flight, len(tags), len(names))
    findings += _few_partners(names, overlap, findings)
    coverage = _coverage(placed, model is not None, flight)
    classes = check_classes(scene) if scene is not None and masks_to_check(scene) else []
    findings += _weak(classes)
    figures = {
        name: PhotoFigures(
            _rounded(sharpness[row]),
            _rounded(exposure[row]),
            int(overlap.partners[row]),
            round(float(overlap.best[row]), 3),
            round(float(overlap.covered[row]), 3),
            flight.positions[name].round(2).tolist() if flight and name in flight.positions else None,
            _rounded(offsets.get(name)),
        )
        for row, name in enumerate(names)
    }
    return CheckResult(figures, [look.size for look in looks], findings, coverage, classes)


def _model(scene: Scene) -> SparseModel:
    """That of a scene, its views named as their files are spelled."""
    model = scene.model
    views = [replace(view, name=photo_name(scene.photo(view.name), scene.images)) for view in model.views]
    return replace(model, views=views)


def _rounded(value: float | None) -> float | None:
    return None if value is None or not np.isfinite(value) else round(float(value), 3)


def _unreadable(folder: Path, names: list[str]) -> list[Finding]:
    """Photos that a stage would refuse, all of them, and those that show nothing."""
    refused: dict[str, str] = {}
    for name in names:
        try:
            check_photo(folder / name)
        except InputError as error:
            refused[name] = str(error)
    clear = transparent_photos({name: folder / name for name in names if name not in refused})
    findings = []
    if refused:
        text, told = f"{len(refused)} of {len(names)} photos cannot be used", tuple(refused.values())
        advice = "take them out of the folder, or copy them again"
        findings.append(Finding("unreadable", tuple(refused), text, advice, told=told))
    if clear:
        text = f"{len(clear)} of {len(names)} photos are wholly transparent"
        findings.append(
            Finding("transparent", tuple(clear), text, "save them without alpha if it is no mask")
        )
    return findings


def _pairs(
    folder: Path, names: list[str], looks: list[Look], flight: Flight | None, model: SparseModel | None
) -> list[Pair]:
    if model is not None:
        return pairs_of_model(model, {name: row for row, name in enumerate(names)})
    trusted = {name for name in names if flight and name in flight.positions and name not in flight.astray}
    positions = {row: flight.positions[name] for row, name in enumerate(names) if flight and name in trusted}
    return match_photos(folder, names, looks, positions)


def _rough(folder: Path, names: list[str], pairs: list[Pair]) -> SparseModel | None:
    return rough_model(folder, names, pairs) if pairs and len(names) <= MOST_MAPPED else None


def _coverage(model: SparseModel | None, level: bool, flight: Flight | None) -> Coverage | None:
    """level: the model is that of a scene, whose z is up; in m if it has GPS."""
    if model is None:
        return None
    points, metric = (model.points, flight is not None) if level else leveled(model, flight)
    return coverage_of(model, points, metric)


def _unregistered(
    names: list[str],
    looks: list[Look],
    pairs: list[Pair],
    model: SparseModel | None,
    found: dict[str, list[str]],
) -> list[Finding]:
    """Photos without a camera in the model, or those that will have none."""
    if model is not None:
        alone = set(names) - {view.name for view in model.views}
        what, group_of = "have no camera", dict.fromkeys(alone, 1)
    else:
        parts = sorted(groups(len(names), pairs), key=lambda group: (-len(group), min(group)))
        apart = parts[1:] if len(parts[0]) > 1 else parts
        group_of = {names[row]: len(group) for group in apart for row in group}
        alone, what = set(group_of), "will not register: they share nothing with the others"
    if not alone:
        return []
    listed = []
    for name in sorted(alone):
        why = [kind for kind in found if name in found[kind]]
        why += ["little texture"] if len(looks[names.index(name)].points) < POOR else []
        why += [f"one of {group_of[name]} that fit one another"] if group_of[name] > 1 else []
        listed.append(f"{name} ({', '.join(why)})" if why else name)
    return [
        Finding(
            "unregistered",
            tuple(sorted(alone)),
            f"{len(alone)} of {len(names)} photos {what}",
            "leave them out, or add photos between them and the others",
            told=tuple(listed),
        )
    ]


def _missing(folder: Path, model: SparseModel | None) -> Iterator[Finding]:
    """Photos that a model has and the folder has not."""
    gone = tuple(view.name for view in model.views if not (folder / view.name).is_file()) if model else ()
    if gone:
        text = f"{len(gone)} photos that have a camera are not in {folder}"
        yield Finding("missing", gone, text, "put them back: the stages need them")


def _appearance(
    found: dict[str, list[str]], sharpness: np.ndarray, exposure: np.ndarray, names: list[str]
) -> Iterator[Finding]:
    if found["blur"]:
        share = min(sharpness[names.index(name)] for name in found["blur"])
        text = f"{len(found['blur'])} of {len(names)} photos are blurred, down to {share:.0%} of the fine structure of the others"
        yield Finding(
            "blur", tuple(found["blur"]), text, "leave them out if others show the same, or take them again"
        )
    if found["exposure"]:
        stops = max((exposure[names.index(name)] for name in found["exposure"]), key=abs)
        text = f"{len(found['exposure'])} of {len(names)} photos are too dark or too bright, by up to {stops:+.1f} stops"
        yield Finding(
            "exposure",
            tuple(found["exposure"]),
            text,
            "leave them out if others show the same, or take them again",
        )


def _gps(wrong: dict[str, float], flight: Flight | None, tagged: int, number: int) -> Iterator[Finding]:
    if wrong:
        text = (
            f"GPS of {len(wrong)} of {number} photos is wrong, by up to {told_distance(max(wrong.values()))}"
        )
        yield Finding("gps", tuple(wrong), text, "correct it or take it out of their EXIF, or pass --no-gps")
    if flight is None:
        why = "no photo has GPS" if not tagged else f"GPS of {tagged} of {number} photos cannot place a model"
        text = f"{why}: the result will have no scale, no north and no place"
        yield Finding("no-gps", (), text, "pass control points (--gcp) if it shall have them", problem=False)
    elif tagged < number:
        text = f"{number - tagged} of {number} photos have no GPS that can be used"
        yield Finding("no-gps", (), text, "the others place the scene", problem=False)


def _few_partners(names: list[str], overlap: Overlap, findings: list[Finding]) -> list[Finding]:
    told = {name for finding in findings if finding.kind == "unregistered" for name in finding.photos}
    few = [
        name for name, count in zip(names, overlap.partners, strict=True) if count == 1 and name not in told
    ]
    if not few:
        return []
    text = f"{len(few)} of {len(names)} photos overlap with one other only"
    advice = "what they alone show gets no surface that others check"
    return [Finding("overlap", tuple(few), text, advice, problem=False)]


def _weak(classes: list[ClassCheck]) -> list[Finding]:
    weak = [f"{each.name} ({each.weakness})" for each in classes if each.weakness]
    if not weak:
        return []
    text = f"{len(weak)} of {len(classes)} classes will be weak: {'; '.join(weak)}"
    return [Finding("class", (), text, "draw or correct masks of more photos that show them", problem=False)]
