"""Names of photos as cameras, annotation programs and other systems write them: whatever belongs to a photo is found,
or refused with the names that it may be.
"""

import json
import logging
import unicodedata
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from sc3d.annotate.session import Session
from sc3d.commands.view import _find_photo
from sc3d.errors import InputError
from sc3d.importers.clouds import read_geometry
from sc3d.importers.metashape import read as read_metashape
from sc3d.importers.photos import locate_photos
from sc3d.io.images import write_image
from sc3d.io.json_files import read_json, write_json
from sc3d.io.mask_images import read_index_image
from sc3d.runner import execute
from sc3d.scene.class_table import read_classes
from sc3d.scene.photo_names import NamePattern, PhotoNames
from sc3d.scene.scene import Scene, match_masks
from sc3d.segmentation.mask_formats.import_masks import import_masks
from sc3d.segmentation.mask_formats.source import MaskFiles
from sc3d.segmentation.segment import Folders, Segmentation, segment_photos
from sc3d.segmentation.strokes.files import read_strokes
from sc3d.settings.labels import Evaluate, Label, Propagate, Segment
from sc3d.settings.outputs import Export, Report
from sc3d.settings.reconstruction import Import
from sc3d.view.web.photos import photo_pictures
from tests.builders import CLASSES, truth_mask, views, write_bare_scene, write_model

CARDS = ["100MEDIA/DJI_0001.JPG", "100MEDIA/DJI_0002.JPG", "101MEDIA/DJI_0001.JPG", "101MEDIA/DJI_0002.JPG"]
DOUBLE = ["a.jpg", "a.png", "c.jpg"]


# ---- which photo a name means


@pytest.mark.parametrize(
    ("names", "foreign", "photos"),
    [
        (CARDS, "100MEDIA/DJI_0001", CARDS[:1]),
        (CARDS, "C:\\flight\\101media\\dji_0001.jpg", CARDS[2:3]),
        (CARDS, "DJI_0001", [CARDS[0], CARDS[2]]),
        (CARDS[:2], "DJI_0001.JPG", CARDS[:1]),
        (CARDS[:2], "102MEDIA/DJI_0001.JPG", []),  # a camera counts anew in every folder
        (CARDS[:2], "photos/DJI_0001.JPG", CARDS[:1]),
        (["a/x.jpg", "b/x.JPG"], "b/x.jpg", ["b/x.JPG"]),
        (DOUBLE, "a.png", ["a.png"]),
        (DOUBLE, "a", ["a.jpg", "a.png"]),
        (DOUBLE, "a.jpg.json", ["a.jpg"]),
        (["x.jpg"], "x_lab.png", ["x.jpg"]),  # FloodNet
        (["x.jpg"], "x_color_mask.png", ["x.jpg"]),
        (["x.jpg"], "x.mask.png", ["x.jpg"]),
        (["x.jpg"], "x.jpg.png", ["x.jpg"]),  # COLMAP, OpenSfM
        (["x.jpg"], "x.jpg_mask.png", ["x.jpg"]),
        (["x.jpg"], "mask_x.png", ["x.jpg"]),
        (["x.png"], "x_L.png", ["x.png"]),  # CamVid
        (["x.jpg"], "x_label_ground-truth_semantic.png", ["x.jpg"]),  # Segments.ai
        (["x_leftImg8bit.png"], "x_gtFine_labelIds.png", ["x_leftImg8bit.png"]),  # Cityscapes
        (["x.jpg", "x_lab.jpg"], "x_lab.png", ["x_lab.jpg"]),
        (["DJI_1.JPG"], "images/1a2b3c4d-DJI_1.JPG", ["DJI_1.JPG"]),  # Label Studio
        (["DJI 1 (2).JPG"], "1a2b3c4d-DJI_1_2.JPG", ["DJI 1 (2).JPG"]),
        (["DJI 1.JPG"], "DJI%201.JPG", ["DJI 1.JPG"]),
        (["DJI_1.JPG"], "DJI_1_JPG.rf.0123456789abcdef0123456789abcdef.jpg", ["DJI_1.JPG"]),  # Roboflow
        (["DJI_1.JPG", "DJI_1.png"], "DJI_1_png.rf.Ab12Cd34Ef56.jpg", ["DJI_1.png"]),
        (["x.jpg"], "x-0f8fad5b-d9cb-469f-a165-70867728950e.png", ["x.jpg"]),
        (["x.jpg"], "20240131-x.jpg", []),  # a date is no hash
        (["DJI_1.jpg"], "DJI_1_20240131.jpg", []),
        (["x.jpg"], "x_thermal.png", []),
        ([unicodedata.normalize("NFD", "Überflug.jpg")], "überflug.png", None),
    ],
)
def test_foreign_names(names, foreign, photos):
    assert list(PhotoNames(names).match(foreign)) == (names if photos is None else photos)


def test_files_of_photos_are_named_like_them():
    plain = PhotoNames(["a.jpg", "flight/b.JPG"])
    assert [plain.key(name) for name in plain.names] == ["a", "b"]  # as ever
    folders = PhotoNames([*CARDS[:3], "x.jpg", "x.tif"])
    assert [folders.key(name) for name in folders.names] == [
        "100MEDIA/DJI_0001",
        "100MEDIA/DJI_0002",
        "101MEDIA/DJI_0001",
        "x.jpg",
        "x.tif",
    ]
    tricky = PhotoNames(["a.jpg", "a.png", "a.jpg.tif"])
    assert len({tricky.key(name) for name in tricky.names}) == 3
    assert all(tricky.match_file(f"{tricky.key(name)}.png") == (name,) for name in tricky.names)


@pytest.mark.parametrize(
    ("pattern", "file", "photo"),
    [
        ("{photo}_thermal.png", "x-1_thermal.png", "x-1.jpg"),
        ("{photo}_thermal", "x-1_thermal.png", "x-1.jpg"),
        ("*-{photo}_v?", "q/abc-x-1_v?.png", "x-1.jpg"),
        ("{photo}_json/label.png", "out/x-1_json/label.png", "x-1.jpg"),  # labelme_export_json
        ("{photo}_b.png", "x-1_a.png", None),
    ],
)
def test_name_pattern(pattern, file, photo):
    names = PhotoNames(["x-1.jpg", "y.jpg"], NamePattern(pattern))
    assert names.match_file(file) == ((photo,) if photo else ())


@pytest.mark.parametrize("pattern", ["", "mask.png", "{photo}{photo}"])
def test_name_pattern_needs_the_photo_once(pattern):
    with pytest.raises(InputError, match="--name-pattern"):
        NamePattern(pattern)


# ---- masks and annotations


@pytest.fixture
def table(tmp_path):
    write_json(tmp_path / "classes.json", CLASSES)
    return read_classes(tmp_path / "classes.json")


def mask_of(value: int) -> np.ndarray:
    return np.full((6, 8), value, np.uint8)


def write_masks(folder: Path, **values: int) -> Path:
    for name, value in values.items():
        write_image(folder / f"{name}.png", mask_of(value))
    return folder


def sizes_of(*names: str) -> dict[str, tuple[int, int]]:
    return dict.fromkeys(names, (8, 6))


def values_in(folder: Path) -> dict[str, int]:
    """First value of every mask, by path."""
    return {
        file.relative_to(folder).as_posix(): int(read_index_image(file)[0, 0])
        for file in sorted(folder.rglob("*.png"))
    }


def test_masks_in_folders(tmp_path, table, caplog):
    given = write_masks(tmp_path / "given", **{"100MEDIA/DJI_0001": 1, "101MEDIA/DJI_0001": 3})
    write_image(given / "preview" / "DJI_0001.png", mask_of(9))  # no folder of photos
    with caplog.at_level(logging.WARNING):
        assert import_masks(given, tmp_path / "masks", sizes_of(*CARDS), table) == [CARDS[0], CARDS[2]]
    assert "1 PNG files in folders that are not named like those of the photos" in caplog.text
    assert values_in(tmp_path / "masks") == {"100MEDIA/DJI_0001.png": 1, "101MEDIA/DJI_0001.png": 3}
    flat = write_masks(tmp_path / "flat", DJI_0002=1)
    with pytest.raises(InputError, match=r"may belong to 100MEDIA/DJI_0002.JPG .* or 101MEDIA/DJI_0002.JPG"):
        import_masks(flat, tmp_path / "masks", sizes_of(*CARDS), table)
    one = write_masks(tmp_path / "101MEDIA", DJI_0002=3)  # the name of the folder tells
    assert import_masks(one, tmp_path / "more", sizes_of(*CARDS), table) == [CARDS[3]]


@pytest.mark.parametrize(
    ("first", "second"),
    [
        ("train", "val"),  # YOLO
        ("train2017", "val2017"),  # COCO
        ("Train/masks", "valid/masks"),
        ("", "test"),
        ("masks", "masks"),
        ("labels/train", "labels/test"),
    ],
)
def test_masks_in_the_parts_of_a_data_set(tmp_path, table, first, second):
    photos, given = sizes_of("a.jpg", "b.jpg", "c.jpg"), tmp_path / "given"
    write_image(given / first / "a.png", mask_of(1))
    write_image(given / second / "b.png", mask_of(3))
    for source in (MaskFiles(given), MaskFiles(given, "index")):
        assert import_masks(source, tmp_path / "masks", photos, table) == ["a.jpg", "b.jpg"]
    assert values_in(tmp_path / "masks") == {"a.png": 1, "b.png": 3}
    # truth and confidence
    assert sorted(match_masks(given, photos, table)) == ["a.jpg", "b.jpg"]
    sure = tmp_path / "confidence"
    import_masks(given, tmp_path / "masks", photos, table, given, sure)
    assert values_in(sure) == {"a.png": 1, "b.png": 3}
    if first != second:
        write_image(given / second / "a.png", mask_of(1))
        with pytest.raises(InputError, match=r"a\.jpg has a mask in .*a\.png and another in .*a\.png"):
            import_masks(given, tmp_path / "masks", photos, table)
        with pytest.raises(InputError, match=r"a\.png and .*a\.png both belong to a\.jpg"):
            match_masks(given, photos, table)


def test_masks_of_cards_in_the_parts_of_a_data_set(tmp_path, table):
    given = write_masks(tmp_path / "given", **{"train/100MEDIA/DJI_0001": 1, "val/101MEDIA/DJI_0001": 3})
    assert import_masks(given, tmp_path / "masks", sizes_of(*CARDS), table) == [CARDS[0], CARDS[2]]


def test_strokes_in_the_parts_of_a_data_set(tmp_path, table):
    write_photos(tmp_path / "images", "a.jpg", "b.jpg")
    for folder, name in (("train", "a"), ("val", "b")):
        write_json(tmp_path / "strokes" / folder / f"{name}.json", labelme("road", f"{name}.jpg"))
    found = read_strokes(tmp_path / "strokes", tmp_path / "images", table)
    assert [one.photo.name for one in found] == ["a.jpg", "b.jpg"]


def test_photos_that_differ_in_suffix(tmp_path, table):
    given = write_masks(tmp_path / "given", **{"a.jpg": 1, "a.png": 3, "c": 1})
    import_masks(given, tmp_path / "masks", sizes_of(*DOUBLE), table)
    assert values_in(tmp_path / "masks") == {"a.jpg.png": 1, "a.png.png": 3, "c.png": 1}
    with pytest.raises(InputError, match="may belong to a.jpg"):
        import_masks(write_masks(tmp_path / "flat", a=1), tmp_path / "masks", sizes_of(*DOUBLE), table)


def test_confidence_in_folders(tmp_path, table):
    given = write_masks(tmp_path / "given", **{"100MEDIA/DJI_0001": 1, "101MEDIA/DJI_0001": 3})
    sure = write_masks(tmp_path / "sure", **{"101MEDIA/DJI_0001": 200})
    target = tmp_path / "confidence"
    import_masks(given, tmp_path / "masks", sizes_of(*CARDS), table, sure, target)
    assert values_in(target) == {"101MEDIA/DJI_0001.png": 200}


def test_names_of_masks_that_nearly_fit_are_shown(tmp_path, table):
    given = write_masks(tmp_path / "given", DJI_0001_thermal=1)
    with pytest.raises(InputError, match=r"nearly fits DJI_0001.JPG.*--name-pattern '{photo}_thermal.png'"):
        import_masks(given, tmp_path / "masks", sizes_of("DJI_0001.JPG", "DJI_0002.JPG"), table)


def test_name_pattern_chooses_among_masks_of_a_photo(tmp_path, table, caplog):
    given = write_masks(tmp_path / "given", x_gtFine_labelIds=1, x_gtFine_instanceIds=9, x_gtFine_color=3)
    write_image(tmp_path / "scene" / "images" / "x.png", np.zeros((6, 8, 3), np.uint8))
    write_json(tmp_path / "scene" / "classes.json", CLASSES)
    scene = Scene(tmp_path / "scene")
    with pytest.raises(InputError, match="x.png has a mask in .* and another in .*--name-pattern"):
        execute("segment", scene, Segment(masks=given))
    pattern = "{photo}_gtFine_labelIds.png"
    with caplog.at_level(logging.WARNING):
        assert execute("segment", scene, Segment(masks=given, name_pattern=pattern))["masks"] == 1
    assert values_in(scene.masks) == {"x.png": 1}
    assert "2 files do not fit --name-pattern" in caplog.text
    with pytest.raises(InputError, match="no name fits --name-pattern"):
        execute("segment", scene, Segment(masks=given, name_pattern="{photo}_other.png"))


def coco(*images: dict) -> dict:
    square = [[0, 0, 8, 0, 8, 6, 0, 6]]
    return {
        "images": [{"id": row, "width": 8, "height": 6} | image for row, image in enumerate(images)],
        "annotations": [
            {"id": row, "image_id": row, "category_id": 1 + 2 * row, "segmentation": square}
            for row in range(len(images))
        ],
        "categories": [{"id": entry["id"], "name": entry["name"]} for entry in CLASSES],
    }


def import_coco(tmp_path: Path, table, content: dict, *photos: str) -> dict[str, int]:
    write_json(tmp_path / "coco.json", content)
    import_masks(MaskFiles(tmp_path / "coco.json"), tmp_path / "masks", sizes_of(*photos), table)
    return values_in(tmp_path / "masks")


def test_label_studio(tmp_path, table):
    content = coco(
        {"file_name": "images\\1a2b3c4d-DJI_0001.JPG"}, {"file_name": "images/5e6f7a8b-DJI_0002.JPG"}
    )
    found = import_coco(tmp_path, table, content, "DJI_0001.JPG", "DJI_0002.JPG")
    assert found == {"DJI_0001.png": 1, "DJI_0002.png": 3}


def test_roboflow(tmp_path, table):
    hashed = "rf.0123456789abcdef0123456789abcdef.jpg"
    content = coco(
        {"file_name": f"DJI-0001-2-_JPG.{hashed}", "extra": {"name": "DJI 0001 (2).JPG"}},
        {"file_name": f"DJI_0002_JPG.{hashed}"},
    )
    found = import_coco(tmp_path, table, content, "DJI 0001 (2).JPG", "DJI_0002.JPG")
    assert found == {"DJI 0001 (2).png": 1, "DJI_0002.png": 3}
    with pytest.raises(InputError, match="may belong to 100MEDIA"):
        import_coco(tmp_path, table, coco({"file_name": f"DJI_0002_JPG.{hashed}"}), *CARDS)


def labelme(label: str, path: str | None = None) -> dict:
    shape = {"label": label, "shape_type": "rectangle", "points": [[0, 0], [8, 6]]}
    return {"imagePath": path, "imageWidth": 8, "imageHeight": 6, "shapes": [shape]}


def test_labelme_in_folders(tmp_path, table):
    for folder, label in (("100MEDIA", "road"), ("101MEDIA", "grass")):
        write_json(tmp_path / "given" / folder / "DJI_0001.json", labelme(label, "DJI_0001.JPG"))
    import_masks(tmp_path / "given", tmp_path / "masks", sizes_of(*CARDS), table)
    assert values_in(tmp_path / "masks") == {"100MEDIA/DJI_0001.png": 1, "101MEDIA/DJI_0001.png": 3}
    # a file may be called what it likes if it names its photo
    write_json(tmp_path / "free" / "label_1.json", labelme("road", "..\\2.jpg"))
    import_masks(tmp_path / "free", tmp_path / "masks", sizes_of("1.jpg", "2.jpg"), table)
    assert values_in(tmp_path / "masks") == {"2.png": 1}


# ---- segmentation, strokes and the annotation page


class Brightness:
    """Class 1 where the photo is dark, else 3."""

    def segment(self, image: np.ndarray) -> Segmentation:
        label = np.where(image[..., 0] < 128, 1, 3).astype(np.uint8)
        return Segmentation(label, label, ())


def write_photos(folder: Path, *names: str) -> Path:
    for row, name in enumerate(names):
        write_image(folder / name, np.full((6, 8, 3), 250 if row % 2 else 5, np.uint8))
    return folder


@pytest.mark.parametrize("names", [CARDS[1:3], DOUBLE[:2]])
def test_segmentation_tells_photos_apart(tmp_path, table, names):
    images = write_photos(tmp_path / "images", *names)
    folders = Folders(*(tmp_path / name for name in ("masks", "confidence", "instances")))
    photos = sorted(images / name for name in [*names, *(CARDS[:1] if names[0] in CARDS else [])][:2])
    for segmented in ([*names], []):
        summary = segment_photos(photos, folders, Brightness(), table, images=images)
        assert summary.segmented == segmented
    keys = PhotoNames(names)
    expected = {f"{keys.key(name)}.png": value for name, value in zip(names, (1, 3), strict=True)}
    assert values_in(folders.masks) == values_in(folders.confidence) == expected
    for name in names:
        content = json.loads(keys.path(folders.instances, name, ".json").read_text())
        assert content["images"][0]["file_name"] == name


def drawing(label: str) -> dict:
    return {"shapes": [{"label": label, "shape_type": "linestrip", "points": [[1, 1], [6, 4]]}]}


def test_strokes_of_photos_of_one_name(tmp_path):
    write_photos(tmp_path / "images", *CARDS)
    write_json(tmp_path / "classes.json", CLASSES)
    scene = Scene(tmp_path)
    session = Session(scene, "101MEDIA/DJI_0001")
    page = session.describe()
    assert page["start"] == "101MEDIA/DJI_0001" and len({photo["stem"] for photo in page["photos"]}) == 4
    session.save("100MEDIA/DJI_0001", drawing("road"))
    session.save("101MEDIA/DJI_0001", drawing("grass"))
    read = read_strokes(scene.strokes, scene.images, scene.class_table())
    found = {one.photo.relative_to(scene.images).as_posix(): one.shapes[0].label for one in read}
    assert found == {CARDS[0]: 1, CARDS[2]: 3}
    assert Session(scene).read("101MEDIA/DJI_0001")[0]["label"] == "grass"
    with pytest.raises(InputError, match="several photos are 'DJI_0001'.*100MEDIA/DJI_0001.JPG, 101MEDIA/"):
        Session(scene, "DJI_0001")
    write_json(scene.strokes / "DJI_0002.json", labelme("road", "DJI_0002.JPG"))
    with pytest.raises(InputError, match="DJI_0002.json may belong to 100MEDIA/DJI_0002.JPG"):
        read_strokes(scene.strokes, scene.images, scene.class_table())


def test_no_folder_of_a_scene_leads_out_of_it(tmp_path):
    """A scene from somebody else may hold links in place of the folders of cards."""
    images = write_photos(tmp_path / "images", *CARDS)
    write_json(tmp_path / "classes.json", CLASSES)
    outside = tmp_path / "outside"
    outside.mkdir()
    folders = Folders(*(tmp_path / name for name in ("masks", "confidence", "instances")))
    for folder in (folders.masks, tmp_path / "strokes"):
        folder.mkdir()
        (folder / "100MEDIA").symlink_to(outside)
    with pytest.raises(InputError, match="leads out"):
        photos = [images / name for name in CARDS]
        segment_photos(photos, folders, Brightness(), Scene(tmp_path).class_table(), images=images)
    with pytest.raises(InputError, match="leads out"):
        Session(Scene(tmp_path)).save("100MEDIA/DJI_0001", drawing("road"))
    assert not list(outside.iterdir())


# ---- a whole scene


def card_scene(path: Path) -> Scene:
    """Photos of two cards, each with its own truth as mask; the last has the same name as the first."""
    write_bare_scene(path)
    taken = [replace(view, name=name) for view, name in zip(views(), [*CARDS, "102MEDIA/DJI_0001.JPG"])]
    for file in path.rglob("sparse/0/*"):
        file.unlink()
    (path / "sparse" / "0").rmdir()
    write_model(path / "sparse" / "0", taken)
    for view in taken:
        write_image(path / "images" / view.name, np.full((view.height, view.width, 3), 128, np.uint8))
        for folder in ("masks", "truth"):
            write_image((path / folder / view.name).with_suffix(".png"), truth_mask(view))
    for file in [*path.glob("masks/*.png"), *path.glob("truth/*.png")]:
        file.unlink()
    return Scene(path)


def test_a_scene_of_several_cards_goes_through_all_stages(tmp_path):
    scene = card_scene(tmp_path / "scene")
    execute("label", scene, Label())
    execute("propagate", scene, Propagate())
    execute("evaluate", scene, Evaluate())
    metrics = json.loads(scene.metrics.read_text())
    assert metrics["labels"]["miou"] > 0.97 and metrics["masks"]["miou"] == 1
    assert len(metrics["per_photo"]) == 5
    execute("export", scene, Export(format=("masks",)))
    for view in scene.model.views:
        mask = read_index_image((scene.export / "masks" / view.name).with_suffix(".png"))
        truth = truth_mask(view)
        assert (mask == truth)[truth > 0].mean() > 0.98
        assert (scene.export / "confidence" / view.name).with_suffix(".png").is_file()
    execute("export", scene, Export(format=("transforms",)))
    files = list(scene.export.glob("**/transforms.json"))
    frames = json.loads(files[0].read_text())["frames"]
    assert len({frame["file_path"] for frame in frames}) == 5
    execute("report", scene, Report())
    page = scene.report.read_text()
    assert page.count("given mask of") == page.count("truth of") > 2
    assert _find_photo("101MEDIA/DJI_0001", scene.model.views, scene).name == CARDS[2]
    with pytest.raises(InputError, match="several photos are 'DJI_0001'"):
        _find_photo("DJI_0001", scene.model.views, scene)
    assert photo_pictures(scene, scene.model.views[2], scene.class_table(), 64).note == ""


def test_masks_of_photos_without_camera_are_counted(tmp_path, caplog):
    scene = card_scene(tmp_path / "scene")
    for folder in (scene.masks, scene.truth):
        write_image(folder / "103MEDIA" / "DJI_0001.png", np.full((120, 160), 77, np.uint8))
    with pytest.raises(InputError, match="belongs to no photo"):
        execute("label", scene, Label())
    write_image(scene.images / "103MEDIA" / "DJI_0001.JPG", np.zeros((120, 160, 3), np.uint8))
    told = "1 photos have no camera, as they did not register: what belongs to them is left out"
    with caplog.at_level(logging.WARNING):
        execute("label", Scene(scene.path), Label())
    assert caplog.text.count(f"{told} (masks 1), such as 103MEDIA/DJI_0001.JPG") == 1
    execute("propagate", scene, Propagate())
    caplog.clear()
    with caplog.at_level(logging.WARNING):
        execute("evaluate", Scene(scene.path), Evaluate())
    assert caplog.text.count(f"{told} (truth 1, masks 1)") == 1
    for file in scene.masks.glob("10[012]MEDIA/*"):
        file.unlink()
    with pytest.raises(InputError, match="none of the 1 masks .* is of a photo with a camera"):
        execute("label", Scene(scene.path), Label())


def test_two_masks_of_one_photo_are_refused(tmp_path):
    scene = card_scene(tmp_path / "scene")
    write_image(scene.masks / "100MEDIA" / "DJI_0001_mask.png", np.zeros((120, 160), np.uint8))
    with pytest.raises(InputError, match="both belong to 100MEDIA/DJI_0001.JPG"):
        execute("label", scene, Label())


def test_photos_spelled_otherwise_on_the_disk(tmp_path):
    scene = card_scene(tmp_path / "scene")
    (scene.images / CARDS[0]).rename(scene.images / "100MEDIA" / "dji_0001.jpg")
    scene = Scene(scene.path)
    assert scene.photo(CARDS[0]).name == "dji_0001.jpg" and len(scene.photo_names) == 5
    assert set(scene.mask_files(scene.masks)) == {view.name for view in scene.model.views}


# ---- projects of other programs


def metashape(path: Path, *labels: str, group: str = "") -> Path:
    cameras = [
        f'<camera id="{row}" sensor_id="0" label="{label}"><transform>1 0 0 {10 * row} 0 -1 0 0 0 0 -1 50 0 0 0 1</transform></camera>'
        for row, label in enumerate(labels)
    ]
    half = len(cameras) // 2
    if group:
        cameras = [
            f'<group id="{number}" label="{100 + number}{group}" type="folder">{"".join(part)}</group>'
            for number, part in enumerate((cameras[:half], cameras[half:]))
        ]
    path.write_text(
        '<document version="2.0.0"><chunk label="Chunk 1" enabled="true"><sensors next_id="1"><sensor id="0" label="cam" type="frame">'
        '<resolution width="80" height="60"/><calibration type="frame" class="adjusted"><resolution width="80" height="60"/><f>60</f>'
        f"</calibration></sensor></sensors><cameras>{''.join(cameras)}</cameras></chunk></document>"
    )
    return path


def imported(path: Path, images: Path | None) -> dict[str, float]:
    """x of the cameras by photo."""
    project, _ = locate_photos(read_metashape(path, Import()), images)
    return {view.name: float(view.center[0]) for view in project.views}


def test_cameras_of_photos_of_one_name(tmp_path):
    images = write_photos(tmp_path / "images", *CARDS)
    everywhere = dict(zip(CARDS, (0.0, 10.0, 20.0, 30.0)))
    full = metashape(tmp_path / "full.xml", *CARDS)
    assert imported(full, images) == imported(full, None) == everywhere
    plain = [Path(name).stem for name in CARDS]
    grouped = metashape(tmp_path / "grouped.xml", *plain, group="MEDIA")
    assert imported(grouped, images) == everywhere
    assert len(imported(grouped, None)) == 4
    labels = metashape(tmp_path / "labels.xml", *plain)
    with pytest.raises(InputError, match="4 of 4 photos .* 'DJI_0001': 100MEDIA/DJI_0001.JPG or 101MEDIA/"):
        imported(labels, images)
    with pytest.raises(InputError, match="all 4 photos of the project share their names"):
        imported(labels, None)
    some = metashape(tmp_path / "some.xml", "DJI_0001", "100MEDIA/DJI_0002.JPG")
    project, _ = locate_photos(read_metashape(some, Import()), images)
    assert [view.name for view in project.views] == [CARDS[1]]
    assert project.left_out == {"that may be any of several photos of their name": ["DJI_0001"]}


def test_cameras_do_not_take_the_photos_of_another_folder(tmp_path):
    """One of two cards is there: its cameras alone get its photos."""
    images = write_photos(tmp_path / "images", *CARDS[2:])
    assert imported(metashape(tmp_path / "p.xml", *CARDS), images) == {CARDS[2]: 20.0, CARDS[3]: 30.0}
    images = write_photos(tmp_path / "free", "east/x.jpg")
    assert imported(metashape(tmp_path / "q.xml", "old/west/x.jpg", "old/east/x.jpg"), images) == {
        "east/x.jpg": 10
    }


def test_a_model_of_photos_of_one_name_is_read(tmp_path):
    """sparse/0 as COLMAP and `sc3d reconstruct` write it."""
    scene = card_scene(tmp_path / "scene")
    assert [view.name for view in scene.model.views][:2] == CARDS[:2]
    assert pycolmap.Reconstruction(str(scene.sparse)).num_reg_images() == 5


# ---- text of other systems


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-32"])
def test_json_with_a_byte_order_mark(tmp_path, encoding):
    (tmp_path / "x.json").write_text('{"a": "ä"}', encoding=encoding)
    assert read_json(tmp_path / "x.json") == {"a": "ä"}


@pytest.mark.parametrize(
    ("name", "text"),
    [("x.xyz", "1 2 3\n4 5 6\n"), ("x.obj", "v 1 2 3\nv 4 5 6\nv 7 8 8\nf 1 2 3\n")],
)
def test_points_behind_a_byte_order_mark_are_kept(tmp_path, name, text):
    (tmp_path / name).write_text(text, encoding="utf-8")
    expected = read_geometry(tmp_path / name).positions
    (tmp_path / name).write_text(text, encoding="utf-8-sig")
    np.testing.assert_array_equal(read_geometry(tmp_path / name).positions, expected)


def test_masks_of_photos_in_another_unicode_form(tmp_path, table):
    name = unicodedata.normalize("NFD", "Überflug_1.jpg")
    given = write_masks(tmp_path / "given", **{unicodedata.normalize("NFC", "Überflug_1"): 1})
    assert import_masks(given, tmp_path / "masks", sizes_of(name), table) == [name]


def test_masks_in_other_letter_case(tmp_path, table):
    given = write_masks(tmp_path / "given", dji_0001=1)
    (given / "dji_0001.png").rename(given / "dji_0001.PNG")
    assert import_masks(given, tmp_path / "masks", sizes_of("DJI_0001.JPG"), table) == ["DJI_0001.JPG"]
