"""Settings -> a complete scene with truth."""

from __future__ import annotations

from pathlib import Path

from tqdm import tqdm

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
    with tqdm(total=100, desc="synthesize", unit="%", disable=None) as bar:

        def show(share: float, text: str) -> None:
            bar.update(round(100 * share) - bar.n)
            bar.set_postfix_str(text)

        return synthesize(scene.path, settings, show)
