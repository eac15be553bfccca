"""Sky that masks show: which values are sky, in every format, and what is not clear is refused."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from sc3d.errors import InputError
from sc3d.scene.class_table import ClassTable, parse_classes
from sc3d.stereo.given_sky import SKY, SURFACE, UNTOLD, GivenSky, read_given_sky

WIDTH, HEIGHT = 24, 16
SIZES = {"a.jpg": (WIDTH, HEIGHT), "b.jpg": (WIDTH, HEIGHT)}
BUILDING = {"id": 1, "name": "building", "color": [214, 60, 60]}
SKY_CLASS = {"id": 5, "name": "Sky", "color": [90, 160, 250]}
TABLE = parse_classes([BUILDING, SKY_CLASS], "test")
BARE = parse_classes([BUILDING], "test")
ABOVE = np.arange(HEIGHT)[:, None] < np.full(WIDTH, 6)
BELOW = np.arange(HEIGHT)[:, None] >= np.full(WIDTH, 10)


@pytest.fixture
def photos(tmp_path) -> Path:
    folder = tmp_path / "images"
    folder.mkdir()
    for name in SIZES:
        Image.fromarray(np.zeros((HEIGHT, WIDTH, 3), np.uint8)).save(folder / name)
    return folder


def pngs(photos: Path, *pixels: np.ndarray | Image.Image) -> Path:
    folder = photos.parent / "sky"
    folder.mkdir()
    for name, mask in zip(SIZES, pixels, strict=False):
        image = mask if isinstance(mask, Image.Image) else Image.fromarray(mask)
        image.save(folder / f"{Path(name).stem}.png")
    return folder


def read(photos: Path, path: Path, table: ClassTable | None) -> GivenSky:
    return read_given_sky(path, SIZES, table, photos)


def gray(value: int, depth: type = np.uint8) -> np.ndarray:
    return np.where(ABOVE, depth(value), depth(0))


def palette(pixels: np.ndarray, *colors: tuple[int, int, int]) -> Image.Image:
    image = Image.fromarray(pixels, "P")
    image.putpalette([value for color in colors for value in color])
    return image


BINARY = {
    "255": gray(255),
    "1": gray(1),
    "1 bit": Image.fromarray(ABOVE),
    "colors alike": np.repeat(gray(255)[..., None], 3, axis=2),
    "gray palette in any order": palette(gray(0) + ~ABOVE, (255, 255, 255), (0, 0, 0)),
}


@pytest.mark.parametrize(
    ("name", "table"), [*((name, None) for name in BINARY), *((name, BARE) for name in BINARY if name != "1")]
)
def test_binary_masks_are_sky_and_else_none(photos, name, table):
    masks = read(photos, pngs(photos, BINARY[name], gray(0)), table)
    np.testing.assert_array_equal(masks["a.jpg"](), np.where(ABOVE, SKY, SURFACE))
    assert (masks["b.jpg"]() == SURFACE).all()


@pytest.mark.parametrize("name", BINARY)
def test_with_classes_without_surface_they_are_binary_where_their_value_is_no_class(photos, name):
    path = pngs(photos, BINARY[name])
    if name not in ("255", "colors alike"):  # 1 is a building
        with pytest.raises(InputError, match="which is a class with a surface"):
            read(photos, path, TABLE)
        return
    np.testing.assert_array_equal(read(photos, path, TABLE)["a.jpg"](), np.where(ABOVE, SKY, SURFACE))


def classes(sky: int = 5) -> np.ndarray:
    return np.where(ABOVE, sky, np.where(BELOW, 1, 0)).astype(np.uint8)


@pytest.mark.parametrize("colored", [False, True])
def test_masks_of_classes_also_say_where_surface_is(photos, colored):
    masks = classes(), np.ones((HEIGHT, WIDTH), np.uint8)
    path = pngs(photos, *(TABLE.palette[mask] for mask in masks) if colored else masks)
    found = read(photos, path, TABLE)
    expected = np.where(ABOVE, SKY, np.where(BELOW, SURFACE, UNTOLD))
    np.testing.assert_array_equal(found["a.jpg"](), expected)
    assert (found["b.jpg"]() == SURFACE).all()


@pytest.mark.parametrize("table", [None, BARE, TABLE])
def test_annotations_of_sky(photos, table):
    path = photos.parent / "a.json"
    shape = {"label": "sky", "shape_type": "polygon", "points": [[0, 0], [WIDTH, 0], [WIDTH, 6], [0, 6]]}
    path.write_text(
        json.dumps({"shapes": [shape], "imagePath": "a.jpg", "imageWidth": WIDTH, "imageHeight": HEIGHT})
    )
    masks = read(photos, path, table)
    assert list(masks) == ["a.jpg"]
    np.testing.assert_array_equal(masks["a.jpg"](), np.where(ABOVE, SKY, UNTOLD))


@pytest.mark.parametrize(
    ("table", "pixels", "told"),
    [
        (TABLE, gray(1), "which is a class with a surface"),
        (BARE, gray(1), "which is a class with a surface"),
        (TABLE, classes(sky=0), "which is a class with a surface"),
        (TABLE, classes(sky=7), "class id 7.*--mapping"),
        (
            parse_classes([BUILDING, BUILDING | {"id": 2, "name": "b"}, SKY_CLASS], "t"),
            classes(2),
            "no mask in",
        ),
        (BARE, classes(), "are not binary"),
        (None, classes(), "are not binary"),
        (None, gray(7), "are not binary"),
        (None, gray(0), "show no sky"),
        (BARE, np.where(ABOVE, np.uint8(255), np.uint8(1)), "are not binary"),
        (None, gray(255)[:, :9], "aspect"),
    ],
)
def test_what_is_not_clear_or_shows_no_sky_is_refused(photos, table, pixels, told):
    with pytest.raises(InputError, match=told) as error:
        read(photos, pngs(photos, pixels), table)
    assert "\n" not in str(error.value)


def test_missing_masks_are_refused(photos):
    with pytest.raises(InputError, match="is missing"):
        read(photos, photos.parent / "none", None)


def test_masks_follow_the_orientation_of_their_photos(photos):
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(np.zeros((HEIGHT, WIDTH, 3), np.uint8)).save(photos / "a.jpg", exif=exif)
    shown = np.rot90(gray(255), -1).copy()
    masks = read(photos, pngs(photos, shown), None)
    np.testing.assert_array_equal(masks["a.jpg"](), np.where(ABOVE, SKY, SURFACE))
