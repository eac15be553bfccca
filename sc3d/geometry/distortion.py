"""Lens models of other programs as COLMAP cameras, exactly; where COLMAP has no such model, within a
tolerance or not at all.

All models here share one form: normalized image coordinates (perspective x / z, or the angle from the axis
for fisheyes) times a radial polynomial, plus tangential terms, then focal lengths, skew and principal point.
Pixel coordinates are COLMAP's: the center of the first pixel is (0.5, 0.5).
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np
import pycolmap

from sc3d.errors import InputError
from sc3d.io.limits import MAX_PIXELS, MAX_SIDE

logger = logging.getLogger(__name__)

NUM_RADII = 400  # samples along the image diagonal on which a lens is compared with its replacement
TOLD = 0.01  # px: an error below this is not worth a warning


class NoModelError(InputError):
    """A kind of lens that no COLMAP model has, whatever its parameters are."""


@dataclass(frozen=True)
class DistortionModel:
    """A lens model.

    width, height: px; focal: (fx, fy) px; principal: (cx, cy) px; skew: px per unit of y
    radial: coefficients of r^2, r^4, ... (r: normalized radius, or the angle for a fisheye)
    tangential: (p1, p2) as in OpenCV: dx = 2 p1 xy + p2 (r^2 + 2 x^2), dy = 2 p2 xy + p1 (r^2 + 2 y^2)
    prism: thin prism (x, y): dx = s r^2
    left_out: terms that are none of these and are left out, and what each costs at most, px
    """

    width: int
    height: int
    focal: tuple[float, float]
    principal: tuple[float, float]
    radial: tuple[float, ...] = ()
    tangential: tuple[float, float] = (0.0, 0.0)
    fisheye: bool = False
    skew: float = 0.0
    prism: tuple[float, float] = (0.0, 0.0)
    left_out: tuple[tuple[str, float], ...] = ()

    @property
    def reach(self) -> float:
        """Largest distorted radius in the image, normalized."""
        x = max(self.principal[0], self.width - self.principal[0]) / self.focal[0]
        y = max(self.principal[1], self.height - self.principal[1]) / self.focal[1]
        return float(np.hypot(x, y))

    @property
    def skew_cost(self) -> float:
        """Largest error without the skew, px; no COLMAP model has pixels that are not rectangular."""
        rows = max(self.principal[1], self.height - self.principal[1])
        return abs(self.skew) * rows / self.focal[1]

    def radii(self) -> np.ndarray:
        """Undistorted radii from the middle to the corner of the image; up to where the polynomial folds
        back, if it does before.
        """
        radius = np.linspace(0, np.pi if self.fisheye else 4 * self.reach + 1, 20 * NUM_RADII)
        distorted = radius * self.factor(radius)
        inside = (distorted <= self.reach) & (np.maximum.accumulate(distorted) == distorted)
        last = len(inside) if inside.all() else int(np.argmin(inside))
        return np.linspace(0, radius[max(last - 1, 1)], NUM_RADII)

    def factor(self, radius: np.ndarray) -> np.ndarray:
        """Radial factor 1 + k1 r^2 + k2 r^4 + ..."""
        return np.polynomial.polynomial.polyval(radius**2, (1.0, *self.radial))


class Lenses:
    """COLMAP cameras of the lenses of a project, one for each, and what they cost in pixels.

    tolerance: largest error, px, that may come from what no COLMAP model has
    """

    def __init__(self, tolerance: float) -> None:
        self._tolerance = tolerance
        self._cameras: dict[DistortionModel, pycolmap.Camera] = {}
        self._costs: dict[str, list[float]] = {}

    def camera(self, distortion: DistortionModel, where: str) -> pycolmap.Camera:
        """COLMAP camera of a lens, of the simplest model that holds it. InputError where that costs more than
        the tolerance; `where`: names the camera in the message.
        """
        if distortion not in self._cameras:
            self._cameras[distortion] = self._convert(distortion, where)
        return self._cameras[distortion]

    def warn(self, path: object) -> None:
        """Say in one line what was left out of the lenses, and what it costs."""
        told = [
            f"{what} (up to {max(costs):.2g} px in {len(costs)} of {len(self._cameras)} lenses)"
            for what, costs in self._costs.items()
        ]
        if told:
            logger.warning("%s: left out, as no COLMAP model has it: %s", path, ", ".join(told))

    def _convert(self, distortion: DistortionModel, where: str) -> pycolmap.Camera:
        _check(distortion, where)
        distortion = replace(distortion, radial=tuple(np.trim_zeros(distortion.radial, "b")))
        model, params, radial_cost = (_fisheye if distortion.fisheye else _perspective)(distortion, where)
        radial_name = f"a radial polynomial up to r^{2 * len(distortion.radial)} (the nearest one is taken)"
        costs = [*distortion.left_out, ("skew", distortion.skew_cost), (radial_name, radial_cost)]
        costs = [(what, cost) for what, cost in costs if not cost == 0]
        lost = sum(cost for _, cost in costs)
        if not lost <= self._tolerance:
            raise InputError(
                f"{where}: no COLMAP model has {', '.join(f'{what} ({cost:.2g} px)' for what, cost in costs)}, "
                f"more than {self._tolerance:g} px in all: optimize the cameras without it, export undistorted photos, "
                f"or allow it with --tolerance {_ceiling(lost)}"
            )
        for what, cost in costs:
            if cost > TOLD:
                self._costs.setdefault(what, []).append(cost)
        return pycolmap.Camera(
            model=model,
            width=distortion.width,
            height=distortion.height,
            params=[*distortion.focal, *distortion.principal, *params],
        )


def to_camera(distortion: DistortionModel, tolerance: float, where: str) -> pycolmap.Camera:
    """The COLMAP camera of a single lens, see `Lenses.camera`."""
    return Lenses(tolerance).camera(distortion, where)


def _check(distortion: DistortionModel, where: str) -> None:
    values = np.array(
        [
            distortion.width,
            distortion.height,
            *distortion.focal,
            *distortion.principal,
            *distortion.radial,
            *distortion.tangential,
            distortion.skew,
            *distortion.prism,
            *(cost for _, cost in distortion.left_out),
        ]
    )
    if not np.isfinite(values).all() or min(distortion.width, distortion.height, *distortion.focal) <= 0:
        raise InputError(f"{where}: size and focal length must be positive, all parameters finite numbers")
    if (
        max(distortion.width, distortion.height) > MAX_SIDE
        or distortion.width * distortion.height > MAX_PIXELS
    ):
        raise InputError(
            f"{where} is {distortion.width}x{distortion.height}: sizes up to {MAX_PIXELS // 10**6} megapixels are possible"
        )


def _perspective(distortion: DistortionModel, where: str) -> tuple[str, list[float], float]:
    """Model, its parameters behind the principal point, and the largest error, px."""
    if any(distortion.prism):
        raise NoModelError(
            f"{where}: a thin prism on a perspective lens has no COLMAP model: export undistorted photos"
        )
    if not distortion.radial and not any(distortion.tangential):
        return "PINHOLE", [], 0.0
    radial = [*distortion.radial, 0.0, 0.0, 0.0]
    if len(distortion.radial) <= 2:
        return "OPENCV", [*radial[:2], *distortion.tangential], 0.0
    if len(distortion.radial) == 3:
        return "FULL_OPENCV", [*radial[:2], *distortion.tangential, radial[2], 0.0, 0.0, 0.0], 0.0
    radial, rational, cost = _rational(distortion)
    return "FULL_OPENCV", [*radial, *distortion.tangential, *rational], cost


def _rational(distortion: DistortionModel) -> tuple[list[float], list[float], float]:
    """FULL_OPENCV's k1, k2 and k3..k6 for a polynomial of higher degree: (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1
    + k4 r^2 + k5 r^4 + k6 r^6); the largest error, px.
    """
    radius = distortion.radii()
    factor, powers = distortion.factor(radius), (radius[:, None] / radius[-1]) ** [2, 4, 6]
    weight = radius[:, None] * np.hstack([powers, -factor[:, None] * powers])
    found, *_ = np.linalg.lstsq(weight, radius * (factor - 1), rcond=1e-14)
    found = found / np.tile(radius[-1] ** np.array([2, 4, 6]), 2)
    squares = radius**2
    top, bottom = (np.polynomial.polynomial.polyval(squares, (1.0, *part)) for part in (found[:3], found[3:]))
    cost = float(np.max(np.abs(radius * (top / bottom - factor))) * max(distortion.focal))
    return list(found[:2]), list(found[2:]), cost


def _fisheye(distortion: DistortionModel, where: str) -> tuple[str, list[float], float]:
    """Model, its parameters behind the principal point, and the largest error, px."""
    radial = [*distortion.radial, *6 * [0.0]]
    if len(distortion.radial) <= 4 and not any(distortion.tangential) and not any(distortion.prism):
        return "OPENCV_FISHEYE", radial[:4], 0.0
    if len(distortion.radial) <= 4:
        rest = [*distortion.tangential, *radial[2:4], *distortion.prism]
        return "THIN_PRISM_FISHEYE", [*radial[:2], *rest], 0.0
    if len(distortion.radial) > 6 or any(distortion.tangential) or any(distortion.prism):
        raise NoModelError(
            f"{where}: this fisheye (radial terms up to r^{2 * len(distortion.radial)} with tangential ones) has no COLMAP model: export undistorted photos"
        )
    return "RAD_TAN_THIN_PRISM_FISHEYE", [*radial[:6], *6 * [0.0]], 0.0


def _ceiling(value: float) -> str:
    """A little more than a value, with two digits."""
    return f"{1.1 * value:.2g}"
