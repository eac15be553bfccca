"""Looking at a scene: colors, pictures without a display, labels in the photos, the window."""

from sc3d.view.colors import COLORINGS, STATES, color_points
from sc3d.view.screenshot import PointImage, Style, draw_points, screenshot
from sc3d.view.viewpoints import aerial_view
from sc3d.view.window import show

__all__ = [
    "COLORINGS",
    "STATES",
    "PointImage",
    "Style",
    "aerial_view",
    "color_points",
    "draw_points",
    "screenshot",
    "show",
]
