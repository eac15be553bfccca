"""GPS that does not fit: the cameras, those of a model or rough ones, and otherwise the flight's own steps."""

from __future__ import annotations

import numpy as np

from sc3d.georeferencing.gps import OUTLIER, OUTLIER_METERS, Flight, distances
from sc3d.preflight.appearance import FEW, UNUSUAL, robust

LONG_STEPS = 5.0  # times the usual step of a flight, there and back
ORDERED = 0.5  # of the usual distance from the middle: photos whose steps are longer are in no order


def jumps(flight: Flight, centers: dict[str, np.ndarray]) -> tuple[dict[str, float], dict[str, float]]:
    """How far, m, cameras lie from their GPS, by photo name; and the photos whose GPS is wrong, and by how
    much.

    centers: camera center (3,) by photo name, in any frame
    """
    places = {name: place for name, place in flight.positions.items() if name not in flight.astray}
    found = distances(flight, centers)
    offsets, wrong = ({}, {}) if found is None else found
    steps = _long_steps(flight, places)
    wrong = wrong | {name: step for name, step in steps.items() if name not in offsets}
    middle = np.median(list(places.values()), axis=0)
    far = {name: float(np.linalg.norm(flight.positions[name] - middle)) for name in flight.astray}
    return offsets, dict(sorted((wrong | far).items()))


def _long_steps(flight: Flight, places: dict[str, np.ndarray]) -> dict[str, float]:
    """Photos far from those before and after them, in a flight whose photos are in order, and how far, m."""
    names = sorted(places)
    if len(names) < FEW:
        return {}
    route = np.array([places[name] for name in names])
    steps = np.linalg.norm(np.diff(route, axis=0), axis=1)
    usual, spread = robust(steps)
    if usual > ORDERED * np.median(np.linalg.norm(route - np.median(route, axis=0), axis=1)):
        return {}
    sigma = float(np.median([flight.tags[name].sigma for name in names]))
    limit = max(OUTLIER_METERS, OUTLIER * sigma, LONG_STEPS * usual, usual + UNUSUAL * spread)
    both = np.minimum(steps[1:], steps[:-1])
    detour = steps[1:] + steps[:-1] - np.linalg.norm(route[2:] - route[:-2], axis=1)
    rows = np.flatnonzero((both > limit) & (detour > both))
    return {names[row + 1]: float(both[row]) for row in rows}
