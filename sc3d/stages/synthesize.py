"""Settings -> a complete scene with truth."""

from __future__ import annotations

from pathlib import Path

from sc3d.io.progress import Progress
from sc3d.scene.scene import Scene
from sc3d.settings.synthesize import Synthesize
from sc3d.synthetic.generate import synthesize


def inputs(scene: Scene, settings: Synthesize) -> list[Path]:
    return []


def outputs(scene: Scene, settings: Synthesize) -> list[Path]:
    return [
        scene.images,
        scene.path / "truth_depth",
        *([scene.path / "truth_sky"] if settings.kind == "street" else []),
        scene.truth,
        scene.masks,
        scene.confidence,
        scene.sparse,
        scene.classes,
        scene.path / "truth.ply",
    ]


def run(scene: Scene, settings: Synthesize) -> dict[str, object]:
    with Progress(100, "making", "%") as bar:

        def show(share: float, text: str) -> None:
            bar.advance_to(round(100 * share))
            bar.show(text)

        return synthesize(scene.path, settings, show)
