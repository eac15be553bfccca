"""Small charts as inline SVG. Text keeps its size at every page width: positions are percentages, not a
scaled drawing.
"""

from __future__ import annotations

import html
from collections.abc import Sequence

import numpy as np

Color = tuple[int, int, int]


def css_color(color: Sequence[int]) -> str:
    """`#rrggbb` of an RGB color."""
    return "#" + "".join(f"{int(value):02x}" for value in color)


def number(value: object) -> float | None:
    """A finite number, else None."""
    return (
        float(value)
        if isinstance(value, int | float) and not isinstance(value, bool) and np.isfinite(value)
        else None
    )


def formatted(value: float | None, pattern: str) -> str:
    return "–" if value is None else format(value, pattern)


def paired_bars(rows: Sequence[tuple[str, Color, float | None, float | None]]) -> str:
    """Two bars per row, on the scale 0 to 1: the upper in the row's color, the lower gray.

    rows: name, color, upper value, lower value; None = no such value
    """
    step, parts = 46, []
    for number, (name, color, upper, lower) in enumerate(rows):
        top = number * step
        values = [text for text in (_value(upper), lower is not None and f"masks {_value(lower)}") if text]
        parts.append(f'<text x="0" y="{top + 14}">{html.escape(name)}</text>')
        parts.append(
            f'<text x="100%" y="{top + 14}" text-anchor="end"><tspan class="strong">{values[0] if upper is not None else "–"}</tspan>'
            f'<tspan class="soft" dx="8">{values[-1] if lower is not None else ""}</tspan></text>'
        )
        parts.append(f'<rect class="track" x="0" y="{top + 21}" width="100%" height="16" rx="2"/>')
        for value, y, height, style in (
            (upper, 21, 10, f'fill="{css_color(color)}"'),
            (lower, 32, 5, 'class="second"'),
        ):
            if value is not None:
                parts.append(
                    f'<rect x="0" y="{top + y}" width="{100 * min(max(value, 0.0), 1.0):.2f}%" height="{height}" rx="1" {style}/>'
                )
    return _svg("".join(parts), len(rows) * step, "IoU per class")


def histogram(counts: np.ndarray, colors: np.ndarray) -> str:
    """Distribution of values from 0 to 1.

    counts: (B,) how many values lie in each of equal parts; colors: (B, 3) uint8 RGB
    """
    shares = counts / max(counts.sum(), 1)
    height, width = 150, 100 / len(colors)
    parts = [f'<line class="axis" x1="0" x2="100%" y1="{height}" y2="{height}"/>']
    for number, (share, color) in enumerate(zip(shares, colors, strict=True)):
        bar = (height - 14) * share / max(shares.max(), 1e-12)
        parts.append(
            f'<rect x="{number * width + 0.15 * width:.2f}%" y="{height - bar:.1f}" width="{0.7 * width:.2f}%" height="{bar:.1f}" '
            f'fill="{css_color(color)}"><title>{number / len(colors):.2f} to {(number + 1) / len(colors):.2f}: {share:.1%}</title></rect>'
        )
    peak = int(shares.argmax())
    anchor = "end" if peak > 0.8 * len(colors) else "start"
    parts.append(
        f'<text class="soft" x="{(peak + (anchor == "end")) * width:.2f}%" y="{9}" text-anchor="{anchor}">{shares.max():.0%}</text>'
    )
    for place, anchor in ((0, "start"), (0.5, "middle"), (1, "end")):
        parts.append(
            f'<text class="soft" x="{100 * place}%" y="{height + 16}" text-anchor="{anchor}">{place:g}</text>'
        )
    return _svg("".join(parts), height + 20, "Confidence of the points")


def reliability_curve(bins: Sequence[tuple[float | None, float | None, float | None]]) -> str:
    """Accuracy over confidence, both from 0 to 1, with the diagonal of perfect calibration and a bar for the
    share of each bin.

    bins: mean confidence, accuracy and share of the judged pixels of each bin, in order; None in bins without
        pixels
    """
    height, width = 190, 100 / len(bins)
    filled = [
        (confidence, accuracy, share, position)
        for position, (confidence, accuracy, share) in enumerate(bins)
        if confidence is not None and accuracy is not None and share is not None
    ]
    largest = max([share for _, _, share, _ in filled], default=0) or 1
    parts = [
        f'<line class="axis" x1="0" x2="100%" y1="{y:g}" y2="{y:g}"/>' for y in (0.5, height / 2, height)
    ]
    for _, _, share, position in filled:
        bar = 0.45 * height * share / largest
        parts.append(
            f'<rect class="track" x="{position * width + 0.1 * width:.2f}%" y="{height - bar:.1f}" width="{0.8 * width:.2f}%" height="{bar:.1f}"/>'
        )
    parts.append(f'<line class="ideal" x1="0" y1="{height}" x2="100%" y2="0"/>')
    spots = [(100 * confidence, height * (1 - accuracy)) for confidence, accuracy, _, _ in filled]
    parts += [
        f'<line class="curve" x1="{x:.2f}%" y1="{y:.1f}" x2="{end_x:.2f}%" y2="{end_y:.1f}"/>'
        for (x, y), (end_x, end_y) in zip(spots, spots[1:])
    ]
    for (x, y), (confidence, accuracy, share, _) in zip(spots, filled, strict=True):
        text = f"confidence {confidence:.2f}: {accuracy:.1%} right, {share:.1%} of the pixels"
        parts.append(
            f'<circle class="spot" cx="{x:.2f}%" cy="{y:.1f}" r="4.5"><title>{text}</title></circle>'
        )
    for value, y in ((1, 13), (0.5, height / 2 - 4)):
        parts.append(f'<text class="soft" x="0" y="{y:g}">{value:.0%}</text>')
    for place, anchor in ((0, "start"), (0.5, "middle"), (1, "end")):
        parts.append(
            f'<text class="soft" x="{100 * place}%" y="{height + 16}" text-anchor="{anchor}">{place:g}</text>'
        )
    return _svg("".join(parts), height + 20, "Reliability of the confidence")


def stacked_bar(rows: Sequence[tuple[str, Color, float]]) -> str:
    """One bar divided by shares. rows: name, color, share from 0 to 1."""
    parts, start = [], 0.0
    for name, color, share in rows:
        parts.append(
            f'<rect x="{100 * start:.3f}%" y="0" width="{100 * share:.3f}%" height="28" fill="{css_color(color)}">'
            f"<title>{html.escape(name)}: {share:.2%}</title></rect>"
        )
        start += share
    return _svg("".join(parts), 28, "Shares")


def flight_map(
    centers: np.ndarray,
    headings: np.ndarray,
    names: Sequence[str],
    ground: tuple[str, tuple[float, float, float, float]] | None,
) -> str:
    """Camera positions seen from above, north (+y) up, with a scale bar.

    centers: (M, 2) x and y, world units; headings: (M, 2) horizontal part of the viewing direction
    ground: data URI of a picture from above and its (x minimum, y minimum, x maximum, y maximum)
    """
    boxes = [np.array(ground[1])] if ground else []
    low = np.min([centers.min(axis=0), *(box[:2] for box in boxes)], axis=0)
    high = np.max([centers.max(axis=0), *(box[2:] for box in boxes)], axis=0)
    span = max(float((high - low).max()), 1e-6)
    low, high = low - 0.05 * span, high + 0.05 * span
    scale = 600 / max(float((high - low).max()), 1e-6)
    width, height = (high - low) * scale
    parts = []
    if ground:
        x_low, y_low, x_high, y_high = ground[1]
        parts.append(
            f'<image href="{ground[0]}" x="{(x_low - low[0]) * scale:.1f}" y="{(high[1] - y_high) * scale:.1f}" '
            f'width="{(x_high - x_low) * scale:.1f}" height="{(y_high - y_low) * scale:.1f}" preserveAspectRatio="none"/>'
        )
    for (x, y), (east, north), name in zip((centers - low) * scale, headings, names, strict=True):
        y = height - y
        parts.append(
            f'<g class="camera"><line x1="{x:.1f}" y1="{y:.1f}" x2="{x + 36 * east:.1f}" y2="{y - 36 * north:.1f}"/>'
            f'<circle cx="{x:.1f}" cy="{y:.1f}" r="4.5"/><title>{html.escape(name)}</title></g>'
        )
    length = _round_length(span / 4)
    parts.append(
        f'<path class="scale" d="M10 {height + 12:.1f}v6h{length * scale:.1f}v-6"/>'
        f'<text x="{18 + length * scale:.1f}" y="{height + 20:.1f}">{length:g} m</text>'
        f'<text x="{width - 6:.1f}" y="{height + 20:.1f}" text-anchor="end">north up</text>'
    )
    return f'<svg class="map" viewBox="0 0 {width:.1f} {height + 28:.1f}" role="img" aria-label="Camera positions">{"".join(parts)}</svg>'


def count_map(counts: np.ndarray) -> str:
    """(H, W) int numbers as a map of squares, darker for more, up to ten."""
    side = 600 / max(counts.shape)
    parts = [
        f'<rect x="{column * side:.1f}" y="{row * side:.1f}" width="{side:.1f}" height="{side:.1f}" '
        f'fill="#2a6f97" fill-opacity="{min(int(counts[row, column]), 10) / 10:g}"><title>{counts[row, column]} photos</title></rect>'
        for row, column in np.argwhere(counts > 0)
    ]
    height, width = np.array(counts.shape) * side
    return f'<svg class="map" viewBox="0 0 {width:.1f} {height:.1f}" role="img" aria-label="Photos per place">{"".join(parts)}</svg>'


def _round_length(length: float) -> float:
    power = 10.0 ** np.floor(np.log10(length))
    return float(max(step * power for step in (1, 2, 5) if step * power <= length * 1.0001))


def _value(value: float | None) -> str:
    return "" if value is None else f"{value:.3f}"


def _svg(content: str, height: float, label: str) -> str:
    return f'<svg class="chart" width="100%" height="{height:.0f}" role="img" aria-label="{html.escape(label)}">{content}</svg>'
