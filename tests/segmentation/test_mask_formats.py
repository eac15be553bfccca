"""Masks made elsewhere: files of each format's own library, brute-force twins, one-line errors, hostile
files, the whole stage.

tests/mask_files holds what LabelMe, Datumaro, CVAT's SDK and pycocotools wrote, and what they draw from it
(make.py there).
"""

from __future__ import annotations

import base64
import io
import json
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from sc3d.errors import InputError
from sc3d.io.images import write_image
from sc3d.io.mask_images import read_index_image
from sc3d.runner import execute
from sc3d.scene.class_table import parse_classes
from sc3d.scene.scene import Scene
from sc3d.segmentation.mask_formats import outlines
from sc3d.segmentation.mask_formats.annotations import paint
from sc3d.segmentation.mask_formats.coco import decompress
from sc3d.segmentation.mask_formats.import_masks import import_masks
from sc3d.segmentation.mask_formats.outlines import (
    OutlineError,
    ellipse,
    polygons,
    rasterize,
    rectangle,
    row_lengths,
    run_lengths,
)
from sc3d.segmentation.mask_formats.source import MaskFiles, detect
from sc3d.settings.labels import Segment

FILES = Path(__file__).parent / "mask_files"
SIZE = (96, 72)
PHOTOS = {"DJI_0001.JPG": SIZE, "more/DJI_0002.JPG": SIZE}
TABLE = parse_classes(
    [
        {"id": 1, "name": "building", "color": [214, 60, 60]},
        {"id": 2, "name": "road", "color": [90, 90, 90]},
        {"id": 3, "name": "tree", "color": [0, 120, 0]},
    ],
    "test",
)


def _import(
    tmp_path: Path, path: Path, format: str = "auto", mapping: object = None, photos: dict = PHOTOS
) -> dict[str, np.ndarray]:
    """Masks in the scene by photo stem."""
    file = None
    if mapping is not None:
        file = tmp_path / "mapping.json"
        file.write_text(json.dumps(mapping))
    import_masks(MaskFiles(path, format, file), tmp_path / "scene" / "masks", photos, TABLE)
    return {file.stem: read_index_image(file) for file in (tmp_path / "scene" / "masks").iterdir()}


def _refused(tmp_path: Path, path: Path, *parts: str, **options: object) -> str:
    with pytest.raises(InputError) as raised:
        _import(tmp_path, path, **options)
    message = str(raised.value)
    assert "\n" not in message and not (tmp_path / "scene").exists()
    for part in parts:
        assert part in message, message
    return message


def _near_edges(labels: np.ndarray) -> np.ndarray:
    """Pixels with another label among their eight neighbors."""
    padded = np.pad(labels, 1, mode="edge")
    height, width = labels.shape
    return np.any(
        [
            padded[1 + row : 1 + row + height, 1 + column : 1 + column + width] != labels
            for row in (-1, 0, 1)
            for column in (-1, 0, 1)
        ],
        axis=0,
    )


# ---- files of the formats' own libraries


@pytest.mark.parametrize(
    ("source", "format", "exact"),
    [
        ("labelme", "labelme", 0.97),
        ("coco.json", "coco", 0.995),
        ("coco_compressed.json", "coco", 1),
        ("cvat.xml", "cvat", 0.98),
    ],
)
def test_files_of_reference_libraries(tmp_path, source, format, exact):
    """The same labels as the library draws, but for pixels on outlines, where libraries differ; run-length
    codes to the pixel.
    """
    masks = _import(tmp_path, FILES / source)
    assert detect(FILES / source) == format and masks.keys() == {"DJI_0001", "DJI_0002"}
    for name, labels in masks.items():
        expected = read_index_image(FILES / "expected" / format / f"{name}.png")
        assert labels.shape == expected.shape == (72, 96) and set(np.unique(labels)) >= {0, 1, 3}
        assert ((labels == expected) | _near_edges(expected) | _near_edges(labels)).all()
        assert (labels == expected).mean() >= exact


def test_formats_can_be_named_and_files_lie_in_folders(tmp_path):
    expected = _import(tmp_path, FILES / "cvat.xml", "cvat")
    folder = tmp_path / "export" / "job"
    folder.mkdir(parents=True)
    (folder / "annotations.xml").write_bytes((FILES / "cvat.xml").read_bytes())
    write_image(tmp_path / "export" / "DJI_0001.png", np.zeros((72, 96, 3), np.uint8))  # a photo beside them
    np.testing.assert_equal(_import(tmp_path, tmp_path / "export"), expected)
    with pytest.raises(InputError, match="expected for --format coco"):
        _import(tmp_path, FILES / "cvat.xml", "coco")
    with pytest.raises(InputError, match="not a COCO file"):
        _import(tmp_path, FILES / "labelme", "coco")
    with pytest.raises(InputError, match="not a LabelMe file"):
        _import(tmp_path, FILES / "coco.json", "labelme")


def test_pycocotools_agrees():
    coco_masks = pytest.importorskip("pycocotools.mask")
    random = np.random.default_rng(0)
    for density in (0, 0.001, 0.02, 0.5, 0.98, 1):
        for width, height in ((1, 1), (7, 3), (60, 41), (300, 200)):
            mask = random.random((height, width)) < density
            code = coco_masks.encode(np.asfortranarray(mask.astype(np.uint8)))
            counts = decompress(code["counts"].decode())
            np.testing.assert_array_equal(
                _image(run_lengths(counts, (0, 0, width, height), True, (width, height)), (width, height)),
                mask,
            )
    for _ in range(50):  # polygons: the same up to the pixels on the outline
        ring = random.uniform(-5, 80, (int(random.integers(3, 8)), 2))
        ring[0] = random.uniform(5, 55, 2)
        expected = coco_masks.decode(coco_masks.frPyObjects([ring.ravel().tolist()], 60, 70))[..., 0].astype(
            bool
        )
        drawn = _image(polygons([ring], (70, 60)), (70, 60))
        assert ((drawn == expected) | _near_edges(expected) | _near_edges(drawn)).all()


# ---- outlines


def _image(outline, size: tuple[int, int]) -> np.ndarray:
    """(H, W) bool."""
    return paint([(1, outline)], size, False).astype(bool)


def _fill_slowly(ring: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Even-odd rule, pixel by pixel: edges that a ray from the center to the left crosses."""
    mask = np.zeros((size[1], size[0]), bool)
    for row, column in np.ndindex(*mask.shape):
        x, y, crossings = column + 0.5, row + 0.5, 0
        for (x0, y0), (x1, y1) in zip(ring, np.roll(ring, -1, axis=0), strict=True):
            if (y0 <= y) != (y1 <= y):
                low, high = ((x0, y0), (x1, y1)) if y0 < y1 else ((x1, y1), (x0, y0))
                crossings += low[0] + (y - low[1]) * ((high[0] - low[0]) / (high[1] - low[1])) <= x
        mask[row, column] = crossings % 2
    return mask


def test_polygons_equal_brute_force(monkeypatch):
    monkeypatch.setattr(outlines, "CROSSINGS_AT_ONCE", 7)
    random, size = np.random.default_rng(1), (13, 9)
    for index in range(60):
        ring = random.uniform(-6, 17, (int(random.integers(3, 9)), 2))
        # corners on pixels' corners and centers
        ring = ring.round() if index % 3 == 1 else ring.round() + 0.5 if index % 3 == 2 else ring
        try:
            outline = polygons([ring], size)
        except OutlineError:
            continue
        np.testing.assert_array_equal(_image(outline, size), _fill_slowly(ring, size))


def test_polygons_that_share_edges_cover_every_pixel_once():
    from scipy.spatial import Delaunay

    random, size = np.random.default_rng(2), (40, 30)
    corners = np.array([[0, 0], [40, 0], [0, 30], [40, 30]])
    for points in (random.uniform(0, 1, (60, 2)) * size, (random.uniform(0, 1, (60, 2)) * 29).round() + 0.5):
        points = np.concatenate([corners, points])
        triangles = Delaunay(points).simplices
        count = sum(
            _image(polygons([points[triangle][:: 1 - 2 * (index % 2)]], size), size).astype(int)
            for index, triangle in enumerate(triangles)
        )
        assert (count == 1).all()


def test_rings_of_one_region_are_united():
    size = (20, 10)
    square = [[2, 2], [10, 2], [10, 8], [2, 8]]
    assert _image(polygons([square, square], size), size).sum() == 48
    assert (
        _image(polygons([np.ravel(square), [8, 0, 15, 0, 15, 10, 8, 10]], size), size).sum() == 48 + 70 - 12
    )


def test_turned_rectangles_and_ellipses_are_analytic():
    size = (80, 60)
    x, y = np.meshgrid(np.arange(80) + 0.5, np.arange(60) + 0.5)
    for degrees in (0.0, 25.0, 90.0, 330.0):
        # The same vector as seen by the shape: turned back, with y down, so that positive degrees are
        # clockwise as seen
        cos, sin = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
        u, v = cos * (x - 41.3) + sin * (y - 28.7), -sin * (x - 41.3) + cos * (y - 28.7)
        box = _image(rectangle([21.3, 20.7], [61.3, 36.7], degrees, size), size)
        assert (box == (np.abs(u) <= 20) & (np.abs(v) <= 8)).mean() > 0.9999
        distance = np.hypot(u / 26, v / 11)
        oval = _image(ellipse([41.3, 28.7], [26, 11], degrees, size), size)
        assert (oval == (distance <= 1))[np.abs(distance - 1) > 0.003].all()


def test_runs_in_boxes_by_row_and_by_column():
    random = np.random.default_rng(3)
    for _ in range(30):
        box = (
            int(random.integers(0, 9)),
            int(random.integers(0, 9)),
            int(random.integers(1, 12)),
            int(random.integers(1, 12)),
        )
        mask = random.random((box[3], box[2])) < random.choice([0, 0.1, 0.9, 1])
        expected = np.zeros((21, 22), bool)
        expected[box[1] : box[1] + box[3], box[0] : box[0] + box[2]] = mask
        for counts, by_column in (
            (row_lengths(mask), False),
            (row_lengths(mask.T), True),
            ([0, 0, *row_lengths(mask)], False),
        ):
            np.testing.assert_array_equal(
                _image(run_lengths(counts, box, by_column, (22, 21)), (22, 21)), expected
            )
    patch = rasterize(
        run_lengths(row_lengths(np.eye(1000, dtype=bool)[:, 300:310]), (5, 0, 10, 1000), False, (1000, 1000)),
        (1000, 1000),
    )
    assert patch.mask.shape == (10, 10) and patch.top == 300  # only the lines that hold pixels


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    ("counts", "box"),
    [
        ([1, 2, 3], (0, 0, 3, 3)),
        ([-1, 10], (0, 0, 3, 3)),
        ([1.5, 7.5], (0, 0, 3, 3)),
        ([10**15, 9], (0, 0, 3, 3)),
        ([1e308] * 3, (0, 0, 3, 3)),
        ([10**400], (0, 0, 3, 3)),
        (["a"], (0, 0, 3, 3)),
        ([], (0, 0, 3, 3)),
        ([9], (8, 8, 3, 3)),
        ([9], (-1, 0, 3, 3)),
        ([0], (0, 0, 0, 3)),
        ([float("nan"), 9], (0, 0, 3, 3)),
        ([[9], [0, 0]], (0, 0, 3, 3)),
    ],
)
def test_runs_that_do_not_fit_are_refused(counts, box):
    with pytest.raises(OutlineError):
        run_lengths(counts, box, True, (10, 10))


@pytest.mark.parametrize("text", ["", "0o", "P", "\x00", "zzzzzzzz1", "é", "oooooooooooooooooooooo0"])
def test_damaged_compressed_codes_are_refused(text):
    with pytest.raises(OutlineError):
        run_lengths(decompress(text), (0, 0, 10, 10), True, (10, 10))


# ---- overlaps


def _coco(
    *annotations: tuple, categories: tuple[str, ...] = ("building", "road", "tree"), **image: object
) -> dict:
    """A COCO file of one photo; annotations: (category name, segmentation)."""
    return {
        "images": [{"id": 5, "file_name": "a\\b\\DJI_0001.JPG", "width": 96, "height": 72} | image],
        "categories": [{"id": 10 + index, "name": name} for index, name in enumerate(categories)],
        "annotations": [
            {
                "id": index,
                "image_id": 5,
                "category_id": 10 + categories.index(name),
                "segmentation": segmentation,
                "iscrowd": 0,
            }
            for index, (name, segmentation) in enumerate(annotations)
        ],
    }


def _write(path: Path, content: object) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def _square(left: float, top: float, side: float) -> list[list[float]]:
    return [[left, top, left + side, top, left + side, top + side, left, top + side]]


def test_coco_smaller_regions_win_in_any_order(tmp_path):
    annotations = [
        ("road", _square(10, 10, 40)),
        ("building", _square(20, 20, 10)),
        ("tree", _square(25, 25, 40)),
        ("road", _square(25, 25, 10)),
    ]
    random = np.random.default_rng(0)
    for _ in range(4):
        order = [annotations[index] for index in random.permutation(4)]
        labels = _import(tmp_path, _write(tmp_path / "coco.json", _coco(*order)))["DJI_0001"]
        assert (labels[20:30, 20:30] == 1).all()  # equal to the small road: the lower class id
        assert (labels[30:35, 30:35] == 2).all() and (labels[25:30, 30:35] == 2).all()
        assert labels[40, 40] == 2 and labels[60, 60] == 3 and labels[15, 15] == 2 and labels[0, 0] == 0


def _labelme(*shapes: dict, **fields: object) -> dict:
    return {
        "version": "5.5.0",
        "shapes": list(shapes),
        "imagePath": "DJI_0001.JPG",
        "imageWidth": 96,
        "imageHeight": 72,
        "imageData": None,
    } | fields


def _polygon(label: str, left: float, top: float, side: float, **fields: object) -> dict:
    return {
        "label": label,
        "points": np.reshape(_square(left, top, side), (4, 2)).tolist(),
        "shape_type": "polygon",
    } | fields


def test_labelme_later_shapes_win(tmp_path):
    small, large = _polygon("building", 20, 20, 10), _polygon("road", 10, 10, 40)
    for shapes, expected in (((small, large), 2), ((large, small), 1)):
        labels = _import(tmp_path, _write(tmp_path / "l" / "x.json", _labelme(*shapes)))["DJI_0001"]
        assert (labels[20:30, 20:30] == expected).all() and (labels == 0).sum() == 72 * 96 - 1600


def _cvat(*shapes: str, image: str = 'name="DJI_0001.JPG" width="96" height="72"') -> str:
    return f'<?xml version="1.0"?>\n<annotations><version>1.1</version><image id="0" {image}>{"".join(shapes)}</image></annotations>'


def _box(label: str, left: float, top: float, side: float, z_order: int = 0) -> str:
    return f'<box label="{label}" xtl="{left}" ytl="{top}" xbr="{left + side}" ybr="{top + side}" z_order="{z_order}"></box>'


def test_cvat_z_order_wins_then_the_later(tmp_path):
    for orders, expected in (((1, 0), 1), ((0, 0), 2), ((0, 1), 2)):
        shapes = [_box("building", 20, 20, 10, orders[0]), _box("road", 10, 10, 40, orders[1])]
        labels = _import(tmp_path, _write(tmp_path / "a.xml", _cvat(*shapes)))["DJI_0001"]
        assert (labels[20:30, 20:30] == expected).all() and (labels[40, 40], labels[5, 5]) == (2, 0)


# ---- names, sizes, mappings


def test_names_and_mapping(tmp_path):
    file = _write(
        tmp_path / "coco.json",
        _coco(
            ("Wall", _square(0, 0, 10)),
            ("ROAD", _square(20, 0, 10)),
            ("sky", _square(40, 0, 10)),
            categories=("Wall", "ROAD", "sky"),
        ),
    )
    _refused(tmp_path, file, "unknown classes: 'Wall', 'sky'; known are building, road, tree", "--mapping")
    for mapping in (
        {"Wall": "building", "sky": None},
        {"10": 1, "12": "ignore"},
        {" Wall": "Building", "sky": 0, "never": "tree"},
    ):
        labels = _import(tmp_path, file, mapping=mapping)["DJI_0001"]
        assert (labels[5, 5], labels[5, 25], labels[5, 45]) == (1, 2, 0)


def test_unlabelled_regions_hide_what_lies_below(tmp_path):
    file = _write(
        tmp_path / "x" / "DJI_0001.json", _labelme(_polygon("tree", 0, 0, 40), _polygon("hole", 10, 10, 10))
    )
    assert (_import(tmp_path, file, mapping={"hole": None})["DJI_0001"] == 3).sum() == 1600 - 100


@pytest.mark.parametrize("mapping", [{"a": "hous"}, {"a": 9}, {"a": [1]}, {"a": True}, {}, [], "text"])
def test_mappings_are_checked(tmp_path, mapping):
    _refused(tmp_path, FILES / "coco.json", "mapping.json", mapping=mapping)


def test_annotations_of_another_resolution_keep_it(tmp_path):
    for scale in (0.5, 1, 3):
        size = {"imageWidth": int(96 * scale), "imageHeight": int(72 * scale)}
        labels = _import(
            tmp_path, _write(tmp_path / "l" / "a.json", _labelme(_polygon("tree", 0, 0, 20 * scale), **size))
        )["DJI_0001"]
        assert labels.shape == (72 * scale, 96 * scale) and (labels == 3).sum() == 400 * scale**2
    labels = _import(
        tmp_path, _write(tmp_path / "l" / "a.json", _labelme(_polygon("tree", 0, 0, 20), imageWidth=None))
    )["DJI_0001"]
    assert labels.shape == (72, 96)


def test_labelme_finds_the_photo_by_either_name(tmp_path):
    shape = _polygon("tree", 0, 0, 20)
    for file, path in (
        ("DJI_0001", "C:\\flight\\renamed.JPG"),
        ("anything", "../DJI_0001.JPG"),
        ("DJI_0001", None),
        ("DJI_0001", "DJI_0001.tif"),
    ):
        source = _write(tmp_path / file / f"{file}.json", _labelme(shape, imagePath=path))
        assert _import(tmp_path, source.parent).keys() == {"DJI_0001"}
    (tmp_path / "scene" / "masks" / "DJI_0001.png").unlink()
    (tmp_path / "scene" / "masks").rmdir()
    (tmp_path / "scene").rmdir()
    _refused(
        tmp_path,
        _write(tmp_path / "b" / "DJI_0002.json", _labelme(shape)),
        "says that it belongs to another: DJI_0001.JPG or more/DJI_0002.JPG",
    )


def test_annotations_without_area_are_skipped_and_told(tmp_path, caplog):
    line, point = (
        {"label": "nonsense", "points": [[1, 1], [5, 5]], "shape_type": kind}
        for kind in ("linestrip", "point")
    )
    file = _write(tmp_path / "l" / "a.json", _labelme(line, _polygon("tree", 0, 0, 9), point, line))
    assert (_import(tmp_path, file)["DJI_0001"] == 3).sum() == 81
    assert "skipped: linestrip (2), point (1)" in caplog.text


# ---- PNGs


def test_colors(tmp_path):
    labels = np.random.default_rng(0).integers(0, 4, (72, 96)).astype(np.uint8)
    palette = TABLE.palette
    for black in (0, 60):
        palette[0] = black
        picture = palette[labels]
        write_image(tmp_path / "rgb" / "DJI_0001.png", picture)
        np.testing.assert_array_equal(_import(tmp_path, tmp_path / "rgb")["DJI_0001"], labels)
    (tmp_path / "other").mkdir()
    alpha = np.where(labels == 3, 0, 255).astype(np.uint8)
    Image.fromarray(np.dstack([picture, alpha])).save(tmp_path / "other" / "DJI_0001.png")
    # transparent: unlabelled
    np.testing.assert_array_equal(
        _import(tmp_path, tmp_path / "other")["DJI_0001"], np.where(labels == 3, 0, labels)
    )
    indexed = Image.fromarray(labels * 7)  # a palette whose colors, not ids, are those of the table
    indexed.putpalette(np.repeat(palette[:4], 7, axis=0).ravel().tolist())
    indexed.save(tmp_path / "other" / "DJI_0001.png")
    np.testing.assert_array_equal(_import(tmp_path, tmp_path / "other", "color")["DJI_0001"], labels)
    mapping = {"#d63c3c": "tree", "[90, 90, 90]": "building", "0,120,0": None, "#3c3c3c": "road"}
    expected = np.array([2, 3, 1, 0])[labels]
    np.testing.assert_array_equal(_import(tmp_path, tmp_path / "rgb", mapping=mapping)["DJI_0001"], expected)


def test_colors_are_not_guessed(tmp_path):
    picture = np.zeros((72, 96, 3), np.uint8)
    picture[10:20, 10:20] = (214, 60, 60)
    picture[12, 30:33] = (213, 60, 61)
    picture[11, 50] = (1, 2, 3)
    write_image(tmp_path / "rgb" / "DJI_0001.png", picture)
    write_image(tmp_path / "rgb" / "DJI_0002.png", picture)
    _refused(tmp_path, tmp_path / "rgb", "#010203", "4 px", "column 50, row 11", "(2 times)", "not guessed")
    for mapping in (
        {"red": "tree"},
        {"#12345": "tree"},
        {"[1,2,300]": "tree"},
        {"#010203": "tree", "1,2,3": "road"},
    ):
        _refused(tmp_path, tmp_path / "rgb", "color", mapping=mapping)


def test_ids_of_other_tables(tmp_path):
    ids = np.random.default_rng(0).choice([0, 7, 24, 300, 65535], (72, 96)).astype(np.uint16)
    (tmp_path / "ade").mkdir()
    Image.fromarray(ids).save(tmp_path / "ade" / "DJI_0001.png")
    _refused(tmp_path, tmp_path / "ade", "16-bit", "--mapping")
    mapping = {"7": "road", "24": "tree", "300": "building", "65535": None}
    expected = np.zeros_like(ids)
    for value, class_id in ((7, 2), (24, 3), (300, 1)):
        expected[ids == value] = class_id
    np.testing.assert_array_equal(_import(tmp_path, tmp_path / "ade", mapping=mapping)["DJI_0001"], expected)


def test_a_mapping_replaces_the_numbering(tmp_path):
    write_image(tmp_path / "ids" / "DJI_0001.png", np.full((72, 96), 2, np.uint8))
    _refused(tmp_path, tmp_path / "ids", "class id 2, which is not in", "mapping.json", mapping={"1": "road"})
    _refused(tmp_path, tmp_path / "ids", "'road' is no id", mapping={"road": "road"})
    assert (_import(tmp_path, tmp_path / "ids", mapping={"2": "tree"})["DJI_0001"] == 3).all()


def test_masks_in_place_are_not_converted(tmp_path):
    masks = tmp_path / "masks"
    write_image(masks / "DJI_0001.png", np.ones((72, 96), np.uint8))
    before = (masks / "DJI_0001.png").read_bytes()
    assert import_masks(MaskFiles(masks), masks, PHOTOS, TABLE) == ["DJI_0001.JPG"]
    with pytest.raises(InputError, match="own folder"):
        import_masks(
            MaskFiles(masks, "index", _write(tmp_path / "m.json", {"1": "tree"})), masks, PHOTOS, TABLE
        )
    assert (masks / "DJI_0001.png").read_bytes() == before
    write_image(masks / "DJI_0001.png", np.zeros((72, 96, 3), np.uint8))
    with pytest.raises(InputError, match="has colors"):
        import_masks(MaskFiles(masks), masks, PHOTOS, TABLE)


# ---- errors: one line for all, before anything is written


def test_all_mismatches_come_in_one_line(tmp_path):
    folder = tmp_path / "l"
    good = _polygon("tree", 0, 0, 20)
    bad = [
        _polygon("wall", 0, 0, 5),
        _polygon("sky", 0, 0, 5),
        _polygon("tree", 200, 0, 20),
        _polygon("road", 0, 300, 20),
    ]
    _write(folder / "DJI_0001.json", _labelme(good, *bad))
    _write(folder / "DJI_0002.json", _labelme(good, imagePath="DJI_0002.JPG", imageWidth=72, imageHeight=96))
    for name in ("DJI_0003", "DJI_0004", "DJI_0005"):
        _write(folder / f"{name}.json", _labelme(good, imagePath=f"{name}.JPG"))
    _write(folder / "empty.json", "")
    _write(folder / "other.json", {"version": 3})
    message = _refused(
        tmp_path,
        folder,
        "unknown classes: 'wall', 'sky'; known are building, road, tree",
        "DJI_0002.json is 72x96, but its photo is 96x72",
        "belongs to no photo: 2 photos are known, such as DJI_0001.JPG (3 times)",
        "lies outside of the image (2 times)",
        "empty.json is not valid JSON",
        "(2 times)",
    )
    assert len(message) < 1500


@pytest.mark.parametrize(
    ("content", "part"),
    [
        (_coco(("tree", _square(0, 0, 9)), file_name="else.jpg"), "else.jpg in "),
        (_coco(("tree", _square(0, 0, 9)), width=72, height=96), "72x96, but its photo is 96x72"),
        (_coco(("tree", _square(0, 0, 9)), width=10**9, height=75 * 10**7), "refused"),
        (_coco(("tree", _square(0, 0, 9)), width="wide"), "has a size that is none"),
        (_coco(("tree", _square(0, 0, 9)), width=float("inf")), "has a size that is none"),
        (_coco(("tree", _square(100, 0, 9))), "lies outside of the image"),
        (_coco(("tree", _square(-20, 0, 9))), "lies outside of the image"),
        (_coco(("tree", _square(0, -20, 9))), "lies outside of the image"),
        (_coco(("tree", _square(0, 80, 9))), "lies outside of the image"),
        (_coco(("tree", _square(-90, -90, 250))), "lies outside of the image"),
        (_coco(("tree", _square(-1e300, 0, 1e301))), "lies outside of the image"),
        (_coco(("tree", [[1, 2, 3, 4]])), "fewer than three points"),
        (_coco(("tree", [[1, 2, 3, 4, 5, 6, 7]])), "fewer than three points"),
        (_coco(("tree", [1, 2, 3, 4, 5, 6])), "is no list of polygons"),
        (_coco(("tree", [[1, 2, "x", 4, 5, 6]])), "not numbers"),
        (_coco(("tree", [[1, 2, 10**400, 4, 5, 6]])), "not numbers"),
        (_coco(("tree", [[1, 2, float("nan"), 4, 5, 6]])), "not finite"),
        (_coco(("tree", {"size": [72, 96], "counts": [10, 10**15]})), "does not add up"),
        (_coco(("tree", {"size": [96, 72], "counts": [6912]})), "of another size"),
        (_coco(("tree", {"size": [72, 96]})), "not complete"),
        (_coco(("tree", {"size": [72, 96], "counts": "not a code"})), "damaged"),
        (_coco(), "no annotation with an area"),
        (_coco(("tree", [])), "no annotation with an area"),
        (_coco(("tree", _square(0, 0, 9))) | {"images": []}, "of an image that it does not list"),
        (_coco(("tree", _square(0, 0, 9))) | {"images": [{"id": []}]}, "lacks its id"),
        (_coco(("tree", _square(0, 0, 9))) | {"categories": 3}, "not a COCO file"),
        ([{"annotations": 1, "categories": 2}], "not a COCO file"),
        ("[" * 100000 + '"annotations" "categories"', "not valid JSON"),
    ],
)
def test_coco_errors(tmp_path, content, part):
    _refused(tmp_path, _write(tmp_path / "coco.json", content), part)


def _png(mask: np.ndarray) -> str:
    buffer = io.BytesIO()
    Image.fromarray(mask.astype(np.uint8)).save(buffer, "PNG")
    return base64.b64encode(buffer.getvalue()).decode()


@pytest.mark.parametrize(
    ("shape", "part"),
    [
        ({"label": "tree", "shape_type": "polygon"}, "not complete"),
        ({"label": "tree", "shape_type": "blob", "points": [[1, 2]]}, "type that is not known"),
        ({"label": "tree", "shape_type": "circle", "points": [[1, 2], [1, 2]]}, "radii do not fit"),
        ({"label": "tree", "shape_type": "circle", "points": [[1, 2], [1, 1e9]]}, "radii do not fit"),
        ({"label": "tree", "shape_type": "circle", "points": [[1, 2]]}, "not complete"),
        ({"label": "tree", "shape_type": "mask", "points": [[1, 2], [5, 6]], "mask": None}, "not complete"),
        ({"label": "tree", "shape_type": "mask", "points": [[1, 2], [5, 6]], "mask": "!"}, "damaged picture"),
        (
            {
                "label": "tree",
                "shape_type": "mask",
                "points": [[1, 2], [5, 6]],
                "mask": _png(np.ones((5, 5)))[:60],
            },
            "damaged picture",
        ),
        (
            {
                "label": "tree",
                "shape_type": "mask",
                "points": [[1, 2], [5, 6]],
                "mask": _png(np.ones((2000, 2000))),
            },
            "another size",
        ),
        (
            {
                "label": "tree",
                "shape_type": "mask",
                "points": [[1, 2], [1e300, 6]],
                "mask": _png(np.ones((5, 5))),
            },
            "lies outside",
        ),
        (
            {
                "label": "tree",
                "shape_type": "mask",
                "points": [[91, 2], [96, 6]],
                "mask": _png(np.ones((5, 6))),
            },
            "lies outside",
        ),
        ({"shape_type": "polygon", "points": [[1, 2], [5, 6], [7, 7]]}, "unknown classes: ''"),
    ],
)
def test_labelme_errors(tmp_path, shape, part):
    _refused(tmp_path, _write(tmp_path / "DJI_0001.json", _labelme(shape)), part)


@pytest.mark.parametrize(
    ("content", "part"),
    [
        (_cvat(_box("wall", 0, 0, 9)), "unknown classes: 'wall'"),
        (_cvat(_box("tree", 0, 0, 9), image='name="other.jpg"'), "other.jpg in "),
        (_cvat(_box("tree", 0, 0, 9), image=""), "belongs to no photo"),
        (
            _cvat(_box("tree", 0, 0, 9), image='name="DJI_0001.JPG" width="97" height="80"'),
            "97x80, but its photo is 96x72",
        ),
        (_cvat(_box("tree", 300, 0, 9)), "lies outside"),
        (_cvat('<box label="tree" xtl="1"></box>'), "not complete"),
        (_cvat('<box label="tree" xtl="1" ytl="x" xbr="3" ybr="3"></box>'), "not numbers"),
        (_cvat('<box label="tree" xtl="1" ytl="2" xbr="3" ybr="3" rotation="nan"></box>'), "not finite"),
        (_cvat('<polygon label="tree" points="1,2;3;4,5"></polygon>'), "fewer than three"),
        (_cvat('<ellipse label="tree" cx="9" cy="9" rx="-3" ry="4"></ellipse>'), "radii"),
        (
            _cvat('<mask label="tree" rle="3, 99999999999999" left="0" top="0" width="4" height="4"></mask>'),
            "does not add up",
        ),
        (
            _cvat(f'<mask label="tree" rle="16" left="0" top="0" width="{"9" * 5000}" height="4"></mask>'),
            "not complete",
        ),
        (_cvat('<mask label="tree" rle="16" left="95" top="0" width="4" height="4"></mask>'), "lies outside"),
        (_cvat('<tag label="tree"></tag>'), "no annotation with an area"),
        (_cvat(_box("tree", 0, 0, 9).replace('z_order="0"', 'z_order="top"')), "z_order"),
        (_cvat(_box("tree", 0, 0, 9))[:-20], "not valid XML"),
        ('<?xml version="1.0" encoding="klingon"?><annotations/>', "not valid XML"),
        ("<annotations><track id='0' label='tree'></track></annotations>", "CVAT for images 1.1"),
        ("<html></html>", "<annotations> is expected"),
        ("", "not valid XML"),
        (
            '<!DOCTYPE a [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;">]><annotations>&b;</annotations>',
            "document type declaration",
        ),
        (
            '<!DOCTYPE a [<!ENTITY a SYSTEM "file:///etc/passwd">]><annotations>&a;</annotations>',
            "document type declaration",
        ),
    ],
)
def test_cvat_errors(tmp_path, content, part):
    _refused(tmp_path, _write(tmp_path / "a.xml", content), part)


def test_png_errors(tmp_path):
    folder = tmp_path / "ids"
    write_image(folder / "DJI_0001.png", np.full((72, 96), 9, np.uint8))
    write_image(folder / "DJI_0002.png", np.zeros((72, 72), np.uint8))
    write_image(folder / "DJI_0003.png", np.zeros((72, 96), np.uint8))
    _refused(
        tmp_path,
        folder,
        "class id 9",
        "6912 px",
        "72x72, but its photo is 96x72",
        "DJI_0003.png belongs to no photo",
    )
    (folder / "DJI_0004.png").write_bytes(b"")
    _refused(tmp_path, folder, "class id 9", "DJI_0003.png belongs to no photo", "(2 times)")
    write_image(tmp_path / "rgb" / "DJI_0001.png", np.zeros((72, 96, 3), np.uint8))
    (tmp_path / "rgb" / "DJI_0002.png").write_bytes((folder / "DJI_0001.png").read_bytes()[:20])
    _refused(tmp_path, tmp_path / "rgb", "cannot read the image", "DJI_0002.png")
    _refused(tmp_path, folder / "DJI_0001.png", "no masks in")
    _refused(tmp_path, folder / "DJI_0001.png", "a folder of .png files", format="index")
    _refused(tmp_path, _write(tmp_path / "masks.zip", "PK"), "unpack the archive")
    _refused(tmp_path, _write(tmp_path / "empty" / "readme.txt", "").parent, "no masks in")
    _refused(tmp_path, tmp_path / "nowhere", "no masks in")


def test_messages_are_short_and_printable(tmp_path):
    names = ["a\nb\x1b[31m\ud800", "x" * 100_000]
    squares = [(name, _square(0, 0, 9)) for name in names]
    message = _refused(
        tmp_path,
        _write(
            tmp_path / "coco.json", _coco(*squares, categories=tuple(names), file_name="\n" + "y" * 10_000)
        ),
        "belongs to no photo",
    )
    assert message.isprintable() and len(message) < 1500 and message.encode()


def test_one_photo_in_two_files(tmp_path):
    for name in ("a", "b"):
        _write(tmp_path / "l" / f"{name}.json", _labelme(_polygon("tree", 0, 0, 9)))
    _refused(tmp_path, tmp_path / "l", "DJI_0001.JPG has a mask in", "a.json and another in", "b.json")


def test_hostile_files_need_no_memory(tmp_path):
    """Sizes and sums are checked before anything of that size exists; zigzags that cross each row a thousand
    times are refused.
    """
    files = [
        _coco(("tree", {"size": [72, 96], "counts": [0, 10**13]})),
        _coco(("tree", {"size": [10**6, 10**6], "counts": [10**12]}), width=10**6, height=10**6),
        _coco(("tree", [[0, 0, 9, 72] * 2_000])),
        _coco(("tree", {"size": [72, 96], "counts": "o" * 1_000_000})),
    ]
    tracemalloc.start()
    for content in files:
        _refused(tmp_path, _write(tmp_path / "coco.json", content), "cannot import")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 120e6


def test_damaged_files_give_our_own_errors(tmp_path):
    """Bytes of the reference files changed, cut and repeated: every time masks, or an InputError of one line."""
    random, outcomes = np.random.default_rng(4), {"fine": 0, "refused": 0}
    for source in (
        FILES / "coco.json",
        FILES / "coco_compressed.json",
        FILES / "cvat.xml",
        FILES / "labelme" / "DJI_0001.json",
    ):
        original = source.read_bytes()
        for _ in range(60):
            content = bytearray(original)
            begin, length = int(random.integers(len(content))), int(random.integers(1, 4))
            content[begin : begin + length] = random.choice(
                np.frombuffer(original, np.uint8), int(random.integers(0, 4))
            ).tobytes()
            file = tmp_path / source.name
            file.write_bytes(content)
            try:
                _import(
                    tmp_path,
                    file,
                    "cvat" if file.suffix == ".xml" else "labelme" if "DJI" in file.name else "coco",
                )
                outcomes["fine"] += 1
            except InputError as error:
                assert "\n" not in str(error)
                outcomes["refused"] += 1
    assert min(outcomes.values()) > 20


# ---- the whole stage


def _scene(tmp_path: Path) -> Scene:
    scene = Scene(tmp_path / "scene")
    for name in PHOTOS:
        write_image((scene.images / name).with_suffix(".jpg"), np.full((72, 96, 3), 99, np.uint8))
    _write(scene.classes, TABLE.as_json())
    return scene


@pytest.mark.parametrize("source", ["labelme", "coco.json", "cvat.xml"])
def test_segment_stage_imports(tmp_path, source):
    scene = _scene(tmp_path)
    assert execute("segment", scene, Segment(masks=FILES / source))["masks"] == 2
    assert sorted(file.name for file in scene.masks.iterdir()) == ["DJI_0001.png", "DJI_0002.png"]
    before = (scene.masks / "DJI_0001.png").stat().st_mtime_ns
    execute("segment", scene, Segment(masks=FILES / source))  # up to date
    assert (scene.masks / "DJI_0001.png").stat().st_mtime_ns == before
    mapping = _write(tmp_path / "mapping.json", {"tree": None})
    execute("segment", scene, Segment(masks=FILES / source, mapping=mapping))
    assert 3 not in read_index_image(scene.masks / "DJI_0001.png")
    _write(mapping, {"tree": "building"})  # its content decides, not its name
    execute("segment", scene, Segment(masks=FILES / source, mapping=mapping))
    assert set(np.unique(read_index_image(scene.masks / "DJI_0001.png"))) == {0, 1, 2}


def test_failed_import_leaves_earlier_masks(tmp_path):
    scene = _scene(tmp_path)
    execute("segment", scene, Segment(masks=FILES / "cvat.xml"))
    before = {file.name: file.read_bytes() for file in scene.masks.iterdir()}
    bad = _write(tmp_path / "coco.json", _coco(("wall", _square(0, 0, 9)), categories=("wall",)))
    with pytest.raises(InputError, match="'wall'"):
        execute("segment", scene, Segment(masks=bad))
    with pytest.raises(InputError, match="--masks, which is missing"):
        execute("segment", scene, Segment(mapping=_write(tmp_path / "m.json", {"1": "tree"})))
    assert before == {file.name: file.read_bytes() for file in scene.masks.iterdir()}
    assert sorted(path.name for path in scene.path.iterdir()) == [
        "classes.json",
        "images",
        "masks",
        "masks.json",
    ]


def test_turned_photos_are_told(tmp_path, caplog):
    scene = _scene(tmp_path)
    picture, exif = Image.new("RGB", SIZE), Image.Exif()
    exif[0x0112] = 3
    picture.save(scene.images / "DJI_0001.jpg", exif=exif)
    caplog.set_level("INFO")
    execute("segment", scene, Segment(masks=FILES / "cvat.xml"))
    assert "1 photos (such as DJI_0001.jpg) are turned by EXIF" in caplog.text
