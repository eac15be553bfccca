"""Lens models of other programs as COLMAP cameras, exactly; where COLMAP has no such model, within a
tolerance or not at all.

All models here share one form: normalized image coordinates (perspective x / z, or the angle from the axis
for fisheyes) times a radial polynomial, plus tangential terms, then focal lengths, skew and principal point.
Pixel coordinates are COLMAP's: the center of the first pixel is (0.5, 0.5).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pycolmap

from sc3d.errors import InputError
from sc3d.io.limits import MAX_PIXELS, MAX_SIDE

NUM_RADII = 400  # samples along the image diagonal on which a lens is compared with its replacement


@dataclass(frozen=True)
class DistortionModel:
    """A lens model.

    width, height: px; focal: (fx, fy) px; principal: (cx, cy) px; skew: px per unit of y
    radial: coefficients of r^2, r^4, ... (r: normalized radius, or the angle for a fisheye)
    tangential: (p1, p2) as in OpenCV: dx = 2 p1 xy + p2 (r^2 + 2 x^2), dy = 2 p2 xy + p1 (r^2 + 2 y^2)
    prism: thin prism (x, y): dx = s r^2
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

    @property
    def reach(self) -> float:
        """Largest distorted radius in the image, normalized."""
        x = max(self.principal[0], self.width - self.principal[0]) / self.focal[0]
        y = max(self.principal[1], self.height - self.principal[1]) / self.focal[1]
        return float(np.hypot(x, y))

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


def to_camera(distortion: DistortionModel, tolerance: float, where: str) -> pycolmap.Camera:
    """COLMAP camera of a lens, of the simplest model that holds it.

    tolerance: largest error, px, that may come from what no COLMAP model has. InputError beyond it; `where`:
        names the camera in the message
    """
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
    distortion = replace(distortion, radial=tuple(np.trim_zeros(distortion.radial, "b")))
    lost = (
        abs(distortion.skew)
        * max(distortion.principal[1], distortion.height - distortion.principal[1])
        / distortion.focal[1]
    )
    if lost > tolerance:
        raise InputError(
            f"{where}: pixels that are not rectangular (skew {distortion.skew:.3g} px) have no COLMAP model; leaving that out costs up to {lost:.2g} px: "
            f"optimize the cameras without it, export undistorted photos, or allow it with --tolerance {_ceiling(lost)}"
        )
    model, params = (_fisheye if distortion.fisheye else _perspective)(distortion, tolerance, where)
    return pycolmap.Camera(
        model=model,
        width=distortion.width,
        height=distortion.height,
        params=[*distortion.focal, *distortion.principal, *params],
    )


def _perspective(distortion: DistortionModel, tolerance: float, where: str) -> tuple[str, list[float]]:
    if any(distortion.prism):
        raise InputError(
            f"{where}: a thin prism on a perspective lens has no COLMAP model: export undistorted photos"
        )
    if not distortion.radial and not any(distortion.tangential):
        return "PINHOLE", []
    radial = [*distortion.radial, 0.0, 0.0, 0.0]
    if len(distortion.radial) <= 2:
        return "OPENCV", [*radial[:2], *distortion.tangential]
    rational = [*radial[2:3], 0.0, 0.0, 0.0] if len(distortion.radial) == 3 else None
    if rational is None:
        radial, rational = _rational(distortion, tolerance, where)
    return "FULL_OPENCV", [*radial[:2], *distortion.tangential, *rational]


def _rational(distortion: DistortionModel, tolerance: float, where: str) -> tuple[list[float], list[float]]:
    """FULL_OPENCV's k1, k2 and k3..k6 for a polynomial of higher degree: (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1
    + k4 r^2 + k5 r^4 + k6 r^6).
    """
    radius = distortion.radii()
    factor, powers = distortion.factor(radius), (radius[:, None] / radius[-1]) ** [2, 4, 6]
    weight = radius[:, None] * np.hstack([powers, -factor[:, None] * powers])
    found, *_ = np.linalg.lstsq(weight, radius * (factor - 1), rcond=1e-14)
    found = found / np.tile(radius[-1] ** np.array([2, 4, 6]), 2)
    squares = radius**2
    top, bottom = (np.polynomial.polynomial.polyval(squares, (1.0, *part)) for part in (found[:3], found[3:]))
    lost = float(np.max(np.abs(radius * (top / bottom - factor))) * max(distortion.focal))
    if not lost <= tolerance:
        raise InputError(
            f"{where}: a radial polynomial up to r^{2 * len(distortion.radial)} has no COLMAP model, and the nearest one is up to {lost:.2g} px off: "
            f"optimize the cameras without k4, export undistorted photos, or allow it with --tolerance {_ceiling(lost)}"
        )
    return list(found[:2]), list(found[2:])


def _fisheye(distortion: DistortionModel, tolerance: float, where: str) -> tuple[str, list[float]]:
    radial = [*distortion.radial, *6 * [0.0]]
    if len(distortion.radial) <= 4 and not any(distortion.tangential) and not any(distortion.prism):
        return "OPENCV_FISHEYE", radial[:4]
    if len(distortion.radial) <= 4:
        return "THIN_PRISM_FISHEYE", [*radial[:2], *distortion.tangential, *radial[2:4], *distortion.prism]
    if len(distortion.radial) > 6 or any(distortion.tangential) or any(distortion.prism):
        raise InputError(
            f"{where}: this fisheye (radial terms up to r^{2 * len(distortion.radial)} with tangential ones) has no COLMAP model: export undistorted photos"
        )
    return "RAD_TAN_THIN_PRISM_FISHEYE", [*radial[:6], *6 * [0.0]]


def _ceiling(value: float) -> str:
    """A little more than a value, with two digits."""
    return f"{1.1 * value:.2g}"
