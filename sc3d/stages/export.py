"""Labelled scene -> files for other programs, each format by a module of `sc3d.exports`."""

from __future__ import annotations

import importlib
from pathlib import Path

from sc3d.scene import Scene
from sc3d.settings import Export

MODULES = {"masks": "masks", "laz": "laz", "clouds": "clouds", "splats": "splats", "spz": "splats", "orthophoto": "orthophoto", "objects": "objects"}


def inputs(scene: Scene, settings: Export) -> list[Path]:
    return [scene.sparse, scene.classes, scene.mesh, settings.labelled or scene.labelled, scene.gaussians]


def outputs(scene: Scene, settings: Export) -> list[Path]:
    return [path for name in settings.format for path in _module(name).outputs(scene, settings)]


def run(scene: Scene, settings: Export) -> dict[str, object]:
    scene.require(scene.classes, hint="copy the class table of the labels there")
    figures = {}
    for name in dict.fromkeys(settings.format):
        figures |= {f"{name}_{key}": value for key, value in _module(name).write(scene, settings).items()}
    return figures


def _module(name: str):  # noqa: ANN202 - a module of sc3d.exports; its packages load late
    return importlib.import_module(f"sc3d.exports.{MODULES[name]}")
