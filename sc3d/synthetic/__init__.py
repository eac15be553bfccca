"""A synthetic aerial site: known geometry, cameras and labels, photographed as by a drone. Heavy imports
happen on first use.
"""

from importlib import import_module

from sc3d.settings.synthesize import Synthesize

_HOMES = {
    "World": "world",
    "build_world": "world",
    "fly": "flight",
    "Photo": "photos",
    "photograph": "photos",
    "noisy_mask": "masks",
    "truth_cloud": "cloud",
    "synthesize": "generate",
}
__all__ = ["Synthesize", *_HOMES]


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
