"""Photos that are less sharp, or darker or brighter, than the others where these show the same."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from sc3d.preflight.looks import Look
from sc3d.preflight.pairs import Pair, cells

ROUNDS = 20  # of the medians along pairs
UNUSUAL = 6.0  # standard deviations, by the median of deviations, off the other photos
BLURRED = np.log(0.7)  # and this share of the fine structure that the others have where they show the same
EXPOSED = 1.5  # and this many stops
USELESS = 0.25  # share of a photo that is white or black, when its light is unusual
LEAST_SPREAD = 0.02  # of logarithms: sets whose photos are all alike are not exact
FEW = 5  # photos: less say nothing of what is usual


def robust(values: np.ndarray) -> tuple[float, float]:
    """Median, and standard deviation by the median of absolute deviations, of the finite values."""
    finite = values[np.isfinite(values)]
    if not len(finite):
        return 0.0, np.inf
    middle = float(np.median(finite))
    return middle, max(1.4826 * float(np.median(np.abs(finite - middle))), LEAST_SPREAD)


def balanced(looks: list[Look], pairs: list[Pair], field: Callable[[Look], np.ndarray]) -> np.ndarray:
    """(N,) how much more a photo has of what `field` tells of its cells than the others where both show the
    same, 0 as a rule; nan for photos without a pair.
    """
    number = len(looks)
    total: list[list[tuple[int, float]]] = [[] for _ in range(number)]
    for pair in pairs:
        difference = (
            field(looks[pair.first])[cells(pair.points)] - field(looks[pair.second])[cells(pair.others)]
        )
        finite = difference[np.isfinite(difference)]
        if len(finite):
            median = float(np.median(finite))
            total[pair.first].append((pair.second, median))
            total[pair.second].append((pair.first, -median))
    found = np.where([bool(each) for each in total], 0.0, np.nan)
    for _ in range(ROUNDS):
        for row, each in enumerate(total):
            if each:
                found[row] = np.median([found[other] + difference for other, difference in each])
        found -= robust(found)[0]
    return found


def _whole(looks: list[Look], field: Callable[[Look], np.ndarray]) -> np.ndarray:
    """(N,) medians over whole photos; nan where nothing can be said."""
    fields = [field(look) for look in looks]
    return np.array(
        [np.median(each[np.isfinite(each)]) if np.isfinite(each).any() else np.nan for each in fields]
    )


def relative(
    looks: list[Look], pairs: list[Pair], field: Callable[[Look], np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """(N,) of each photo against the others, and how many standard deviations that is unusual: where they
    show the same if it has pairs, against whole photos otherwise.
    """
    value, whole = balanced(looks, pairs, field), _whole(looks, field)
    unpaired = np.isnan(value)
    (_, spread), (middle, whole_spread) = robust(value), robust(whole)
    if (~unpaired).sum() < FEW:
        unpaired[:] = True
    value = np.where(unpaired, whole - middle, value)
    return value, value / np.where(unpaired, whole_spread, spread)


def sharpness_of(looks: list[Look], pairs: list[Pair]) -> tuple[np.ndarray, np.ndarray]:
    """(N,) share of the fine structure of the others that each photo has; (N,) bool: blurred."""
    value, unusual = relative(looks, pairs, lambda look: look.sharpness)
    blurred = (unusual < -UNUSUAL) & (value < BLURRED) & (len(looks) >= FEW)
    return np.exp(value), blurred


def exposure_of(looks: list[Look], pairs: list[Pair]) -> tuple[np.ndarray, np.ndarray]:
    """(N,) stops that each photo is brighter than the others; (N,) bool: too dark or too bright."""
    value, unusual = relative(looks, pairs, lambda look: look.brightness)
    lost = np.array([max(look.white, look.black) for look in looks])
    middle, spread = robust(lost)
    useless = (lost > USELESS) & (lost - middle > UNUSUAL * spread)
    wrong = (np.abs(unusual) > UNUSUAL) & (np.abs(value) > EXPOSED)
    return value, (wrong | useless) & (len(looks) >= FEW)
