"""The part of a report on what was found: classes by area, and counted objects."""

from __future__ import annotations

import json
from html import escape
from pathlib import Path

import numpy as np

from sc3d.geometry.raster import Raster, highest_points, spacing_of_all
from sc3d.report.charts import css_color, formatted, number
from sc3d.report.data import ReportData

_CELL = 2.0  # side of the cells that areas are counted in, point spacings
# file names of `sc3d export --format objects`, and what they hold
_LAYERS = {"buildings": "buildings", "trees": "trees"}


def found_section(data: ReportData) -> str:
    """Area, points and confidence of each class; number and size of the objects, where `export --format
    objects` counted them.
    """
    return _class_table(data) + _object_table(data)


def class_areas(points: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """(256,) float64 area of each class seen from above, squared world units: cells of the ground plane, by
    the label of their highest point.

    points: (N, 3) world, z up; labels: (N,) uint8
    """
    grid = Raster.around(points, _CELL * spacing_of_all(points))
    rows = highest_points(grid, points).ravel()
    return np.bincount(labels[rows[rows >= 0]], minlength=256) * grid.pixel**2


def iou_of(data: ReportData, source: str) -> dict[str, float | None]:
    """IoU by class name of "labels" or "masks"; empty without metrics."""
    found = data.figures(source).get("iou")
    return {str(name): number(value) for name, value in found.items()} if isinstance(found, dict) else {}


def _class_table(data: ReportData) -> str:
    counts = data.label_counts
    if counts is None or data.class_table is None or not len(data.points):
        return ""
    labels, confidence, iou = (
        data.values("label"),
        data.values("confidence"),
        iou_of(data, "labels"),
    )
    areas = class_areas(data.points, labels.astype(np.uint8))
    sums, rows = (
        None if confidence is None else np.bincount(labels, np.nan_to_num(confidence), minlength=256),
        [],
    )
    for label in [*(entry.id for entry in data.class_table), *([0] if counts[0] else [])]:
        name = data.class_table.name(label)
        mean = "–" if sums is None or not counts[label] else f"{sums[label] / counts[label]:.2f}"
        cells = [
            f"{areas[label]:,.0f}",
            f"{areas[label] / max(areas.sum(), 1e-12):.1%}",
            f"{counts[label]:,}",
        ] + ([mean] if sums is not None else [])
        cells += [formatted(iou.get(name), ".3f")] if iou else []
        swatch = f'<i style="background:{css_color(data.class_table.palette[label])}"></i>'
        rows.append([f"{swatch}{escape(name)}", *cells])
    heads = (
        ["Class", "Area, m²", "Share", "Points"]
        + (["Confidence"] if sums is not None else [])
        + (["IoU"] if iou else [])
    )
    return (
        '<p class="note">Areas as seen straight from above; square meters if the model is metric.</p>'
        + _table(heads, rows)
    )


def _object_table(data: ReportData) -> str:
    rows = []
    for stem, name in _LAYERS.items():
        objects = next(
            (
                found
                for file in (f"{stem}.geojson", f"{stem}_local.geojson")
                if (found := _read(data.scene.export / file)) is not None
            ),
            None,
        )
        if objects is not None:
            area, height = (
                np.array([number(item.get(key)) or 0.0 for item in objects])
                for key in ("area_m2", "height_m")
            )
            sizes = (
                [
                    f"{area.sum():,.0f}",
                    f"{np.median(area):,.0f}",
                    f"{np.median(height):.1f}",
                    f"{height.max():.1f}",
                ]
                if len(objects)
                else ["–"] * 4
            )
            rows.append([name, f"{len(objects):,}", *sizes])
    if not rows:
        return ""
    heads = ["Objects", "Number", "Area, m²", "Median area, m²", "Median height, m", "Highest, m"]
    return "<h3>Counted</h3>" + _table(heads, rows)


def _read(file: Path) -> list[dict] | None:
    """Properties of the features of a GeoJSON file; None if it does not exist or is another kind of file."""
    try:
        features = json.loads(file.read_text(encoding="utf-8"))["features"]
        return [feature["properties"] for feature in features if isinstance(feature["properties"], dict)]
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None


def _table(heads: list[str], rows: list[list[str]]) -> str:
    head = "".join(f"<th>{name}</th>" for name in heads)
    body = "".join(
        f"<tr><th>{row[0]}</th>{''.join(f'<td>{cell}</td>' for cell in row[1:])}</tr>" for row in rows
    )
    return f'<div class="scroll"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'
