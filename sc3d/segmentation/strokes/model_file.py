"""What strokes taught, as a part of a site model: networks, forests and what passes for known, as arrays."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, fields
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from sc3d.errors import InputError
from sc3d.scene.class_table import ClassTable
from sc3d.scene.site_model import ModelPart
from sc3d.segmentation.strokes.backend import Strokes, StrokesSettings
from sc3d.segmentation.strokes.features import pixel_features
from sc3d.segmentation.strokes.forest import Forest
from sc3d.segmentation.strokes.novelty import FeatureSpace, Novelty

MAX_MEMBERS = 16
SCALING = ("low", "high", "center", "scale")
SPACE = ("center", "scale", "axes", "sizes")
# settings that act on photos; the others only on training
USED = ("max_size", "unsure", "radius", "smoothing")


def to_part(strokes: Strokes) -> ModelPart:
    """The part that `from_part` reads."""
    classifier, novelty = strokes.classifier, strokes.novelty
    arrays = {"codes": strokes.label_of_code}
    arrays |= {name: getattr(classifier, name) for name in SCALING}
    for index, member in enumerate(classifier.members):
        for number, values in enumerate(member.parameters()):
            arrays[f"member{index}_layer{number}"] = values
        for entry in fields(Forest):
            arrays[f"member{index}_{entry.name}"] = _folded(getattr(member.forest, entry.name))
    facts = {"members": len(classifier.members), "temperature": strokes.temperature}
    facts |= {name: value for name, value in asdict(strokes.settings).items() if name in USED}
    if novelty is not None:
        arrays |= {f"novelty_{name}": getattr(novelty.space, name) for name in SPACE}
        arrays["novelty_known"] = novelty.known.data
        facts |= {"reach": novelty.reach, "rest": novelty.space.rest}
    return ModelPart(facts, arrays)


def from_part(part: ModelPart, table: ClassTable, origin: Path) -> Strokes:
    """The segmenter that a model holds; InputError if it does not hold what it should. origin: its file"""
    try:
        return _read(part, table)
    except (KeyError, ValueError, TypeError, IndexError, RuntimeError) as error:
        raise InputError(f"{origin} is damaged: what strokes taught cannot be read ({error})") from None


def _read(part: ModelPart, table: ClassTable) -> Strokes:
    from sc3d.segmentation.strokes.pixel_classifier import Member, PixelClassifier

    facts, arrays = part.facts, part.arrays
    count, codes = facts["members"], arrays["codes"].astype(np.uint8)
    if not isinstance(count, int) or not 1 <= count <= MAX_MEMBERS:
        raise ValueError("members")
    if len(codes) < 2 or table.unknown(codes):
        raise ValueError("classes")
    num_features = pixel_features(np.zeros((2, 2, 3), np.uint8)).shape[-1]
    scaling = [_shaped(arrays[name], (num_features,)) for name in SCALING]
    members = []
    for index in range(count):
        values = {entry.name: arrays[f"member{index}_{entry.name}"] for entry in fields(Forest)}
        forest = _forest(values, len(codes))
        if not forest.fits(num_features, len(codes)):
            raise ValueError("trees")
        layers = [arrays[f"member{index}_layer{number}"] for number in range(Member.NUM_PARAMETERS)]
        members.append(Member.from_parameters(num_features, len(codes), layers, forest))
    settings = StrokesSettings(**{name: facts[name] for name in USED})
    if not (1 <= settings.max_size <= 65536 and 1 <= settings.radius <= 1024 and settings.smoothing > 0):
        raise ValueError("settings")
    classifier = PixelClassifier(tuple(members), *scaling)
    strokes = Strokes(classifier, _novelty(facts, arrays, num_features), codes, settings)
    strokes.temperature = float(facts["temperature"])
    if not 0 < strokes.temperature < 100:
        raise ValueError("temperature")
    return strokes


def _novelty(facts: dict, arrays: Mapping[str, np.ndarray], num_features: int) -> Novelty | None:
    if "novelty_known" not in arrays:
        return None
    known, axes = arrays["novelty_known"], arrays["novelty_axes"]
    center, scale = (_shaped(arrays[f"novelty_{name}"], (num_features,)) for name in ("center", "scale"))
    sizes = _shaped(arrays["novelty_sizes"], (len(axes),))
    _shaped(axes, (len(axes), num_features))
    _shaped(known, (len(known), len(axes) + 1))
    reach, rest = float(facts["reach"]), float(facts["rest"])
    if not (reach > 0 and rest > 0):
        raise ValueError("reach")
    return Novelty(FeatureSpace(center, scale, axes, sizes, rest), cKDTree(known), reach)


def _shaped(values: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    if values.shape != shape or not np.isfinite(values).all():
        raise ValueError(f"an array of shape {values.shape} where {shape} is expected")
    return values


ROW = 1024  # values; arrays are read up to some length only


def _folded(values: np.ndarray) -> np.ndarray:
    """As rows of ROW values, filled with zeros; the first value is the number of those that count."""
    flat = np.concatenate([[values.size], values.ravel()])
    return np.pad(flat, (0, -len(flat) % ROW)).reshape(-1, ROW)


def _unfolded(values: np.ndarray) -> np.ndarray:
    flat = values.ravel()
    return flat[1 : 1 + int(flat[0])]


def _forest(values: dict[str, np.ndarray], num_codes: int) -> Forest:
    flat = {name: _unfolded(array) for name, array in values.items()}
    return Forest(
        flat["starts"].astype(np.int64),
        flat["feature"].astype(np.int32),
        flat["threshold"].astype(np.float64),
        flat["children"].astype(np.int32).reshape(-1, 2),
        flat["values"].astype(np.float64).reshape(-1, num_codes),
    )
