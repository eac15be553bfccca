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
SAME_HEIGHT = 1e-3  # m: heights that differ by less are one
LINE = 0.02  # width over length of points on a line
TILT = np.radians(5.0)  # points at one height are believed if the cameras stand no more askew on them
# of the norm of 2 and 3 normal deviates: its median, and what 1 % exceeds
NORMAL_MEDIAN, NORMAL_LIMIT = {2: 1.177, 3: 1.538}, {2: 3.035, 3: 3.368}
NUM_PARAMETERS = {2: 4, 3: 7}

# heights that were not measured: of the tolerance, how much worse a fit without them may be horizontally, and how
# much they must miss it by; and of the misfit of coordinates that were measured
UNMEASURED, TIMES_WORSE = 0.25, 5.0
# what heights may be multiplied by, and how much better than as given they must then fit
UNITS = {"feet": 1 / 0.3048, "meters, where the CRS has feet": 0.3048}
TIMES_BETTER = 3.0
BETTER_AND_UPRIGHT = 1.5  # where the cameras say so too
EXCHANGED = "with x and y exchanged they fit: the order is x y (east, north)"

Accuracy = tuple[float, float]  # standard deviations, m: horizontal, vertical
Fitter = Callable[[np.ndarray], Similarity]  # from rows of points


@dataclass(frozen=True)
class Correspondences:
    """Points by the model and by the survey.

    source: (U, 3) model frame; target: (U, 3) ENU, m; up: (3,) of the cameras, model frame
    tolerance: m, what points as good as the cameras may miss; accuracy: of the survey, None = not stated
    height: (U,) m, as surveyed; NaN: of no worth, the point counts horizontally only
    """

    source: np.ndarray
    target: np.ndarray
    up: np.ndarray
    tolerance: float
    accuracy: Accuracy | None
    height: np.ndarray

    @property
    def measured(self) -> np.ndarray:
        """(U,) bool: the height counts."""
        return np.isfinite(self.height)

    @property
    def level(self) -> bool:
        """All heights are the same, so they were not measured."""
        return bool(self.measured.all() and np.ptp(self.height) < SAME_HEIGHT)

    def some(self, rows: np.ndarray) -> Correspondences:
        return replace(self, source=self.source[rows], target=self.target[rows], height=self.height[rows])

    def offsets(self, similarity: Similarity, upright: bool = False) -> np.ndarray:
        """(U, 3) m, from the survey; up is 0 where the height does not count, and for all if `upright`."""
        found = similarity.apply(self.source) - self.target
        found[:, 2] = np.where(self.measured & (not upright), found[:, 2], 0.0)
        return found


@dataclass(frozen=True)
class ControlFit:
    """A similarity from model to ENU and what it rests on.

    points: as they were understood: heights in meters, NaN where they do not count
    kept: (U,) bool, the points that it was fitted to; accuracy: theirs, given or estimated
    exact: they are as good as the cameras, which may be bent onto them
    upright: up is that of the cameras, heights had no say
    leave_one_out: (K,) distance, m, of each of the kept from the fit of the others (horizontal if upright):
        what the model is worth between them; None with too few
    unit: of UNITS, that the heights turned out to be in, and by how much they grow with those of the model;
        "" and 1 = as given
    """

    similarity: Similarity
    points: Correspondences
    kept: np.ndarray
    accuracy: Accuracy
    exact: bool
    upright: bool
    leave_one_out: np.ndarray | None
    unit: str = ""
    slope: float = 1.0

    @property
    def rms(self) -> np.ndarray:
        """(2,) m, of the points kept: horizontal; vertical, of heights that count."""
        squares = self.points.offsets(self.similarity, self.upright)[self.kept] ** 2
        heights = max(int(self.points.measured[self.kept].sum()), 1)
        return np.sqrt([squares[:, :2].sum() / self.kept.sum(), squares[:, 2].sum() / heights])


def fit_control_points(points: Correspondences, names: list[str]) -> ControlFit:
    """Robust similarity from model to ENU. names: of the points, for messages; InputError if nothing fits, or the
    points lie on one line
    """
    found = _fit(points)
    found = _in_other_unit(points, found) or found
    if found is None or not found.unit:
        fewer = _without_fillers(points, found)
        found = (_in_other_unit(fewer.points, fewer) or fewer) if fewer else found
    if found is None:
        raise InputError(_refusal(points, names))
    if _is_thin(points.target[found.kept]):
        raise InputError(
            "the ground control points lie on one line: they leave the tilt about it open; add one beside it"
        )
    return found


def _is_thin(target: np.ndarray) -> bool:
    """Whether points (N, 3) lie on one line."""
    spread = np.linalg.svd(target - target.mean(axis=0), compute_uv=False)
    return bool(spread[1] < LINE * spread[0])


def _fit(points: Correspondences) -> ControlFit | None:
    """The fit of points whose heights are what they are said to be; None if they do not fit."""
    if not points.measured.all():
        return _mixed(points)
    found = _exact(points)
    if found is None or (~found.kept).mean() > FEW_BLUNDERS:
        loose = _loose(points)
        if loose is not None and (found is None or loose.kept.sum() > found.kept.sum()):
            found = loose
    return found


def _mixed(points: Correspondences) -> ControlFit | None:
    """The fit of points of which some have no height: that of those with one, if they can tell which way is up,
    then all of them.
    """
    real = points.measured
    if real.sum() < MIN_POINTS or _is_thin(points.target[real] * [1, 1, 0]):
        return _loose(points)
    found = _fit(points.some(real))
    if found is None or found.upright:
        return _loose(points)
    sigma = 0.0 if found.exact else NORMAL_LIMIT[2] * found.accuracy[0]
    missed = np.linalg.norm(points.offsets(found.similarity), axis=1)
    kept = missed <= max(points.tolerance, sigma)
    kept[real] = found.kept

    def fit(rows: np.ndarray) -> Similarity:
        # of exact points all coordinates weigh the same
        accuracy = (1.0, 1.0) if found.exact else points.accuracy
        some = points.some(rows)
        return fit_weighted(some.source, some.target, accuracy, some.measured)

    return _result(fit, points, kept, exact=found.exact, upright=False)


def _without_fillers(points: Correspondences, found: ControlFit | None) -> ControlFit | None:
    """The fit without heights that several points share to the millimeter and the model contradicts: a filler,
    such as 0, or one measurement for all. None if there are none.

    found: the fit with them, None = none
    """
    values, counts = np.unique(np.round(points.height[points.measured] / SAME_HEIGHT), return_counts=True)
    for value in values[np.argsort(-counts, kind="stable")][: int((counts > 1).sum())]:
        shared = np.round(points.height / SAME_HEIGHT) == value
        if shared.all():
            return None
        fewer = _fit(replace(points, height=np.where(shared, np.nan, points.height)))
        if fewer is not None and _is_better(fewer, found) and _contradicts(fewer, points, shared):
            return fewer
    return None


def _is_better(fewer: ControlFit, found: ControlFit | None) -> bool:
    """Whether a fit with fewer heights keeps more points, or as many, and is not worse for it horizontally."""
    if found is None:
        return True
    limit = max(TIMES_WORSE * found.rms[0], UNMEASURED * fewer.points.tolerance)
    if not found.exact and fewer.exact:
        return bool(fewer.kept.sum() >= MIN_SHARE * len(fewer.kept))
    return bool(fewer.kept.sum() >= found.kept.sum() and fewer.rms[0] <= limit)


def _contradicts(fewer: ControlFit, points: Correspondences, shared: np.ndarray) -> bool:
    """Whether heights that did not count miss a fit by far more than what counted. Without any that did, they are
    asked for their relief and their tilt alone.
    """
    missed = (fewer.similarity.apply(points.source) - points.target)[:, 2]
    limit = max(TIMES_WORSE * float(fewer.rms.max()), UNMEASURED * points.tolerance)
    if not fewer.upright or (points.height[shared] == 0).all():
        # what others measured says how high these lie
        return bool(np.median(np.abs(missed[shared])) > limit)
    plane = np.column_stack([points.target[shared, :2], np.ones(shared.sum())])
    tilt = np.linalg.lstsq(plane, missed[shared], rcond=None)[0]
    relief = np.sqrt(((missed[shared] - plane @ tilt) ** 2).mean())
    return bool(np.hypot(*tilt[:2]) > np.tan(TILT) or relief > limit)


def _in_other_unit(points: Correspondences, found: ControlFit | None) -> ControlFit | None:
    """The fit of heights in another unit than the CRS says, if they fit far better in it; None if they do not.

    found: the fit of the heights as they are said to be, None = none
    """
    if points.level or points.measured.sum() <= MIN_POINTS:
        return None
    for unit, factor in UNITS.items():
        target = points.target.copy()
        change = np.where(points.measured, points.height * (1 / factor - 1), 0.0)
        target[:, 2] += change
        other = _fit(replace(points, target=target, height=points.height / factor))
        if other is None or other.upright or other.kept.sum() < MIN_SHARE * len(other.kept):
            continue
        if _fits_far_better(other, factor, points, found):
            rows = other.kept & points.measured
            slope = np.polyfit(other.similarity.apply(points.source)[rows, 2], points.target[rows, 2], 1)[0]
            return replace(other, unit=unit, slope=float(slope))
    return None


def _fits_far_better(
    other: ControlFit, factor: float, points: Correspondences, found: ControlFit | None
) -> bool:
    """Whether heights divided by `factor` fit far better than as given, and than heights that follow no relief.
    All is compared in the unit of the heights as given: they do not become better by being made small.
    """
    kept = other.kept & points.measured
    if kept.sum() <= MIN_POINTS or (found is not None and found.kept.sum() > other.kept.sum()):
        return False
    some = points.some(kept)
    before = fit_weighted(some.source, some.target, (1.0, 1.0), some.measured)
    misfit = np.sqrt((some.offsets(before) ** 2).mean(axis=0).sum())
    offsets = other.points.offsets(other.similarity)[kept]
    now = np.sqrt(((offsets * [1, 1, factor]) ** 2).mean(axis=0).sum())
    plane = np.column_stack([some.target[:, :2], np.ones(kept.sum())])
    relief = some.target[:, 2] - plane @ np.linalg.lstsq(plane, some.target[:, 2], rcond=None)[0]
    none = np.sqrt((relief**2).mean()) if factor < 1 else np.inf
    askew, upright = (
        np.arccos(np.clip(fit.rotation[2] @ points.up, -1, 1)) for fit in (before, other.similarity)
    )
    wanted = BETTER_AND_UPRIGHT if upright < TILT / 2 < TILT < askew else TIMES_BETTER
    return bool(now * wanted < min(misfit, none))


def _exact(points: Correspondences) -> ControlFit | None:
    """The fit of points that are as good as the cameras; None if they are not."""
    if points.accuracy is not None and NORMAL_LIMIT[3] * max(points.accuracy) > points.tolerance:
        return None
    fit, kept = fit_similarity_robust(points.source, points.target, points.tolerance)
    if kept.sum() < MIN_POINTS or 2 * kept.sum() <= len(kept):
        return None
    if points.level and np.arccos(np.clip(fit.rotation[2] @ points.up, -1, 1)) > TILT:
        return None
    return _result(
        lambda rows: fit_similarity(points.source[rows], points.target[rows]),
        points,
        kept,
        exact=True,
        upright=False,
    )


def _loose(points: Correspondences) -> ControlFit | None:
    """The fit of points that are worse than the cameras; None if they do not fit at all."""
    source, target, accuracy = points.source, points.target, points.accuracy
    extent = float(np.sqrt(((target - target.mean(axis=0)) ** 2).sum(axis=1).mean()))
    upright = points.level or not points.measured.all() or (accuracy is not None and accuracy[1] > extent)

    def fit(rows: np.ndarray) -> Similarity:
        if upright:
            return fit_upright(source[rows], target[rows], points.up, points.measured[rows])
        return fit_similarity(source[rows], target[rows])

    axes = 2 if upright else 3
    kept = _agreed(fit, points, axes)
    if kept.sum() < min(len(kept), MIN_POINTS + 1) or kept.sum() < MIN_SHARE * len(kept):
        return None
    rows = np.flatnonzero(kept)
    offsets = (fit(rows).apply(source[kept]) - target[kept])[:, :axes]
    if not _is_significant(offsets, target[kept][:, :axes], len(kept)):
        return None

    def weighted(rows: np.ndarray) -> Similarity:
        return fit(rows) if upright else fit_weighted(source[rows], target[rows], accuracy)

    return _result(weighted, points, kept, exact=False, upright=upright)


def _agreed(fit: Fitter, points: Correspondences, axes: int) -> np.ndarray:
    """(U,) bool: the points that lie within what their accuracy allows of a fit that most agree on. Only the
    first `axes` coordinates count.
    """
    accuracy = points.accuracy

    def distances(rows: np.ndarray) -> np.ndarray:
        return np.linalg.norm(points.offsets(fit(rows), upright=axes == 2), axis=1)

    size, count = axes, len(points.source)
    best = min((distances(rows) for rows in subsets(count, size)), key=lambda found: float(np.median(found)))
    given = None if accuracy is None else max(accuracy[:1] if axes == 2 else accuracy)
    sigma = np.median(best) / NORMAL_MEDIAN[axes] * (1 + 5 / max(count - size, 1))
    kept = best <= max(points.tolerance, NORMAL_LIMIT[axes] * (given or sigma))
    for _ in range(10):
        if kept.sum() <= MIN_POINTS:
            break
        found = distances(np.flatnonzero(kept))
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
    rows = np.flatnonzero(kept)
    similarity = fit(rows)
    apart = None
    if len(rows) > MIN_POINTS:
        left_out = [points.offsets(fit(np.delete(rows, at)), upright)[row] for at, row in enumerate(rows)]
        apart = np.linalg.norm(left_out, axis=1)
    some = points.some(rows)
    found = points.accuracy or estimate_accuracy(
        similarity.apply(some.source) - some.target, some.measured if some.measured.any() else None
    )
    return ControlFit(similarity, points, kept, found, exact, upright, apart)


def estimate_accuracy(offsets: np.ndarray, measured: np.ndarray | None = None) -> Accuracy:
    """Standard deviations, m, horizontal (of each axis) and vertical, from the residuals (K, 3) of a fit.
    measured: (K,) bool, the heights that count, None = all
    """
    heights = offsets[:, 2] if measured is None else offsets[measured, 2]
    free = max(1 - NUM_PARAMETERS[3] / (2 * len(offsets) + len(heights)), 1 / 3)
    squares = (offsets[:, :2] ** 2).mean() / free, (heights**2).mean() / free
    return float(np.sqrt(squares[0])), float(np.sqrt(squares[1]))


def fit_upright(
    source: np.ndarray, target: np.ndarray, up: np.ndarray, measured: np.ndarray | None = None
) -> Similarity:
    """Similarity that keeps `up` (3,) of the source up: least squares east and north, mean height, of those
    `measured` (N,) if there are any.
    """
    upright = turn_to_z(up)
    turned = source @ upright.T
    here, there = turned.mean(axis=0), target.mean(axis=0)
    if measured is not None and measured.any():
        here[2], there[2] = turned[measured, 2].mean(), target[measured, 2].mean()
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


def fit_weighted(
    source: np.ndarray, target: np.ndarray, accuracy: Accuracy | None, measured: np.ndarray | None = None
) -> Similarity:
    """Least-squares similarity from (N, 3) to (N, 3), residuals over the accuracy, which is estimated in turn if
    it is not given (Gauss-Newton from the unweighted one). measured: (N,) bool, the heights that count, three at
    least; None = all
    """
    real = np.ones(len(source), bool) if measured is None else measured
    fit = fit_similarity(source[real], target[real])
    for _ in range(20):
        offsets = fit.apply(source) - target
        offsets[~real, 2] = 0.0
        horizontal, vertical = accuracy or estimate_accuracy(offsets, real)
        floor = 1e-6 + 0.1 * max(horizontal, vertical)
        weight = np.tile(1 / np.maximum([horizontal, horizontal, vertical], floor), (len(source), 1))
        weight[~real, 2] = 0.0
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
            (design * weight[:, :, None]).reshape(-1, 7), -(offsets * weight).ravel(), rcond=None
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


def fits_exchanged(points: Correspondences) -> bool:
    """Whether points fit the model with x and y exchanged."""
    exchanged = replace(points, target=points.target[:, [1, 0, 2]])
    found = _fit(exchanged)
    found = _without_fillers(exchanged, found) or found
    found = found or _in_other_unit(exchanged, found)
    return found is not None and bool(found.similarity.rotation[2] @ points.up > 0)


def _refusal(points: Correspondences, names: list[str]) -> str:
    """Why nothing fits, as far as it can be told."""
    if fits_exchanged(points):
        return f"the ground control points do not fit the model: {EXCHANGED}"
    missed = fit_similarity(points.source, points.target).apply(points.source) - points.target
    offsets = np.linalg.norm(missed, axis=1)
    worst = ", ".join(f"{names[row]} {offsets[row]:.1f} m" for row in np.argsort(-offsets)[:5])
    return (
        f"the ground control points do not fit the model: all {len(names)} together miss it by {worst}; check the CRS, "
        "the order x y (east, north) and the pixels"
    )
