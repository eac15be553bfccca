"""Pictures of a report, as data URIs."""

from __future__ import annotations

import logging
from contextlib import suppress
from dataclasses import replace

import cv2
import numpy as np

from sc3d.errors import InputError, Sc3dError
from sc3d.geometry.cameras import View
from sc3d.io.clouds import read_mesh
from sc3d.io.images import data_uri
from sc3d.report.data import DRAWN, ReportData
from sc3d.scene.labelled_cloud import LabelledSurface, is_confirmed
from sc3d.tiling.seen_points import SeenPoints
from sc3d.view.colors import COLORINGS, color_points
from sc3d.view.screenshot import Style, draw_points, screenshot

logger = logging.getLogger(__name__)

BACKGROUND = (238, 240, 242)
_SIZES = {"oblique": (1280, 760), "above": (900, 900)}  # px
_PHOTO_SIZE = 640  # px, longest side of a photo in the comparison


def cloud_pictures(data: ReportData) -> dict[tuple[str, str], tuple[str, float]]:
    """Data URIs and width/height by (coloring or "mesh", "oblique" or "above"), of what the cloud has; empty
    where no renderer works.
    """
    pictures, mesh = {}, None if data.mesh is None else read_mesh(data.mesh)
    try:
        for direction, size in _SIZES.items():
            style = Style(
                from_above=direction == "above", legend=False, background=BACKGROUND, max_points=DRAWN
            )
            if data.cloud is not None:
                shown = is_confirmed(data.cloud)
                point_image = draw_points(data.points[shown], None, size, style)
                for by, colors in _colorings(data).items():
                    painted = point_image.paint(
                        colors[shown], replace(style, shading=0.0 if by == "photo" else 0.6)
                    )
                    pictures[by, direction] = _picture(painted)
            if mesh is not None:
                pictures["mesh", direction] = _picture(screenshot(mesh, None, size, style))
    except Sc3dError as error:
        logger.warning("the report has no pictures of the cloud: %s", error)
    return pictures


def _colorings(data: ReportData) -> dict[str, np.ndarray]:
    """(N, 3) uint8 RGB by coloring, for the attributes that the cloud has."""
    found: dict[str, np.ndarray] = {}
    for by in COLORINGS:
        with suppress(InputError):
            found[by] = color_points(data.cloud, by, data.class_table)
    return found


def comparison_size(view: View) -> tuple[int, int]:
    """(width, height) of the pictures of a photo, px."""
    scale = min(1.0, _PHOTO_SIZE / max(view.width, view.height))
    return max(1, round(view.width * scale)), max(1, round(view.height * scale))


def comparison(
    data: ReportData, view: View, labelled: LabelledSurface | SeenPoints | None
) -> list[tuple[str, str]]:
    """Captions and data URIs of one photo: the photo, the given mask, the fused labels and the truth, as far
    as they exist.
    """
    scene = data.scene
    size, panels = comparison_size(view), []
    if scene.photo(view.name).exists():
        panels.append(
            (
                "photo",
                data_uri(cv2.resize(scene.read_photo(view.name), size, interpolation=cv2.INTER_AREA)),
            )
        )
    if data.class_table is None:
        return panels
    palette = data.class_table.palette
    for caption, file in (
        ("given mask", data.mask_files.get(view.name)),
        ("fused labels", None),
        ("truth", data.truth_files.get(view.name)),
    ):
        if caption == "fused labels" and labelled is not None:
            labels, _ = labelled.see(view, size)
        elif file is not None:
            if caption == "truth":
                labels = scene.read_truth(file, view.name, data.zero_margin)
            else:
                labels = scene.read_mask(file, view.name)
            labels = cv2.resize(labels, size, interpolation=cv2.INTER_NEAREST)
        else:
            continue
        panels.append((caption, data_uri(palette[labels], ".png")))
    return panels


def ground_picture(
    points: np.ndarray, colors: np.ndarray, longest: int = 640
) -> tuple[str, tuple[float, float, float, float]]:
    """The cloud straight from above, parallel projection, north up: the highest point of each cell.

    points: (N, 3) world; colors: (N, 3) uint8 RGB
    returns: data URI; (x minimum, y minimum, x maximum, y maximum), world
    """
    low, high = np.quantile(points[:: max(1, len(points) // 200_000), :2], [0.002, 0.998], axis=0)
    inside = ((points[:, :2] >= low) & (points[:, :2] <= high)).all(axis=1)
    longest = int(min(longest, max(8, 0.6 * np.sqrt(inside.sum()))))
    cell = max(float((high - low).max()) / longest, 1e-9)
    width, height = np.maximum(np.ceil((high - low) / cell).astype(int), 1)
    order = np.argsort(points[inside, 2], kind="stable")
    columns, rows = (
        np.minimum((points[inside, :2] - low) / cell, [width - 1, height - 1]).astype(int)[order].T
    )
    picture = np.zeros((height, width, 4), np.uint8)
    picture[height - 1 - rows, columns] = np.column_stack([colors[inside][order], np.full(len(order), 255)])
    for _ in range(2):  # close single holes between the points
        holes = picture[..., 3] == 0
        picture[holes] = cv2.dilate(picture, np.ones((3, 3), np.uint8))[holes]
    return data_uri(picture, ".png"), (
        low[0],
        high[1] - height * cell,
        low[0] + width * cell,
        high[1],
    )


def _picture(image: np.ndarray) -> tuple[str, float]:
    """Data URI and aspect of a picture without its empty border, but for a margin."""
    filled = (image != np.array(BACKGROUND, np.uint8)).any(axis=2)
    rows, columns = np.flatnonzero(filled.any(axis=1)), np.flatnonzero(filled.any(axis=0))
    if len(rows):
        image = image[max(0, rows[0] - 20) : rows[-1] + 21, max(0, columns[0] - 20) : columns[-1] + 21]
    return data_uri(image), image.shape[1] / image.shape[0]
