"""Whether a window can be opened here."""

from __future__ import annotations

import ctypes
import os
import sys

from sc3d.errors import Sc3dError


def check_display() -> None:
    """Raise Sc3dError that says what to do where no window can be opened."""
    if not has_display():
        raise Sc3dError(
            "no display to open a window on: `sc3d view SCENE --screenshot FILE` renders a picture without one, --web shows it in a browser"
        )


def has_display() -> bool:
    """Whether a window can be opened; on Linux an X server (or XWayland) must answer."""
    if not sys.platform.startswith("linux"):
        return True
    if not os.environ.get("DISPLAY"):
        return False
    try:
        x11 = ctypes.CDLL("libX11.so.6")
    except OSError:
        return False
    x11.XOpenDisplay.restype = ctypes.c_void_p
    display = x11.XOpenDisplay(None)
    if display:
        x11.XCloseDisplay(ctypes.c_void_p(display))
    return bool(display)
