"""Labelled scene -> files for other programs, each format by a module of `sc3d.exporters`."""

from __future__ import annotations

import importlib
from pathlib import Path

from sc3d.georeferencing.georeference import georeference_path
from sc3d.scene.scene import Scene
from sc3d.settings.outputs import Export

MODULES = {
    "masks": "masks",
    "laz": "laz",
    "copc": "copc",
    "3dtiles": "tiles3d",
    "clouds": "clouds",
    "splats": "splats",
    "spz": "spz",
    "orthophoto": "orthophoto",
    "dtm": "elevation",
    "dsm": "elevation",
    "ndsm": "elevation",
    "contours": "elevation",
    "objects": "objects",
    "object-clouds": "object_clouds",
    "transforms": "transforms",
    "colmap-text": "colmap_text",
    "kml": "camera_files",
    "csv": "camera_files",
}
CAMERAS_ONLY = {
    "transforms",
    "colmap-text",
    "kml",
    "csv",
}  # formats that hold no labels, and so need no class table


def inputs(scene: Scene, settings: Export) -> list[Path]:
    return [
        scene.sparse,
        scene.classes,
        *scene.surface,
        settings.labelled or scene.labelled,
        scene.gaussians,
        georeference_path(scene),
        *([scene.images, scene.masks] if "masks" in settings.format else []),  # which are shown beside
    ]


def outputs(scene: Scene, settings: Export) -> list[Path]:
    return [path for name in _names(settings) for path in _module(name).outputs(scene, settings)]


def besides(scene: Scene, settings: Export) -> list[Path]:
    modules = [_module(name) for name in _names(settings)]
    return [
        path for module in modules if hasattr(module, "besides") for path in module.besides(scene, settings)
    ]


def run(scene: Scene, settings: Export) -> dict[str, object]:
    if set(settings.format) - CAMERAS_ONLY:
        scene.require(scene.classes, hint="copy the class table of the labels there")
    figures: dict[str, object] = {}
    for name in _names(settings):
        figures |= {f"{name}_{key}": value for key, value in _module(name).write(scene, settings).items()}
    return figures


def _names(settings: Export) -> list[str]:
    """The formats, of those that one module writes together the first."""
    first = {MODULES[name]: name for name in reversed(settings.format)}
    return [name for name in dict.fromkeys(settings.format) if first[MODULES[name]] == name]


def _module(name: str):
    return importlib.import_module(f"sc3d.exporters.{MODULES[name]}")
