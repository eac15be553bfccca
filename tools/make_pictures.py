"""By hand and in CI: `python tools/make_pictures.py [--work FOLDER] [NAME ...]` makes the pictures of the manual again, all or those named:
of the numbered examples, and of the faults of `why-is-my-result-bad.md`, each beside the same small site as it should be.
"""

from __future__ import annotations

import argparse
import runpy
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import open3d as o3d
from PIL import Image

from sc3d.commands.run import run
from sc3d.io.clouds import read_cloud, read_mesh
from sc3d.io.messages import start_logging
from sc3d.runner import execute
from sc3d.scene.scene import Scene
from sc3d.settings.labels import Segment
from sc3d.settings.outputs import Run
from sc3d.settings.reconstruction import Depth, Extract
from sc3d.settings.synthesize import Synthesize
from sc3d.view.colors import Coloring
from sc3d.view.contact_sheet import side_by_side
from sc3d.view.display_cloud import load_cloud
from sc3d.view.screenshot import Style, screenshot

DATA = Path(__file__).resolve().parents[1] / "data"
MANUAL, CLASSES = DATA / "manual", DATA / "classes.json"
PICTURES = MANUAL / "pictures"
SITE = Synthesize(views=18, width=400, extent=50.0, altitude=50.0, num_points=1000)
SIZE, LARGEST_SIDE, QUALITY = (560, 400), 400, 82
PLAIN = Style(by="photo", legend=False)

Edit = Callable[
    [np.ndarray, int], "np.ndarray | None"
]  # of pixels and number of a photo or mask; None = left out


@dataclass(frozen=True)
class Fault:
    """What goes wrong, and how it is looked at: left the good scene (with `unconfirmed` the bad one without
    that), right the bad one. Without `photos` and `largest_side` the geometry is that of the good scene.
    """

    good: str
    bad: str
    photos: Edit | None = None
    masks: Edit | None = None
    largest_side: int = LARGEST_SIDE
    by: Coloring = "label"
    bad_by: Coloring | None = None
    of: str = ""  # the scene that is looked at, if it is that of another fault, or the good one
    unconfirmed: bool = False


def moved(pixels: np.ndarray, number: int) -> np.ndarray:
    """As from a camera that turns while the shutter is open."""
    return cv2.filter2D(pixels, -1, np.full((1, 11), 1 / 11))


def overexposed(pixels: np.ndarray, number: int) -> np.ndarray:
    """Three times the light that it takes."""
    return np.clip(pixels * 3.0, 0, 255).astype(np.uint8)


def as_it_is(pixels: np.ndarray, number: int) -> np.ndarray:
    return pixels


def only(*numbers: int) -> Edit:
    """These photos alone."""
    return lambda pixels, number: pixels if number in numbers else None


def other_ids(mask: np.ndarray, number: int) -> np.ndarray:
    """Numbered as another program does: building 4, tree 1, road 2, grass 3."""
    return np.array([0, 4, 1, 2, 3], np.uint8)[mask]


def shifted(mask: np.ndarray, number: int) -> np.ndarray:
    """By an eighth of the width."""
    return np.roll(mask, mask.shape[1] // 8, axis=1)


def generous(mask: np.ndarray, number: int) -> np.ndarray:
    """Buildings are drawn with a wide margin."""
    near = cv2.dilate((mask == 1).astype(np.uint8), np.ones((31, 31), np.uint8)) > 0
    return np.where(near, 1, mask).astype(np.uint8)


FAULTS = {
    "few-photos": Fault("18 photos", "6 of them", photos=only(0, 3, 5, 7, 10, 14), by="photo"),
    "blurred": Fault("sharp photos", "blurred by motion", photos=moved, by="photo"),
    "overexposed": Fault("as exposed", "overexposed", photos=overexposed, by="photo"),
    "coarse": Fault("depth at 400 px", "at 120 px", largest_side=120, by="photo"),
    "unconfirmed": Fault(
        "blurred, what two photos show", "with --unconfirmed", of="blurred", unconfirmed=True, by="photo"
    ),
    "other-ids": Fault("ids of classes.json", "ids of another program", masks=other_ids),
    "shifted": Fault("masks of the photos", "shifted by an eighth", masks=shifted),
    "few-masks": Fault("18 masks: where labels come from", "1 mask", masks=only(0), by="state"),
    "generous": Fault("masks as given", "buildings with a margin", masks=generous),
    "no-class": Fault(
        "cars in the photos", "classes.json has no cars", of="good", by="photo", bad_by="label"
    ),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(names()))
    parser.add_argument("--work", type=Path, help="folder to keep the scenes in, to go on from")
    parser.add_argument("--output", type=Path, default=PICTURES)
    asked = parser.parse_args()
    if unknown := set(asked.names) - set(names()):
        parser.error(f"no picture is called {', '.join(sorted(unknown))}")
    start_logging()
    asked.output.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="sc3d-pictures-") as temporary:
        for name in asked.names or names():
            draw = draw_fault if name in FAULTS else draw_example
            image = draw(name, (asked.work or Path(temporary)).absolute())
            Image.fromarray(image).save(asked.output / f"{name}.jpg", quality=QUALITY)


def names() -> list[str]:
    """Of all pictures."""
    return [*sorted(path.stem for path in (MANUAL / "examples").glob("*.py")), *FAULTS]


def draw_fault(name: str, work: Path) -> np.ndarray:
    """(H, W, 3) uint8 RGB: the scene as it should be, and what the fault makes of it."""
    fault, good = FAULTS[name], good_scene(work)
    bad = Scene(work / (fault.of or name))
    if not fault.of or not bad.labelled.exists():
        bad = make(bad.path.name, FAULTS[bad.path.name], good, work)
    left = look(bad if fault.unconfirmed else good, fault.by, False)
    return side_by_side(
        [left, look(bad, fault.bad_by or fault.by, fault.unconfirmed)], [fault.good, fault.bad]
    )


def good_scene(work: Path) -> Scene:
    """The scene as it should be, made unless it is there."""
    site = Scene(work / "site")
    execute("synthesize", site, SITE)
    return chain(Given(site.images, site.masks, site.confidence), Scene(work / "good"))


@dataclass(frozen=True)
class Given:
    """Folders that a chain starts from."""

    photos: Path
    masks: Path
    confidence: Path


def make(name: str, fault: Fault, good: Scene, work: Path) -> Scene:
    """The scene of a fault, made anew."""
    site, scene, folder = Scene(work / "site"), Scene(work / name), work / f"{name}-given"
    for old in (scene.path, folder):
        shutil.rmtree(old, ignore_errors=True)
    photos = site.images
    if fault.photos is not None:
        photos = edited(site.images, folder / "photos", fault.photos, names_in(site.images))
    elif fault.largest_side == LARGEST_SIDE:  # the shape is the good one
        shutil.copytree(good.path, scene.path, symlinks=True)
    masks = edited(site.masks, folder / "masks", fault.masks or as_it_is, names_in(photos))
    confidence = edited(site.confidence, folder / "confidence", as_it_is, names_in(masks))
    return chain(Given(photos, masks, confidence), scene, fault.largest_side)


def chain(given: Given, scene: Scene, largest_side: int = LARGEST_SIDE) -> Scene:
    """The scene after `sc3d run`."""
    run(
        Run(
            given.photos,
            scene.path,
            classes=CLASSES,
            segment=Segment(masks=given.masks, confidence=given.confidence),
            depth=Depth(max_size=largest_side),
            extract=Extract(method="depth", max_size=largest_side),
        )
    )
    return scene


def names_in(folder: Path) -> set[str]:
    """Of files, without suffix."""
    return {path.stem for path in folder.iterdir()}


def edited(source: Path, target: Path, edit: Edit, kept: set[str]) -> Path:
    """The folder `target` with what `edit` makes of the images; kept: of those with these names alone."""
    target.mkdir(parents=True)
    for number, path in enumerate(sorted(source.iterdir())):
        with Image.open(path) as image:
            pixels, exif = edit(np.asarray(image), number), image.getexif()
        if pixels is not None and path.stem in kept:
            Image.fromarray(pixels).save(target / path.name, exif=exif, quality=95)
    return target


def look(scene: Scene, by: Coloring, unconfirmed: bool) -> np.ndarray:
    cloud = load_cloud(scene, unconfirmed=unconfirmed)
    return screenshot(
        cloud, size=SIZE, style=Style(by=by, legend=False, shading=0.5), class_table=scene.class_table()
    )


def draw_example(name: str, work: Path) -> np.ndarray:
    """(H, W, 3) uint8 RGB of what a numbered example makes."""
    folder = work / name
    folder.mkdir(parents=True, exist_ok=True)
    example = runpy.run_path(str(MANUAL / "examples" / f"{name}.py"))["main"]
    if name == "03_geometry_utilities":
        return draw_geometry(*example())
    example(folder)
    scene = Scene(folder / "scene")
    if scene.labelled.exists():
        by: list[Coloring] = ["label", "confidence"]
        return side_by_side([look(scene, each, True) for each in by], by)
    true = read_cloud(scene.path / "truth.ply")
    pictures = [screenshot(each, size=SIZE, style=PLAIN) for each in (read_mesh(scene.mesh), true)]
    return side_by_side(pictures, ["mesh of the Gaussians", "true cloud"])


def draw_geometry(points: np.ndarray, seen: np.ndarray, bend: np.ndarray) -> np.ndarray:
    """(H, W, 3) uint8 RGB: which points the camera sees, and how much each is bent."""
    values = {"seen by the camera": np.isin(np.arange(len(points)), seen), "curvature": 4 * bend}
    pictures = []
    for value in values.values():
        gray = np.repeat(40 + 200 * np.clip(value, 0, 1)[:, None], 3, axis=1).astype(np.uint8)
        cloud = o3d.t.geometry.PointCloud({"positions": points, "colors": gray})
        pictures.append(screenshot(cloud, size=SIZE, style=PLAIN))
    return side_by_side(pictures, list(values))


if __name__ == "__main__":
    main()
