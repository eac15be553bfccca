"""Masks, strokes and annotations as other programs write them: palettes, turned photos, junk. Each is right, refused
in one line, or told with a number.
"""

from __future__ import annotations

import base64
import io
import json
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from sc3d.annotate.session import Session
from sc3d.errors import InputError
from sc3d.io.images import read_orientation
from sc3d.io.mask_images import read_index_image
from sc3d.io.orientation import inverse, turned, turned_points, turned_size
from sc3d.runner import execute
from sc3d.scene.class_table import parse_classes
from sc3d.scene.scene import Scene
from sc3d.segmentation.segment import Folders, Segmentation, segment_photos
from sc3d.segmentation.strokes.files import read_strokes
from sc3d.segmentation.text_prompts import replace_prompts
from sc3d.settings.labels import Segment
from tests.builders import ROOT, instance_of

TABLE = json.loads((ROOT / "data" / "classes.json").read_text())
COLORS = {entry["id"]: tuple(entry["color"]) for entry in TABLE}
NAMES = {entry["id"]: entry["name"] for entry in TABLE}
ORIENTATIONS = range(1, 9)
STORED = (48, 32)  # px of the photos


def bands(width: int = 48, height: int = 32) -> np.ndarray:
    """Ids 1 to 4 from left to right; the upper rows are 0, so that every turn is told from every other."""
    mask = np.repeat(np.arange(width)[None] * 4 // width + 1, height, axis=0).astype(np.uint8)
    mask[: height // 4] = 0
    return mask


def make_scene(path: Path, orientation: int = 1, size: tuple[int, int] = STORED) -> Scene:
    scene = Scene(path / "scene")
    scene.images.mkdir(parents=True)
    scene.classes.write_text(json.dumps(TABLE))
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.new("RGB", size, (90, 120, 60)).save(scene.images / "a.jpg", exif=exif)
    return scene


def palette_png(path: Path, mask: np.ndarray, order: list[int], colors: dict[int, tuple]) -> None:
    """A PNG whose index i stands for the class order[i]."""
    path.parent.mkdir(parents=True, exist_ok=True)
    lut = np.zeros(256, np.uint8)
    lut[order] = np.arange(len(order))
    image = Image.frombytes("P", mask.shape[::-1], lut[mask].tobytes())
    image.putpalette([value for label in order for value in colors[label]])
    image.save(path)


def imported(scene: Scene, masks: Path, **options: object) -> np.ndarray:
    execute("segment", scene, Segment(masks=masks, **options))
    return read_index_image(scene.masks / "a.png")


# palettes


def test_a_palette_of_the_class_tables_colors_counts(tmp_path, caplog):
    caplog.set_level("INFO")
    palette_png(tmp_path / "m" / "a.png", bands(), [0, 4, 2, 1, 3], {0: (0, 0, 0)} | COLORS)
    np.testing.assert_array_equal(imported(make_scene(tmp_path), tmp_path / "m"), bands())
    assert "1 masks are read by the colors of their palette" in caplog.text


def test_ids_are_asked_for(tmp_path):
    palette_png(tmp_path / "m" / "a.png", bands(), [0, 4, 2, 1, 3], {0: (0, 0, 0)} | COLORS)
    found = imported(make_scene(tmp_path), tmp_path / "m", format="index")
    assert found[-1, 0] == 3 and found[-1, -1] == 1


def test_a_palette_to_look_at_leaves_the_ids(tmp_path):
    other = {0: (0, 0, 0), 1: (128, 0, 0), 2: (0, 128, 0), 3: (128, 128, 0), 4: (0, 0, 128)}  # VOC
    palette_png(tmp_path / "m" / "a.png", bands(), [0, 1, 2, 3, 4], other)
    np.testing.assert_array_equal(imported(make_scene(tmp_path), tmp_path / "m"), bands())


@pytest.mark.parametrize("step", [1, 60])
def test_a_gray_palette_leaves_the_ids(tmp_path, step):
    palette_png(
        tmp_path / "m" / "a.png", bands(), [0, 1, 2, 3, 4], {row: (row * step,) * 3 for row in range(5)}
    )
    np.testing.assert_array_equal(imported(make_scene(tmp_path), tmp_path / "m"), bands())


def test_a_palette_that_may_be_either_is_refused(tmp_path):
    mixed = {0: (0, 0, 0), 1: COLORS[2], 2: COLORS[1], 3: (1, 2, 3), 4: (200, 0, 0)}
    palette_png(tmp_path / "m" / "a.png", np.minimum(bands(), 2), [0, 1, 2, 3, 4], mixed)
    with pytest.raises(InputError, match="--format index"):
        imported(make_scene(tmp_path), tmp_path / "m")


def test_an_optimized_gray_mask_holds_its_gray_levels(tmp_path):
    """PNG optimizers turn few gray levels into a palette of any order."""
    gray = {label: (label,) * 3 for label in range(5)}
    palette_png(tmp_path / "m" / "a.png", np.where(bands() == 4, 3, 0).astype(np.uint8), [0, 3], gray)
    with pytest.raises(InputError, match="different classes"):  # index 1 is a class, too
        imported(make_scene(tmp_path), tmp_path / "m")


@pytest.mark.parametrize(("bits", "top"), [(1, 1), (2, 3), (4, 4)])
def test_few_bits_hold_ids(tmp_path, bits, top):
    mask = np.minimum(bands(), top)
    png = tmp_path / "m" / "a.png"
    png.parent.mkdir()
    png.write_bytes(gray_png(mask, bits))
    np.testing.assert_array_equal(imported(make_scene(tmp_path), png.parent), mask)


def gray_png(values: np.ndarray, bits: int) -> bytes:
    """A gray PNG of 1, 2 or 4 bits, whose samples are the values."""
    import struct
    import zlib

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    height, width = values.shape
    digits = np.unpackbits(values[..., None], axis=-1)[..., -bits:].reshape(height, width * bits)
    rows = b"".join(b"\0" + np.packbits(row).tobytes() for row in digits)
    header = struct.pack(">IIBBBBB", width, height, bits, 0, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + chunk(b"IDAT", zlib.compress(rows))
        + chunk(b"IEND", b"")
    )


def test_gray_with_alpha_holds_ids(tmp_path):
    alpha = np.full(bands().shape, 255, np.uint8)
    alpha[:, :6] = 0
    (tmp_path / "m").mkdir()
    Image.fromarray(np.dstack([bands(), alpha]), "LA").save(tmp_path / "m" / "a.png")
    expected = bands()
    expected[:, :6] = 0
    np.testing.assert_array_equal(imported(make_scene(tmp_path), tmp_path / "m"), expected)


def test_sixteen_bits_need_a_mapping(tmp_path):
    (tmp_path / "m").mkdir()
    Image.fromarray(bands().astype(np.uint16) * 1000).save(tmp_path / "m" / "a.png")
    with pytest.raises(InputError, match="--mapping"):
        imported(make_scene(tmp_path), tmp_path / "m")
    mapping = tmp_path / "map.json"
    mapping.write_text(json.dumps({str(1000 * label): name for label, name in NAMES.items()}))
    np.testing.assert_array_equal(
        imported(make_scene(tmp_path / "b"), tmp_path / "m", mapping=mapping), bands()
    )


def test_palettes_in_the_scene_and_in_truth(tmp_path):
    scene = make_scene(tmp_path)
    palette_png(scene.masks / "a.png", bands(), [0, 4, 2, 1, 3], {0: (0, 0, 0)} | COLORS)
    np.testing.assert_array_equal(scene.read_mask(scene.masks / "a.png", "a.jpg"), bands())


def test_a_gray_palette_of_confidence_holds_gray_levels(tmp_path):
    scene = make_scene(tmp_path)
    palette_png(
        scene.confidence / "a.png", bands(), [4, 3, 2, 1, 0], {row: (row * 60,) * 3 for row in range(5)}
    )
    np.testing.assert_array_equal(
        scene.read_confidence(scene.confidence / "a.png", "a.jpg"), bands() * np.uint8(60)
    )


# orientation


@pytest.mark.parametrize("orientation", ORIENTATIONS)
def test_turning_and_back(orientation):
    image = np.arange(6).reshape(2, 3)
    exif = Image.Exif()
    exif[0x0112] = orientation
    stream = io.BytesIO()
    Image.fromarray(image.astype(np.uint8)).save(stream, "PNG", exif=exif)
    from PIL import ImageOps

    with Image.open(stream) as opened:
        shown = np.array(ImageOps.exif_transpose(opened))
    np.testing.assert_array_equal(turned(image, orientation), shown)
    np.testing.assert_array_equal(turned(turned(image, orientation), inverse(orientation)), image)
    row, column = 1, 0  # of the value 3
    x, y = turned_points(np.array([[column + 0.5, row + 0.5]]), (3, 2), orientation)[0]
    assert shown[int(y), int(x)] == 3


def shown_bands(orientation: int) -> np.ndarray:
    return bands(*turned_size(STORED, orientation))


def as_stored(orientation: int) -> np.ndarray:
    return turned(shown_bands(orientation), inverse(orientation))


def boxes(orientation: int) -> list[tuple[int, float, float, float, float]]:
    """Class and corners of the bands, px of the photo as shown."""
    width, height = turned_size(STORED, orientation)
    return [(label, (label - 1) * width / 4, height / 4, label * width / 4, height) for label in range(1, 5)]


def polygon(x0: float, y0: float, x1: float, y1: float) -> list[list[float]]:
    return [[x0, y0], [x1, y0], [x1, y1], [x0, y1]]


def labelme(orientation: int) -> str:
    width, height = turned_size(STORED, orientation)
    shapes = [
        {"label": NAMES[label], "shape_type": "polygon", "points": polygon(*box)}
        for label, *box in boxes(orientation)
    ]
    return json.dumps(
        {
            "shapes": shapes,
            "imagePath": "a.jpg",
            "imageWidth": width,
            "imageHeight": height,
            "imageData": None,
        }
    )


def coco(orientation: int) -> str:
    width, height = turned_size(STORED, orientation)
    annotations = [
        {"id": label, "image_id": 1, "category_id": label, "segmentation": [np.ravel(polygon(*box)).tolist()]}
        for label, *box in boxes(orientation)
    ]
    images = [{"id": 1, "file_name": "a.jpg", "width": width, "height": height}]
    categories = [{"id": label, "name": name} for label, name in NAMES.items()]
    return json.dumps({"images": images, "annotations": annotations, "categories": categories})


def cvat(orientation: int) -> str:
    width, height = turned_size(STORED, orientation)
    found = "".join(
        f'<box label="{NAMES[label]}" xtl="{x0}" ytl="{y0}" xbr="{x1}" ybr="{y1}" z_order="0"/>'
        for label, x0, y0, x1, y1 in boxes(orientation)
    )
    return f'<annotations><image id="0" name="a.jpg" width="{width}" height="{height}">{found}</image></annotations>'


@pytest.mark.parametrize("orientation", ORIENTATIONS)
@pytest.mark.parametrize(("name", "write"), [("a.json", labelme), ("coco.json", coco), ("cvat.xml", cvat)])
def test_annotations_of_the_photo_as_shown(tmp_path, orientation, name, write):
    (tmp_path / name).write_text(write(orientation))
    scene = make_scene(tmp_path, orientation)
    np.testing.assert_array_equal(imported(scene, tmp_path / name), as_stored(orientation))
    assert read_orientation(scene.masks / "a.png") == orientation  # viewers show it like the photo


@pytest.mark.parametrize("orientation", ORIENTATIONS)
def test_masks_of_the_photo_as_shown(tmp_path, orientation, caplog):
    scene = make_scene(tmp_path, orientation)
    (tmp_path / "m").mkdir()
    Image.fromarray(shown_bands(orientation)).save(tmp_path / "m" / "a.png")
    np.testing.assert_array_equal(imported(scene, tmp_path / "m"), as_stored(orientation))
    assert ("1 masks" in caplog.text) == (orientation in (2, 3, 4))
    # what sc3d has written is read back as it lies, by hand in the scene or from elsewhere
    np.testing.assert_array_equal(scene.read_mask(scene.masks / "a.png", "a.jpg"), as_stored(orientation))
    again = make_scene(tmp_path / "again", orientation)
    np.testing.assert_array_equal(imported(again, scene.masks), as_stored(orientation))
    # truth and masks put there by hand
    np.testing.assert_array_equal(scene.read_mask(tmp_path / "m" / "a.png", "a.jpg"), as_stored(orientation))
    assert scene.mask_size(tmp_path / "m" / "a.png", "a.jpg") == STORED


@pytest.mark.parametrize("orientation", [5, 6, 7, 8])
def test_sides_tell_masks_of_the_photo_as_stored(tmp_path, orientation):
    scene = make_scene(tmp_path, orientation)
    (tmp_path / "m").mkdir()
    Image.fromarray(bands()).save(tmp_path / "m" / "a.png")
    np.testing.assert_array_equal(imported(scene, tmp_path / "m"), bands())


@pytest.mark.parametrize("orientation", ORIENTATIONS)
def test_confidence_lies_as_its_mask(tmp_path, orientation):
    scene = make_scene(tmp_path, orientation)
    for folder, values in (("m", shown_bands(orientation)), ("c", shown_bands(orientation) * np.uint8(60))):
        (tmp_path / folder).mkdir()
        Image.fromarray(values).save(tmp_path / folder / "a.png")
    imported(scene, tmp_path / "m", confidence=tmp_path / "c")
    np.testing.assert_array_equal(
        read_index_image(scene.confidence / "a.png"), as_stored(orientation) * np.uint8(60)
    )


@pytest.mark.parametrize("orientation", ORIENTATIONS)
def test_strokes_of_the_photo_as_shown(tmp_path, orientation):
    scene = make_scene(tmp_path, orientation)
    scene.strokes.mkdir()
    (scene.strokes / "a.json").write_text(labelme(orientation))
    (strokes,) = read_strokes(scene.strokes, scene.images, scene.class_table())
    assert strokes.size == turned_size(STORED, orientation)
    painted = strokes.paint(*strokes.size)[0]
    shown = shown_bands(orientation)
    assert (painted[shown > 0] == shown[shown > 0]).mean() > 0.9
    Image.fromarray(scene.class_table().palette[shown] * (shown > 0)[..., None]).save(scene.strokes / "a.png")
    (scene.strokes / "a.json").unlink()
    (strokes,) = read_strokes(scene.strokes, scene.images, scene.class_table())
    np.testing.assert_array_equal(strokes.paint(*strokes.size)[0], np.where(shown > 0, shown.astype(int), -1))


def test_strokes_of_a_size_as_stored_are_turned(tmp_path):
    scene = make_scene(tmp_path, 6)
    scene.strokes.mkdir()
    (scene.strokes / "a.json").write_text(labelme(1))  # drawn where EXIF is not looked at
    (strokes,) = read_strokes(scene.strokes, scene.images, scene.class_table())
    painted = turned(strokes.paint(*strokes.size)[0], inverse(6))
    assert (painted[bands() > 0] == bands()[bands() > 0]).mean() > 0.9


@pytest.mark.parametrize("orientation", [1, 3, 6])
def test_annotate_shows_the_photo_as_shown(tmp_path, orientation):
    scene = make_scene(tmp_path, orientation)
    session = Session(scene)
    with Image.open(io.BytesIO(session.photo("a"))) as photo:
        assert photo.size == turned_size(STORED, orientation) == session.sizes["a"]
    session.save("a", json.loads(labelme(orientation)))
    saved = json.loads((scene.strokes / "a.json").read_text())
    assert (saved["imageWidth"], saved["imageHeight"]) == turned_size(STORED, orientation)
    np.testing.assert_allclose(saved["shapes"][0]["points"], polygon(*boxes(orientation)[0][1:]))


class Halves:
    """Says 1 for the left half of what it sees, and one object there."""

    def segment(self, image: np.ndarray) -> Segmentation:
        labels = np.zeros(image.shape[:2], np.uint8)
        labels[:, : image.shape[1] // 2] = 1
        return Segmentation(labels, labels * np.uint8(200), (instance_of(labels > 0, 1, 0.9, 0.9),))


@pytest.mark.parametrize("orientation", ORIENTATIONS)
def test_backends_see_the_photo_as_shown(tmp_path, orientation):
    scene = make_scene(tmp_path, orientation)
    folders = Folders(scene.masks, scene.confidence, scene.instances)
    segment_photos([scene.images / "a.jpg"], folders, Halves(), parse_classes(TABLE, "classes"))
    width, height = turned_size(STORED, orientation)
    shown = np.zeros((height, width), np.uint8)
    shown[:, : width // 2] = 1
    expected = turned(shown, inverse(orientation))
    np.testing.assert_array_equal(read_index_image(scene.masks / "a.png"), expected)
    again = make_scene(tmp_path / "again", orientation)
    np.testing.assert_array_equal(imported(again, scene.instances / "a.json"), expected)


# junk in strokes and annotations

BIG = int("9" * 500)


@pytest.mark.parametrize(
    "points",
    [
        [[BIG, 1], [2, 2], [3, 1]],
        [[float("nan"), 1], [2, 2], [3, 1]],
        [[float("inf"), 1], [2, 2], [3, 1]],
        [["a", 1], [2, 2], [3, 1]],
        [[[1, 2], 1], [2, 2], [3, 1]],
        [{"x": 1}, [2, 2], [3, 1]],
        [[None, 1], [2, 2], [3, 1]],
        [[True, 1], [2, 2], [3, 1]],
        "points",
        None,
        {},
    ],
)
def test_junk_points_are_refused(tmp_path, points):
    scene = make_scene(tmp_path)
    shape = {"label": "road", "shape_type": "polygon", "points": points}
    content = {"shapes": [shape], "imageWidth": 48, "imageHeight": 32}
    scene.strokes.mkdir()
    (scene.strokes / "a.json").write_text(json.dumps(content))
    with pytest.raises(InputError, match=r"shape 1: points"):
        read_strokes(scene.strokes, scene.images, scene.class_table())
    if points != [[True, 1], [2, 2], [3, 1]]:
        with pytest.raises(InputError):
            imported(scene, scene.strokes / "a.json")


@pytest.mark.parametrize("side", [BIG, -1, 0, "48", 1e400, None, [48], 1])
def test_junk_sizes_are_refused(tmp_path, side):
    scene = make_scene(tmp_path)
    shape = {"label": "road", "shape_type": "polygon", "points": [[1e4, 1], [2, 2], [3, 9e4]]}
    scene.strokes.mkdir()
    (scene.strokes / "a.json").write_text(
        json.dumps({"shapes": [shape], "imageWidth": side, "imageHeight": 1 if side == 1 else 32})
    )
    for read in (
        lambda: read_strokes(scene.strokes, scene.images, scene.class_table()),
        lambda: imported(scene, scene.strokes / "a.json"),
    ):
        with pytest.raises(InputError):
            read()


def test_strokes_outside_are_counted(tmp_path, caplog):
    scene = make_scene(tmp_path)
    shapes = json.loads(labelme(1))["shapes"]
    far = {"label": "road", "shape_type": "linestrip", "points": [[-9999, -9999], [-9990, -9999]], "width": 5}
    Image.new("RGB", STORED).save(scene.images / "b.jpg")
    scene.strokes.mkdir()
    for name, drawn in (("a", [*shapes, far]), ("b", [far])):
        (scene.strokes / f"{name}.json").write_text(json.dumps({"shapes": drawn}))
    execute("segment", scene, Segment(backend="strokes"))
    assert "2 shapes lie outside of their photos" in caplog.text
    assert "a.json: shape 5; b.json: shape 1" in caplog.text


def test_strokes_that_all_lie_outside_are_refused(tmp_path):
    scene = make_scene(tmp_path)
    far = {"label": "road", "shape_type": "linestrip", "points": [[-9999, -9999], [-9990, -9999]], "width": 5}
    scene.strokes.mkdir()
    (scene.strokes / "a.json").write_text(json.dumps({"shapes": [far]}))
    with pytest.raises(InputError, match="show no"):
        execute("segment", scene, Segment(backend="strokes"))


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("segmentation", [[BIG, 1, 2, 2, 3, 1]]),
        ("segmentation", [[1, [2], 3]]),
        ("segmentation", [["x"] * 6]),
        ("segmentation", [[float("nan")] * 6]),
        ("segmentation", {"size": [32, 48], "counts": [BIG]}),
        ("segmentation", {"size": [32, 48], "counts": {"a": 1}}),
        ("segmentation", {"counts": 5}),
        ("image_id", [1]),
        ("category_id", {}),
    ],
)
def test_junk_in_coco_is_refused(tmp_path, key, value):
    content = json.loads(coco(1))
    content["annotations"][0][key] = value
    (tmp_path / "coco.json").write_text(json.dumps(content))
    with pytest.raises(InputError):
        imported(make_scene(tmp_path), tmp_path / "coco.json")


@pytest.mark.parametrize(
    "element",
    [
        '<polygon label="road" points="nan,1;2,2;3,3"/>',
        '<polygon label="road" points="1e400,1;2,2;3,3"/>',
        f'<polygon label="road" points="{BIG},1;2,2;3,3"/>',
        '<box label="road" xtl="1" ytl="1" xbr="9" ybr="9" rotation="inf"/>',
        '<box label="road" xtl="1" ytl="1" xbr="9" ybr="9" rotation="nan"/>',
        '<ellipse label="road" cx="1" cy="1" rx="nan" ry="2"/>',
        f'<mask label="road" left="0" top="0" width="{"9" * 5000}" height="1" rle="1"/>',
        f'<box label="road" xtl="1" ytl="1" xbr="9" ybr="9" z_order="{"9" * 5000}"/>',
    ],
)
def test_junk_in_cvat_is_refused(tmp_path, element):
    text = f'<annotations><image id="0" name="a.jpg" width="48" height="32">{element}</image></annotations>'
    (tmp_path / "cvat.xml").write_text(text)
    with pytest.raises(InputError):
        imported(make_scene(tmp_path), tmp_path / "cvat.xml")


def test_a_damaged_picture_in_labelme_is_no_traceback(tmp_path):
    stream = io.BytesIO()
    Image.new("L", (10, 10)).save(stream, "PNG")
    for cut in range(8, len(stream.getvalue()), 7):
        text = base64.b64encode(stream.getvalue()[:cut] + b"\xff" * 5).decode()
        shape = {"label": "road", "shape_type": "mask", "points": [[0, 0], [9, 9]], "mask": text}
        (tmp_path / "a.json").write_text(json.dumps({"shapes": [shape], "imageWidth": 48, "imageHeight": 32}))
        with suppress(InputError):  # some cuts lose nothing
            imported(make_scene(tmp_path / str(cut)), tmp_path / "a.json")


@pytest.mark.parametrize(
    ("key", "value"),
    [("id", BIG), ("id", 1e400), ("color", [BIG, 0, 0]), ("color", [[1], 2, 3]), ("name", [1])],
)
def test_junk_in_the_class_table_is_refused(key, value):
    with pytest.raises(InputError):
        parse_classes([TABLE[0] | {key: value}], "classes.json")


def test_strokes_never_go_to_another_photo_without_a_word(tmp_path):
    scene = make_scene(tmp_path)
    photo = next(scene.images.iterdir())
    (scene.images / f"other{photo.suffix}").write_bytes(photo.read_bytes())
    shape = {"label": "road", "shape_type": "linestrip", "points": [[2, 2], [9, 9]]}
    content = {"shapes": [shape], "imageWidth": 48, "imageHeight": 32, "imagePath": photo.name}
    scene.strokes.mkdir()
    (scene.strokes / "other.json").write_text(json.dumps(content))  # a copy of a file for the first photo
    with pytest.raises(InputError, match="named after the photo other"):
        read_strokes(scene.strokes, scene.images, scene.class_table())
    (scene.strokes / "other.json").rename(scene.strokes / "anything.json")
    (scene.strokes / f"{photo.stem}.json").write_text(json.dumps(content))
    with pytest.raises(InputError, match="another file has some too"):
        read_strokes(scene.strokes, scene.images, scene.class_table())


@pytest.mark.parametrize("transparency", [5, bytes([255] * 5 + [0] + [255] * 250)])
@pytest.mark.parametrize("kind", ["colors", "ids"])
def test_transparent_entries_of_a_palette_are_no_class(tmp_path, transparency, kind):
    """As transparent pixels of RGB and RGBA masks are none."""
    scene, mask = make_scene(tmp_path), bands()
    hidden = mask.copy()
    hidden[:, :9] = 5  # drawn in the color of a class, but not seen
    order = [0, 4, 2, 1, 3, 1] if kind == "colors" else [0, 1, 2, 3, 4, 1]
    file = tmp_path / "m" / "a.png"
    palette_png(file, mask, order[:5], {0: (0, 0, 0)} | COLORS)
    with Image.open(file) as image:
        samples, colors = np.array(image), image.getpalette()
    samples[:, :9] = 5
    colors[15:18] = COLORS[1]
    drawn = Image.fromarray(samples)
    drawn.putpalette(colors)
    drawn.save(file, transparency=transparency)
    expected = np.where(hidden == 5, 0, mask)
    np.testing.assert_array_equal(imported(scene, tmp_path / "m"), expected)


@pytest.mark.parametrize("mode, clear", [("L", 2), ("1", 1)])
def test_a_transparent_gray_level_is_no_class(tmp_path, mode, clear):
    scene, file = make_scene(tmp_path), tmp_path / "m" / "a.png"
    file.parent.mkdir()
    values = np.where(bands() == 2, clear, 0 if mode == "1" else 1).astype(np.uint8)
    image = Image.fromarray(values * 255).convert("1") if mode == "1" else Image.fromarray(values)
    image.save(file, transparency=255 if mode == "1" else clear)
    np.testing.assert_array_equal(imported(scene, tmp_path / "m"), np.where(values == clear, 0, values))


# ids and colors in any kind of PNG, each file looked at alone


def colored(mask: np.ndarray, alpha: np.ndarray | None = None) -> Image.Image:
    rgb = np.array([(0, 0, 0), *(COLORS[label] for label in range(1, 5))], np.uint8)[mask]
    return Image.fromarray(rgb if alpha is None else np.dstack([rgb, alpha]))


def saved(path: Path, image: Image.Image | np.ndarray) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    (image if isinstance(image, Image.Image) else Image.fromarray(image)).save(path)
    return path


def in_channels(mask: np.ndarray) -> np.ndarray:
    return np.repeat(mask[..., None], 3, axis=2)


def wide_png(path: Path, pixels: np.ndarray) -> Path:
    """A PNG of 16 bits per channel; pixels: (H, W) or (H, W, 3)."""
    import cv2

    path.parent.mkdir(parents=True, exist_ok=True)
    wide = pixels.astype(np.uint16)
    cv2.imwrite(str(path), np.ascontiguousarray(wide[..., ::-1]) if wide.ndim == 3 else wide)
    return path


MEMBERS = {  # what a mask of `bands` may be, in one folder with any other
    "colors": lambda path: saved(path, colored(bands())),
    "colors with alpha": lambda path: saved(path, colored(bands(), np.full(bands().shape, 255, np.uint8))),
    "palette of colors": lambda path: palette_png(path, bands(), [0, 4, 2, 1, 3], {0: (0, 0, 0)} | COLORS),
    "palette of ids": lambda path: palette_png(
        path, bands(), [0, 1, 2, 3, 4], {row: (9, row, 9) for row in range(5)}
    ),
    "gray": lambda path: saved(path, bands()),
    "ids in three channels": lambda path: saved(path, in_channels(bands())),
    "16 bits": lambda path: wide_png(path, bands().astype(np.uint16)),
    "16 bits in three channels": lambda path: wide_png(path, in_channels(bands())),
    "colors of 16 bits": lambda path: wide_png(path, np.array(colored(bands())).astype(np.uint16) * 257),
}


@pytest.mark.parametrize("name", MEMBERS)
def test_every_kind_of_png_in_one_folder(tmp_path, name):
    """Imported, and as it lies in a folder of truth."""
    scene = make_scene(tmp_path)
    for row, kind in enumerate((name, "colors", "gray")):
        Image.new("RGB", STORED).save(scene.images / f"p{row}.jpg")
        MEMBERS[kind](tmp_path / "m" / f"p{row}.png")
    execute("segment", scene, Segment(masks=tmp_path / "m"))
    for row in range(3):
        np.testing.assert_array_equal(read_index_image(scene.masks / f"p{row}.png"), bands())
    np.testing.assert_array_equal(scene.read_mask(tmp_path / "m" / "p0.png", "p0.jpg"), bands())


def test_channels_that_may_be_ids_or_colors_are_refused(tmp_path):
    scene = make_scene(tmp_path)
    table = json.loads(json.dumps(TABLE))
    table[0]["color"] = [table[1]["id"]] * 3
    scene.classes.write_text(json.dumps(table))
    both = np.where(bands() > 2, table[1]["id"], 0).astype(np.uint8)
    saved(tmp_path / "m" / "a.png", in_channels(both))
    with pytest.raises(
        InputError, match=r"a\.png .* whose colors stand for different classes.*--format index"
    ):
        imported(scene, tmp_path / "m")
    with pytest.raises(InputError, match=r"a\.png .* stand for different classes"):
        scene.read_mask(tmp_path / "m" / "a.png", "a.jpg")
    np.testing.assert_array_equal(imported(scene, tmp_path / "m", format="index"), both)
    found = imported(scene, tmp_path / "m", format="color")
    np.testing.assert_array_equal(found, np.where(both > 0, table[0]["id"], 0))


def test_colors_of_16_bits_are_no_black(tmp_path):
    """Whose high byte alone was read."""
    wide_png(tmp_path / "m" / "a.png", np.dstack([bands(), bands() * 2, bands()]))
    with pytest.raises(InputError, match="16 bits that are none of 8"):
        imported(make_scene(tmp_path), tmp_path / "m")


@pytest.mark.parametrize("mode", ["gray", "channels", "16 bits"])
def test_a_binary_mask_is_told_what_to_say(tmp_path, mode):
    top = 65535 if mode == "16 bits" else 255
    mask = np.where(bands() > 2, top, 0).astype(np.uint16 if mode == "16 bits" else np.uint8)
    saved(tmp_path / "m" / "a.png", in_channels(mask) if mode == "channels" else mask)
    with pytest.raises(InputError, match="binary mask.*--mapping mapping.json") as told:
        imported(make_scene(tmp_path), tmp_path / "m")
    shown = f'{{"{top}": "{TABLE[0]["name"]}"}}'
    assert shown in str(told.value)
    mapping = tmp_path / "mapping.json"
    mapping.write_text(shown)
    found = imported(make_scene(tmp_path / "b"), tmp_path / "m", mapping=mapping)
    np.testing.assert_array_equal(found, np.where(mask > 0, TABLE[0]["id"], 0))


def test_a_mapping_of_ids_and_colors(tmp_path):
    scene = make_scene(tmp_path)
    Image.new("RGB", STORED).save(scene.images / "b.jpg")
    saved(tmp_path / "m" / "a.png", np.where(bands() > 2, 77, 0).astype(np.uint8))
    saved(tmp_path / "m" / "b.png", colored(np.where(bands() > 2, 4, 0)))
    mapping = tmp_path / "mapping.json"
    color = "#{:02x}{:02x}{:02x}".format(*COLORS[4])
    mapping.write_text(json.dumps({"77": NAMES[1], color: NAMES[2]}))
    np.testing.assert_array_equal(
        imported(scene, tmp_path / "m", mapping=mapping), np.where(bands() > 2, 1, 0)
    )
    np.testing.assert_array_equal(read_index_image(scene.masks / "b.png"), np.where(bands() > 2, 2, 0))


def test_confidence_in_three_channels(tmp_path):
    scene = make_scene(tmp_path)
    saved(scene.confidence / "a.png", in_channels(bands() * np.uint8(60)))
    found = scene.read_confidence(scene.confidence / "a.png", "a.jpg")
    np.testing.assert_array_equal(found, bands() * np.uint8(60))
    saved(scene.confidence / "a.png", colored(bands()))
    with pytest.raises(InputError, match="has colors: a confidence map is"):
        scene.read_confidence(scene.confidence / "a.png", "a.jpg")
    wide_png(scene.confidence / "a.png", bands())
    with pytest.raises(InputError, match="16 bits per pixel: a confidence map is"):
        scene.read_confidence(scene.confidence / "a.png", "a.jpg")


# what programs write otherwise: one rule for masks and strokes


def square(label: str, kind: str = "polygon", **more: object) -> dict:
    """An area of 12 x 8 px at column 6, row 10."""
    corners = {
        "rectangle": [[6, 10], [18, 18]],
        "mask": [[6, 10], [17, 17]],
        "circle": [[12, 14], [12, 18]],
        "linestrip": [[6, 14], [18, 14]],
    }
    return {"label": label, "shape_type": kind, "points": corners.get(kind, polygon(6, 10, 18, 18))} | more


def picture(mask: np.ndarray) -> str:
    stream = io.BytesIO()
    Image.fromarray(mask.astype(np.uint8)).save(stream, "PNG")
    return base64.b64encode(stream.getvalue()).decode()


CORNER = np.ones((8, 12), bool)
CORNER[:4, :6] = False  # of a mask shape


def both(tmp_path: Path, content: dict, orientation: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Class ids as `segment --masks` and as strokes read them, in the frame of the photo as stored."""
    scene = make_scene(tmp_path, orientation)
    scene.strokes.mkdir()
    (scene.strokes / "a.json").write_text(json.dumps(content))
    (strokes,) = read_strokes(scene.strokes, scene.images, scene.class_table())
    painted = np.maximum(strokes.paint(*strokes.size)[0], 0)
    return imported(scene, scene.strokes), turned(painted, inverse(orientation))


@pytest.mark.parametrize(
    ("shape", "size"),
    [
        (square(NAMES[2].upper()), (48, 32)),
        (square(f" {NAMES[2].title()} "), (48, 32)),
        (square(NAMES[2]), (48.0, 32.0)),
        (square(NAMES[2], "rectangle"), (48.0, 32)),
        (square(NAMES[2], "oriented_rectangle"), (48, 32)),
        (square(NAMES[2], "rotation"), (48, 32)),
        (square(NAMES[2], "mask", mask=picture(np.ones((8, 12)))), (48, 32)),
    ],
)
def test_masks_and_strokes_are_read_alike(tmp_path, shape, size):
    content = {"shapes": [shape], "imageWidth": size[0], "imageHeight": size[1]}
    mask, strokes = both(tmp_path, content)
    expected = np.zeros(STORED[::-1], np.uint8)
    expected[10:18, 6:18] = 2
    np.testing.assert_array_equal(mask, expected)
    differ = strokes != expected
    differ[9:19, 5:19] = False  # OpenCV draws the edge of polygons, too
    assert not differ.any() and (strokes[10:18, 6:18] == 2).all()


@pytest.mark.parametrize(
    ("stated", "orientation"),
    [("half", 1), *((kind, each) for kind in ("shown", "stored") for each in ORIENTATIONS)],
)
def test_mask_shapes_in_strokes(tmp_path, orientation, stated):
    size = {"shown": turned_size(STORED, orientation), "stored": STORED, "half": (24, 16)}[stated]
    shape = square(NAMES[2], "mask", mask=picture(CORNER))
    if stated == "half":
        shape |= {"points": [[3, 5], [8, 8]], "mask": picture(CORNER[::2, ::2])}
    content = {"shapes": [shape], "imageWidth": size[0], "imageHeight": size[1]}
    mask, strokes = both(tmp_path, content, orientation)
    if stated == "half":
        mask = np.repeat(np.repeat(mask, 2, 0), 2, 1)
    assert (mask == 2).sum() == CORNER.sum()
    np.testing.assert_array_equal(strokes, mask)


def test_mask_shapes_survive_the_page(tmp_path):
    scene = make_scene(tmp_path)
    shape = square(NAMES[2], "mask", mask=picture(CORNER))
    session = Session(scene)
    line = square(NAMES[1], "linestrip", width=2) | {"points": [[6, 28], [18, 28]]}
    session.save("a", {"shapes": [shape, line]})
    session.save("a", {"shapes": session.read("a")})
    first = session.read("a")[0]
    assert first["points"] == shape["points"] and first["shape_type"] == "mask"
    (strokes,) = read_strokes(scene.strokes, scene.images, scene.class_table())
    labels = strokes.paint(*STORED)[0]
    assert labels[11, 7] == -1 and labels[17, 17] == 2
    small = strokes.paint(6, 4)[0]
    assert 2 in small  # a small mask does not vanish


@pytest.mark.parametrize(
    "change",
    [{"mask": "no picture"}, {"mask": None}, {"points": [[40, 10], [51, 17]]}, {"mask": picture(CORNER * 0)}],
)
def test_junk_mask_shapes_in_strokes_are_refused(tmp_path, change):
    scene = make_scene(tmp_path)
    scene.strokes.mkdir()
    shape = square(NAMES[2], "mask", mask=picture(CORNER)) | change
    (scene.strokes / "a.json").write_text(json.dumps({"shapes": [shape]}))
    with pytest.raises(InputError, match="shape 1: the mask"):
        read_strokes(scene.strokes, scene.images, scene.class_table())


def test_background_of_strokes_in_other_letter_case(tmp_path):
    scene = make_scene(tmp_path)
    scene.strokes.mkdir()
    (scene.strokes / "a.json").write_text(json.dumps({"shapes": [square("_Background_")]}))
    (strokes,) = read_strokes(scene.strokes, scene.images, scene.class_table())
    assert strokes.shapes[0].label == 0


@pytest.mark.parametrize("kind", [float, str, lambda value: f"{value}.0"])
def test_numbers_of_coco_as_floats_and_texts(tmp_path, kind):
    content = json.loads(coco(1))
    for entry in content["images"]:
        entry |= {key: kind(entry[key]) for key in ("id", "width", "height")}
    for entry in content["annotations"]:
        entry |= {"category_id": kind(entry["category_id"])}
    (tmp_path / "coco.json").write_text(json.dumps(content))
    np.testing.assert_array_equal(imported(make_scene(tmp_path), tmp_path / "coco.json"), bands())


def test_numbers_of_cvat_as_floats(tmp_path):
    box = f'<mask label="{NAMES[2]}" left="6.0" top="10.0" width="12.0" height="8.0" rle="0, 96" z_order="1.0"/>'
    text = f'<annotations><image id="0" name="a.jpg" width="48.0" height="32.0">{box}</image></annotations>'
    (tmp_path / "cvat.xml").write_text(text)
    found = imported(make_scene(tmp_path), tmp_path / "cvat.xml")
    assert (found[10:18, 6:18] == 2).all() and (found == 2).sum() == 96


@pytest.mark.parametrize(
    ("mapping", "label", "expected"),
    [
        ({"wall": NAMES[1]}, "Wall", 1),
        ({"Wall ": NAMES[1].upper()}, "wall", 1),
        ({"wall": 1.0}, "wall", 1),
        ({"wall": "1"}, "wall", 1),
        ({NAMES[2]: NAMES[1]}, NAMES[2].upper(), 1),
        ({NAMES[2].upper(): NAMES[1]}, NAMES[2], 2),  # as ever: the table has this very name
    ],
)
def test_mappings_in_other_letter_case(tmp_path, mapping, label, expected):
    (tmp_path / "a.json").write_text(json.dumps({"shapes": [square(label)]}))
    (tmp_path / "map.json").write_text(json.dumps(mapping))
    found = imported(make_scene(tmp_path), tmp_path / "a.json", mapping=tmp_path / "map.json")
    assert (found[10:18, 6:18] == expected).all()


def test_class_tables_with_floats():
    entry = TABLE[0] | {"id": 1.0, "color": [1.0, 2.0, 3.0], "asprs": 6.0}
    (found,) = parse_classes([entry], "classes.json")
    assert (found.id, found.color, found.asprs) == (1, (1, 2, 3), 6)
    with pytest.raises(InputError, match="whole number"):
        parse_classes([entry | {"id": 1.5}], "classes.json")


def test_prompts_name_classes_in_any_letter_case():
    table = replace_prompts(parse_classes(TABLE, "classes"), (f"{NAMES[2].upper()}=street,lane",))
    assert next(entry.prompts for entry in table if entry.id == 2) == ("street", "lane")


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda one: [one, one | {"file_name": "b.jpg"}], r"gives the id 1 to two images, a\.jpg and b\.jpg"),
        (
            lambda one: [one, one | {"id": 2}],
            r"lists the image a\.jpg twice, as id 1 and 2, both with annotations",
        ),
        (lambda one: [one | {"id": 9}], "annotations of an image that it does not list, id 1: add it"),
    ],
)
def test_images_listed_twice_in_coco(tmp_path, change, told):
    content = json.loads(coco(1))
    content["annotations"].append(content["annotations"][0] | {"image_id": 2})
    content["images"] = change(content["images"][0])
    if len(content["images"]) < 2 or content["images"][1]["id"] == 1:
        content["annotations"].pop()
    (tmp_path / "coco.json").write_text(json.dumps(content))
    with pytest.raises(InputError, match=told):
        imported(make_scene(tmp_path), tmp_path / "coco.json")


def test_equal_entries_of_an_image_in_coco_are_one(tmp_path):
    content = json.loads(coco(1))
    content["images"] *= 2
    (tmp_path / "coco.json").write_text(json.dumps(content))
    np.testing.assert_array_equal(imported(make_scene(tmp_path), tmp_path / "coco.json"), bands())


def test_categories_of_one_id_in_coco_are_refused(tmp_path):
    content = json.loads(coco(1))
    content["categories"][1]["id"] = content["categories"][0]["id"]
    (tmp_path / "coco.json").write_text(json.dumps(content))
    with pytest.raises(InputError, match=f"two categories, {NAMES[1]} and {NAMES[2]}"):
        imported(make_scene(tmp_path), tmp_path / "coco.json")
