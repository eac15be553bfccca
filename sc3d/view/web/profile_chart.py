"""A profile as a small chart, SVG in HTML."""

from __future__ import annotations

import numpy as np

from sc3d.view.measurements import Profile

MOST_DOTS = 3000
WIDTH, HEIGHT, LEFT, BOTTOM, TOP = 330, 160, 46, 26, 8  # px


def profile_svg(profile: Profile, colors: np.ndarray, unit: str) -> str:
    """Heights over the distance along the line, a dot per point, MOST_DOTS of them if there are more, which the
    chart says.

    colors: (N, 3) uint8 RGB of the profile's points
    """
    count = len(profile.rows)
    rows = np.arange(count) if count <= MOST_DOTS else np.linspace(0, count - 1, MOST_DOTS).astype(np.int64)
    low, high = float(profile.height.min()), float(profile.height.max())
    high = high if high > low else low + 1.0
    across = LEFT + profile.along[rows] / profile.length * (WIDTH - LEFT - 6)
    down = HEIGHT - BOTTOM - (profile.height[rows] - low) / (high - low) * (HEIGHT - BOTTOM - TOP)
    dots = [
        f"<circle cx='{x:.1f}' cy='{y:.1f}' r='1.3' fill='rgb({red},{green},{blue})'/>"
        for x, y, (red, green, blue) in zip(across, down, colors[rows].tolist())
    ]
    axes = (
        f"<path d='M{LEFT} {TOP}V{HEIGHT - BOTTOM}H{WIDTH - 6}' fill='none' stroke='currentColor'/>"
        f"<text x='{LEFT - 4}' y='{TOP + 8}' text-anchor='end'>{high:.2f}</text>"
        f"<text x='{LEFT - 4}' y='{HEIGHT - BOTTOM}' text-anchor='end'>{low:.2f}</text>"
        f"<text x='{LEFT}' y='{HEIGHT - BOTTOM + 12}'>0</text>"
        f"<text x='{WIDTH - 6}' y='{HEIGHT - BOTTOM + 12}' text-anchor='end'>{profile.length:.2f} {unit}</text>"
    )
    vertical = (high - low) / (HEIGHT - BOTTOM - TOP)
    stretch = profile.length / (WIDTH - LEFT - 6) / vertical
    told = f"heights drawn {stretch:.3g} times as large as lengths"
    told += f"; {len(rows):,} of {count:,} points drawn" if len(rows) < count else ""
    return (
        f"<svg class='profile' role='img' aria-label='profile' viewBox='0 0 {WIDTH} {HEIGHT}' "
        f"style='display:block;width:100%;font-size:9px;font-family:sans-serif' fill='currentColor'>"
        f"{axes}{''.join(dots)}<text x='{LEFT}' y='{HEIGHT - 3}'>{told}</text></svg>"
    )
