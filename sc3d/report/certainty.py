"""The part of a report on how certain the labels are, and how true that is."""

from __future__ import annotations

from html import escape

import numpy as np

from sc3d.report.charts import css_color, histogram, number, reliability_curve, stacked_bar
from sc3d.report.data import ReportData
from sc3d.view.colors import STATES, confidence_colors


def certainty_section(data: ReportData) -> str:
    """Confidence of the points, whether it can be believed, and how their labels came about."""
    confidence, states, parts = data.values("confidence"), data.values("state"), []
    if confidence is not None:
        colors = confidence_colors((np.arange(20) + 0.5) / 20)
        parts.append(
            f'<div><h3>Confidence</h3><p class="note">Share of the points by confidence; median {np.nanmedian(confidence):.2f}.</p>'
            f"{histogram(confidence, colors)}</div>"
        )
    parts += _reliability(data)
    if states is not None and len(states):
        shares = np.bincount(states.astype(np.uint8), minlength=256)[: len(STATES)] / len(states)
        rows = [(state.name, state.color, float(share)) for state, share in zip(STATES, shares, strict=True)]
        items = "".join(
            f'<li><i style="background:{css_color(color)}"></i>{escape(name)} <b>{share:.1%}</b></li>'
            for name, color, share in rows
        )
        parts.append(
            f'<div><h3>Origin of the labels</h3><p class="note">Seeds come from the photos, propagated labels from their neighbors; '
            f'locked points were contradictory.</p>{stacked_bar(rows)}<ul class="legend">{items}</ul></div>'
        )
    return f'<div class="columns">{"".join(parts)}</div>' if parts else ""


def _reliability(data: ReportData) -> list[str]:
    """The reliability curve as a list of one block; empty without truth."""
    figures = data.figures("reliability")
    rows = figures.get("bins")
    if (
        not isinstance(rows, list)
        or not any(rows)
        or not all(row is None or isinstance(row, list) and len(row) == 3 for row in rows)
    ):
        return []
    bins = [(None, None, None) if row is None else tuple(number(value) for value in row) for row in rows]
    if any(None in row and any(value is not None for value in row) for row in bins):
        return []
    pixels = sum(count or 0 for _, _, count in bins)
    bins = [(confidence, accuracy, count and count / max(pixels, 1)) for confidence, accuracy, count in bins]
    error = number(figures.get("ece"))
    note = "Share of right pixels (dots) against the confidence of their label; on the line, confidence is exactly that share. Bars: share of the pixels."
    if error is not None:
        note += f" Expected calibration error {error:.3f}."
    return [f'<div><h3>Reliability</h3><p class="note">{note}</p>{reliability_curve(bins)}</div>']
