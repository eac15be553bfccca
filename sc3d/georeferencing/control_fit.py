"""The similarity between a model and surveyed points, whose accuracy nobody knows and some of which are wrong.

Points as good as the cameras are fitted as they are. Of others the accuracy is estimated from the fit that half of
them agree on best (least median of squares, Rousseeuw 1984), or given; then they are weighted by it. Heights that
are all the same, or worth nothing, leave the tilt open: up is then that of the cameras.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from sc3d.errors import InputError
from sc3d.georeferencing.alignment import Similarity, fit_similarity, fit_similarity_robust, subsets

MIN_POINTS = 3
MIN_SHARE = (
    0.6  # of the points must fit, if they are worse than the cameras; more than half if they are as good
)
FEW_BLUNDERS = 0.25  # share of points that may be wrong before the accuracy of all is in doubt
LARGEST_RMS = 0.2  # of the extent of the points: nothing fits that fits no better,
LARGEST_CHANCE = 0.01  # or that well by chance more often than this
LINE = 0.02  # width over length of points on a line
TILT = np.radians(5.0)  # points at one height are believed if the cameras stand no more askew on them
# of the norm of 2 and 3 normal deviates: its median, and what 1 % exceeds
NORMAL_MEDIAN, NORMAL_LIMIT = {2: 1.177, 3: 1.538}, {2: 3.035, 3: 3.368}
NUM_PARAMETERS = {2: 4, 3: 7}

Accuracy = tuple[float, float]  # standard deviations, m: horizontal, vertical
Fitter = Callable[[np.ndarray, np.ndarray], Similarity]


@dataclass(frozen=True)
class Correspondences:
    """Points by the model and by the survey.

    source: (U, 3) model frame; target: (U, 3) ENU, m; up: (3,) of the cameras, model frame
    tolerance: m, what points as good as the cameras may miss; accuracy: of the survey, None = not stated
    level: all heights are the same, so they were not measured
    """

    source: np.ndarray
    target: np.ndarray
    up: np.ndarray
    tolerance: float
    accuracy: Accuracy | None
    level: bool


@dataclass(frozen=True)
class ControlFit:
    """A similarity from model to ENU and what it rests on.

    kept: (U,) bool, the points that it was fitted to; accuracy: theirs, given or estimated
    exact: they are as good as the cameras, which may be bent onto them
    upright: up is that of the cameras, heights had no say
    leave_one_out: (K,) distance, m, of each of the kept from the fit of the others (horizontal if upright):
        what the model is worth between them; None with too few
    """

    similarity: Similarity
    kept: np.ndarray
    accuracy: Accuracy
    exact: bool
    upright: bool
    leave_one_out: np.ndarray | None


def fit_control_points(points: Correspondences, names: list[str]) -> ControlFit:
    """Robust similarity from model to ENU. names: of the points, for messages; InputError if nothing fits, or the
    points lie on one line
    """
    found = _exact(points)
    if found is None or (~found.kept).mean() > FEW_BLUNDERS:
        loose = _loose(points)
        if loose is not None and (found is None or loose.kept.sum() > found.kept.sum()):
            found = loose
    if found is None:
        raise InputError(_refusal(points, names))
    kept = points.target[found.kept]
    spread = np.linalg.svd(kept - kept.mean(axis=0), compute_uv=False)
    if spread[1] < LINE * spread[0]:
        raise InputError(
            "the ground control points lie on one line: they leave the tilt about it open; add one beside it"
        )
    return found


def _exact(points: Correspondences) -> ControlFit | None:
    """The fit of points that are as good as the cameras; None if they are not."""
    if points.accuracy is not None and NORMAL_LIMIT[3] * max(points.accuracy) > points.tolerance:
        return None
    fit, kept = fit_similarity_robust(points.source, points.target, points.tolerance)
    if kept.sum() < MIN_POINTS or 2 * kept.sum() <= len(kept):
        return None
    if points.level and np.arccos(np.clip(fit.rotation[2] @ points.up, -1, 1)) > TILT:
        return None
    return _result(fit_similarity, points, kept, exact=True, upright=False)


def _loose(points: Correspondences) -> ControlFit | None:
    """The fit of points that are worse than the cameras; None if they do not fit at all."""
    source, target, accuracy = points.source, points.target, points.accuracy
    extent = float(np.sqrt(((target - target.mean(axis=0)) ** 2).sum(axis=1).mean()))
    upright = points.level or (accuracy is not None and accuracy[1] > extent)

    def fit(some: np.ndarray, their: np.ndarray) -> Similarity:
        return fit_upright(some, their, points.up) if upright else fit_similarity(some, their)

    axes = 2 if upright else 3
    kept = _agreed(fit, points, axes)
    if kept.sum() < min(len(kept), MIN_POINTS + 1) or kept.sum() < MIN_SHARE * len(kept):
        return None
    offsets = (fit(source[kept], target[kept]).apply(source[kept]) - target[kept])[:, :axes]
    if not _is_significant(offsets, target[kept][:, :axes], len(kept)):
        return None

    def weighted(some: np.ndarray, their: np.ndarray) -> Similarity:
        return fit(some, their) if upright else fit_weighted(some, their, accuracy)

    return _result(weighted, points, kept, exact=False, upright=upright)


def _agreed(fit: Fitter, points: Correspondences, axes: int) -> np.ndarray:
    """(U,) bool: the points that lie within what their accuracy allows of a fit that most agree on. Only the
    first `axes` coordinates count.
    """
    source, target, accuracy = points.source, points.target, points.accuracy

    def distances(similarity: Similarity) -> np.ndarray:
        return np.linalg.norm((similarity.apply(source) - target)[:, :axes], axis=1)

    size, count = axes, len(source)
    best = min(
        (distances(fit(source[rows], target[rows])) for rows in subsets(count, size)),
        key=lambda found: float(np.median(found)),
    )
    given = None if accuracy is None else max(accuracy[:1] if axes == 2 else accuracy)
    sigma = np.median(best) / NORMAL_MEDIAN[axes] * (1 + 5 / max(count - size, 1))
    kept = best <= max(points.tolerance, NORMAL_LIMIT[axes] * (given or sigma))
    for _ in range(10):
        if kept.sum() <= MIN_POINTS:
            break
        found = distances(fit(source[kept], target[kept]))
        freedom = max(axes * kept.sum() - NUM_PARAMETERS[axes], 1)
        sigma = np.sqrt((found[kept] ** 2).sum() / freedom)
        agreed = found <= max(points.tolerance, NORMAL_LIMIT[axes] * (given or sigma))
        if (agreed == kept).all():
            break
        kept = agreed
    return kept


def _is_significant(offsets: np.ndarray, target: np.ndarray, count: int) -> bool:
    """Whether residuals (K, 2 or 3) of the best K of `count` points are smaller than those of points that have
    nothing to do with the model. Of the variance of random points a similarity takes a share after the beta
    distribution.
    """
    from scipy.special import betainc

    kept, axes = target.shape
    share = (offsets**2).sum() / max(((target - target.mean(axis=0)) ** 2).sum(), 1e-300)
    free = axes * kept - NUM_PARAMETERS[axes]
    chance = betainc(free / 2, (NUM_PARAMETERS[axes] - axes) / 2, min(share, 1.0))
    return bool(share < LARGEST_RMS**2 and chance * math.comb(count, kept) < LARGEST_CHANCE)


def _result(fit: Fitter, points: Correspondences, kept: np.ndarray, exact: bool, upright: bool) -> ControlFit:
    source, target, count = points.source[kept], points.target[kept], int(kept.sum())
    similarity = fit(source, target)
    apart = None
    if count > MIN_POINTS:
        rest = [np.delete(np.arange(count), row) for row in range(count)]
        offsets = [
            fit(source[keep], target[keep]).apply(source[row : row + 1])[0] - target[row]
            for row, keep in enumerate(rest)
        ]
        apart = np.linalg.norm(np.array(offsets)[:, : 2 if upright else 3], axis=1)
    found = points.accuracy or estimate_accuracy(similarity.apply(source) - target)
    return ControlFit(similarity, kept, found, exact, upright, apart)


def estimate_accuracy(offsets: np.ndarray) -> Accuracy:
    """Standard deviations, m, horizontal (of each axis) and vertical, from the residuals (K, 3) of a fit."""
    count = len(offsets)
    free = max(1 - NUM_PARAMETERS[3] / (3 * count), 1 / 3)
    squares = (offsets**2).mean(axis=0) / free
    return float(np.sqrt(squares[:2].mean())), float(np.sqrt(squares[2]))


def fit_upright(source: np.ndarray, target: np.ndarray, up: np.ndarray) -> Similarity:
    """Similarity that keeps `up` (3,) of the source up: least squares east and north, mean height."""
    upright = turn_to_z(up)
    turned = source @ upright.T
    here, there = turned.mean(axis=0), target.mean(axis=0)
    before, after = (turned - here)[:, :2] @ [1, 1j], (target - there)[:, :2] @ [1, 1j]
    factor = np.vdot(before, after) / max(np.vdot(before, before).real, 1e-300)
    cosine, sine, scale = np.cos(np.angle(factor)), np.sin(np.angle(factor)), abs(factor)
    rotation = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1.0]])
    return Similarity(float(scale), rotation @ upright, there - scale * rotation @ here)


def turn_to_z(up: np.ndarray) -> np.ndarray:
    """(3, 3) rotation that turns `up` (3,) to +z."""
    up = up / np.linalg.norm(up)
    side = np.cross([0.0, 1.0, 0.0] if abs(up[1]) < 0.9 else [1.0, 0.0, 0.0], up)
    side /= np.linalg.norm(side)
    return np.stack([side, np.cross(up, side), up])


def fit_weighted(source: np.ndarray, target: np.ndarray, accuracy: Accuracy | None) -> Similarity:
    """Least-squares similarity from (N, 3) to (N, 3), residuals over the accuracy, which is estimated in turn if
    it is not given (Gauss-Newton from the unweighted one).
    """
    fit = fit_similarity(source, target)
    for _ in range(20):
        offsets = fit.apply(source) - target
        horizontal, vertical = accuracy or estimate_accuracy(offsets)
        floor = 1e-6 + 0.1 * max(horizontal, vertical)
        weight = 1 / np.maximum([horizontal, horizontal, vertical], floor)
        middle = fit.apply(source).mean(axis=0)
        arms = fit.apply(source) - middle
        # columns: shift, turn (axis x arm), growth
        design = np.concatenate(
            [
                np.broadcast_to(np.eye(3), (len(source), 3, 3)),
                -np.cross(arms[:, None, :], np.eye(3)).transpose(0, 2, 1),
                arms[:, :, None],
            ],
            axis=2,
        )
        step = np.linalg.lstsq(
            (design * weight[:, None]).reshape(-1, 7), -(offsets * weight).ravel(), rcond=None
        )[0]
        fit = _moved(fit, step, middle)
        if np.abs(step[3:]).max() < 1e-9:
            break
    return fit


def _moved(fit: Similarity, step: np.ndarray, middle: np.ndarray) -> Similarity:
    """A similarity with a shift, a turn about `middle` and a growth behind it."""
    angle = float(np.linalg.norm(step[3:6]))
    cross = np.cross(np.eye(3), step[3:6] / max(angle, 1e-300))
    turn = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    grow = float(np.exp(step[6]))
    return Similarity(
        grow * fit.scale,
        turn @ fit.rotation,
        grow * turn @ (fit.translation - middle) + middle + step[:3],
    )


def _refusal(points: Correspondences, names: list[str]) -> str:
    """Why nothing fits, as far as it can be told."""
    exchanged = replace(points, target=points.target[:, [1, 0, 2]])
    for try_fit in (_exact, _loose):
        found = try_fit(exchanged)
        if found is not None and found.similarity.rotation[2] @ points.up > 0:
            return "the ground control points do not fit the model, but would with x and y exchanged: the order is x y (east, north)"
    missed = fit_similarity(points.source, points.target).apply(points.source) - points.target
    offsets = np.linalg.norm(missed, axis=1)
    worst = ", ".join(f"{names[row]} {offsets[row]:.1f} m" for row in np.argsort(-offsets)[:5])
    return (
        f"the ground control points do not fit the model: all {len(names)} together miss it by {worst}; check the CRS, "
        "the order x y (east, north) and the pixels"
    )
