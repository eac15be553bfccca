"""Photos of every encoding, and what lies between them: right, refused in one line at the start, or told with a
number.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image, ImageCms

from sc3d.errors import InputError
from sc3d.io.images import (
    check_photo,
    data_uri,
    image_size,
    read_image,
    read_opaque,
    used_range,
)
from sc3d.io.orientation import turned
from sc3d.io.photo_folder import find_photos, link_photos, unused_files
from sc3d.io.provenance import digest
from sc3d.io.readable_photos import readable_photos
from sc3d.runner import execute
from sc3d.scene.scene import Scene, check_photos
from sc3d.settings.labels import Label
from sc3d.settings.reconstruction import Reconstruct
from sc3d.settings.train import TrainSettings
from sc3d.splatting.dataset import scene_data
from sc3d.stages.reconstruct import prepare
from sc3d.view.captions import add_legend
from sc3d.view.lettering import lettering
from tests.builders import labelled_scene

SIZE = 64, 48


def pixels(size: tuple[int, int] = SIZE) -> np.ndarray:
    """(H, W, 3) uint8, smooth, so that JPEG keeps it."""
    small = np.random.default_rng(0).integers(30, 220, (3, 4, 3), dtype=np.uint8)
    return cv2.resize(small, size, interpolation=cv2.INTER_LINEAR)


def close(image: np.ndarray, expected: np.ndarray, tolerance: float = 3) -> bool:
    return image.shape == expected.shape and np.abs(image.astype(int) - expected).mean() < tolerance


# encodings


def test_encodings_are_read(tmp_path):
    photo = Image.fromarray(pixels())
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    ways = {
        "plain.jpg": {},
        "progressive.jpg": {"progressive": True},
        "profile.jpg": {"icc_profile": profile},
        "profile.png": {"icc_profile": profile},
        "mpo.jpg": {"format": "MPO", "save_all": True, "append_images": [photo]},
        "png_named.jpg": {"format": "PNG"},
        "jpeg_named.png": {"format": "JPEG"},
        "lzw.tif": {"compression": "tiff_lzw"},
        "deflate.tif": {"compression": "tiff_adobe_deflate"},
        "jpeg.tif": {"compression": "jpeg"},
        "pages.tif": {"save_all": True, "append_images": [Image.new("RGB", (9, 9))]},
    }
    for name, options in ways.items():
        photo.save(tmp_path / name, **({"quality": 95} if "jp" in name else {}) | options)
        assert check_photo(tmp_path / name) == SIZE
        assert close(read_image(tmp_path / name), pixels()), name


def test_other_color_models_are_read(tmp_path):
    photo, gray = (
        Image.fromarray(pixels()),
        np.repeat(cv2.cvtColor(pixels(), cv2.COLOR_RGB2GRAY)[..., None], 3, -1),
    )
    photo.convert("CMYK").save(tmp_path / "cmyk.jpg", quality=95)
    assert close(read_image(tmp_path / "cmyk.jpg"), pixels(), 6)
    photo.convert("L").save(tmp_path / "gray.jpg", quality=95)
    assert close(read_image(tmp_path / "gray.jpg"), gray)
    photo.quantize(200).save(tmp_path / "palette.png")
    assert close(read_image(tmp_path / "palette.png"), pixels(), 6)
    cv2.imwrite(str(tmp_path / "deep.png"), pixels()[..., ::-1].astype(np.uint16) * 257)
    assert close(read_image(tmp_path / "deep.png"), pixels())


def test_a_tiled_tiff_is_read(tmp_path):
    from PIL import TiffImagePlugin

    tags = TiffImagePlugin.ImageFileDirectory_v2()
    tags[322], tags[323] = 16, 16
    Image.fromarray(pixels()).save(tmp_path / "tiled.tif", tiffinfo=tags)
    assert close(read_image(tmp_path / "tiled.tif"), pixels())


@pytest.mark.parametrize("suffix", ["tif", "png", "jpg"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_pixels_are_those_that_are_stored(tmp_path, suffix, orientation):
    """Pillow and OpenCV turn TIFF, COLMAP does not."""
    exif, file = Image.Exif(), tmp_path / f"a.{suffix}"
    exif[0x0112] = orientation
    Image.fromarray(pixels()).save(file, exif=exif)
    assert image_size(file) == SIZE
    assert close(read_image(file), pixels(), 4)
    assert close(read_image(file, shown=True), turned(pixels(), orientation), 4)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_gray_tiff_is_not_scrambled(tmp_path, orientation):
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.fromarray(pixels()[..., 0]).save(tmp_path / "a.tif", exif=exif)
    assert (read_image(tmp_path / "a.tif") == pixels()[..., :1]).all()


@pytest.mark.parametrize("name", ["a.jpg", "a.png", "a.tif"])
def test_photos_that_are_cut_off_are_refused_at_the_start(tmp_path, name):
    for other in ("b", "c"):
        Image.fromarray(pixels()).save(tmp_path / f"{other}.jpg")
    Image.fromarray(pixels((640, 480))).save(tmp_path / name)
    content = (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(content[: len(content) * 3 // 4])
    with pytest.raises(InputError, match=f"{name}.*(cut off|damaged)"):
        prepare(tmp_path, Scene(tmp_path.parent / "scene"), Reconstruct())


@pytest.mark.parametrize(
    ("head", "kind"),
    [
        (b"\0\0\0\x18ftypheic", "HEIC"),
        (b"RIFF\0\0\0\0WEBPVP8 ", "WebP"),
        (b"BM" + bytes(40), "BMP"),
        (b"GIF89a", "GIF"),
    ],
)
def test_other_formats_under_a_wrong_suffix_are_named(tmp_path, head, kind):
    (tmp_path / "a.jpg").write_bytes(head + bytes(60))
    with pytest.raises(InputError, match=f"it is a {kind}.* image, not a JPEG, PNG or TIFF: convert it"):
        check_photo(tmp_path / "a.jpg")


def test_other_formats_are_counted(tmp_path, caplog):
    for name in ("a", "b"):
        Image.fromarray(pixels()).save(tmp_path / f"{name}.jpg")
    for number in range(5):
        (tmp_path / f"IMG_{number}.HEIC").write_bytes(b"x")
    Image.fromarray(pixels()).save(tmp_path / "c.webp")
    prepare(tmp_path, Scene(tmp_path.parent / "scene"), Reconstruct())
    assert "left out 6 of a format that is not read" in caplog.text and "IMG_0.HEIC" in caplog.text
    for name in ("a", "b"):
        (tmp_path / f"{name}.jpg").unlink()
    with pytest.raises(InputError, match="left out: 6 of a format"):
        find_photos(tmp_path)


def test_pages_are_counted(tmp_path, caplog):
    photo = Image.fromarray(pixels())
    for name in ("a", "b"):
        photo.save(tmp_path / f"{name}.tif", save_all=True, append_images=[photo])
    prepare(tmp_path, Scene(tmp_path.parent / "scene"), Reconstruct())
    assert "2 TIFF files have several pages, of which the first is used" in caplog.text


def test_tiny_and_huge_photos_are_refused(tmp_path):
    for name, size in (("a", SIZE), ("b", SIZE), ("dot", (1, 1))):
        Image.new("RGB", size).save(tmp_path / f"{name}.png")
    with pytest.raises(InputError, match=r"dot.png is smaller than 16 px: take it out"):
        prepare(tmp_path, Scene(tmp_path.parent / "scene"), Reconstruct())
    Image.new("1", (20_000, 20_000)).save(tmp_path / "dot.png")
    with pytest.raises(InputError, match="megapixels"):
        prepare(tmp_path, Scene(tmp_path.parent / "scene"), Reconstruct())


# depth


def test_sixteen_bits_are_stretched_by_one_range(tmp_path, caplog):
    caplog.set_level("INFO")
    (tmp_path / "photos").mkdir()
    for number in range(3):  # each uses a part of the range only
        values = 7000 + 340 * number + np.arange(48 * 64).reshape(48, 64) % 340
        cv2.imwrite(str(tmp_path / "photos" / f"{number}.tif"), values.astype(np.uint16))
    folder = tmp_path / "photos"
    low, high = used_range(folder)
    assert 7000 <= low <= 7010 and 8010 <= high <= 8020
    assert f"3 photos have 16 bits and use the values {low} to {high}" in caplog.text
    first, last = (read_image(folder / f"{number}.tif", folder) for number in (0, 2))
    assert len(np.unique(first)) > 80 and first.max() < last.min()


def test_sixteen_bits_that_are_all_used_stay_as_they_were(tmp_path):
    values = (np.arange(48 * 64).reshape(48, 64) * 21).astype(np.uint16)
    cv2.imwrite(str(tmp_path / "a.png"), values)
    assert (read_image(tmp_path / "a.png")[..., 0] == values >> 8).all()


def test_colmap_gets_what_is_read(tmp_path):
    folder, work = tmp_path / "photos", tmp_path / "work"
    (folder / "sub").mkdir(parents=True)
    work.mkdir()
    values = 7000 + np.arange(48 * 64).reshape(48, 64) % 1000
    cv2.imwrite(str(folder / "sub" / "a.tif"), values.astype(np.uint16))
    Image.fromarray(np.dstack([pixels(), half()])).save(folder / "b.png")
    names = ["b.png", "sub/a.tif"]
    photos, masks = readable_photos(folder, names, work)
    assert len(np.unique(read_image(photos / "sub/a.tif"))) > 200
    assert (read_image(photos / "b.png") == pixels()).all()
    assert (read_image(masks / "b.png.png")[..., 0] == half()).all()
    assert (read_image(masks / "sub/a.tif.png") == 255).all()  # COLMAP skips photos without a mask
    (folder / "sub" / "a.tif").unlink()
    (folder / "b.png").unlink()
    Image.fromarray(pixels()).save(folder / "c.png")
    assert readable_photos(folder, ["c.png"], work / "2") == (folder, None)


@pytest.mark.parametrize("kind", [np.float32, np.float64, np.int32])
def test_other_depths_are_refused_at_the_start(tmp_path, kind):
    for name in "ab":
        Image.fromarray(pixels()).save(tmp_path / f"{name}.jpg")
    cv2.imwrite(str(tmp_path / "c.tif"), pixels()[..., 0].astype(kind))
    with pytest.raises(InputError, match=r"c.tif.*(floating point|32 bits|8 or 16)"):
        prepare(tmp_path, Scene(tmp_path.parent / "scene"), Reconstruct())
    cv2.imwrite(str(tmp_path / "c.tif"), pixels().astype(kind))
    with pytest.raises(InputError, match=r"c.tif.*(floating point|32 bits|8 or 16)"):
        prepare(tmp_path, Scene(tmp_path.parent / "scene"), Reconstruct())


# alpha


def half() -> np.ndarray:
    """(H, W) uint8 alpha, 0 in the left half."""
    return np.where(np.arange(SIZE[0]) < SIZE[0] // 2, 0, 255)[None].repeat(SIZE[1], axis=0).astype(np.uint8)


@pytest.mark.parametrize("name", ["rgba.png", "rgba.tif", "gray.png", "palette.png", "turned.tif"])
def test_alpha_is_a_mask(tmp_path, name):
    photo, exif = Image.fromarray(np.dstack([pixels(), half()])), Image.Exif()
    exif[0x0112] = 6 if name == "turned.tif" else 1
    if name == "gray.png":
        photo = photo.convert("LA")
    if name == "palette.png":
        indices = np.where(half() > 0, 1, 0).astype(np.uint8)
        photo = Image.frombytes("P", SIZE, indices.tobytes())
        photo.putpalette([10, 20, 30, 200, 100, 50])
        photo.info["transparency"] = 0
    photo.save(tmp_path / name, exif=exif)
    np.testing.assert_array_equal(read_opaque(tmp_path / name), half() > 0)
    if "rgba" in name or "turned" in name:
        assert close(read_image(tmp_path / name)[:, 32:], pixels()[:, 32:])


def test_opaque_photos_have_no_mask(tmp_path):
    Image.fromarray(pixels()).convert("RGBA").save(tmp_path / "a.png")
    Image.fromarray(pixels()).save(tmp_path / "b.jpg")
    assert read_opaque(tmp_path / "a.png") is None and read_opaque(tmp_path / "b.jpg") is None


def transparent(scene: Scene) -> None:
    """Make the left half of every photo transparent, and of a color of its own."""
    scene.images.mkdir(exist_ok=True)
    for view in scene.model.views:
        rgba = np.full((view.height, view.width, 4), 120, np.uint8)
        rgba[:, : view.width // 2] = (255, 0, 255, 0)
        Image.fromarray(rgba).save(scene.photo(view.name), "PNG")


def test_what_is_transparent_has_no_label_to_vote_and_no_truth(tmp_path):
    scene = labelled_scene(tmp_path)
    transparent(scene)
    view = scene.model.views[0]
    truth = scene.path / "truth"
    truth.mkdir(exist_ok=True)
    for each in scene.model.views:
        Image.fromarray(np.ones((each.height, each.width), np.uint8)).save(
            truth / f"{Path(each.name).stem}.png"
        )
    mask = scene.read_mask(truth / f"{Path(view.name).stem}.png", view.name)
    assert not mask[:, : view.width // 2].any() and mask[:, view.width // 2 :].all()


def test_what_is_transparent_is_not_trained_on(tmp_path):
    scene = labelled_scene(tmp_path)
    data, _ = scene_data(scene, TrainSettings(max_size=80))
    transparent(scene)
    data, _ = scene_data(Scene(scene.path), TrainSettings(max_size=80))
    mask, image = data.mask(0), data.image(0)
    assert 0.4 < mask.mean() < 0.6 and (np.abs(image[mask].astype(int) - 120) <= 1).mean() > 0.95


def with_alpha(path: Path, alpha: int) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.dstack([pixels(), np.full(pixels().shape[:2], alpha, np.uint8)])).save(path)
    return path


def test_a_wholly_transparent_photo_is_named(tmp_path, caplog):
    """Before features are looked for, where it is segmented, and where it would vote."""
    folder = tmp_path / "photos"
    for name, alpha in (("a", 0), ("b", 255), ("c", 9)):
        with_alpha(folder / f"{name}.png", alpha)
    told = "1 of 3 photos are wholly transparent and show nothing: a.png"
    prepare(folder, Scene(tmp_path / "scene"), Reconstruct())
    assert told in caplog.text
    with_alpha(folder / "c.png", 0)
    with pytest.raises(InputError, match="2 of 3 photos in .* are wholly transparent: at least two others"):
        prepare(folder, Scene(tmp_path / "other"), Reconstruct())
    assert not (tmp_path / "other").exists()


def test_a_wholly_transparent_photo_does_not_vote_and_says_so(tmp_path, caplog):
    scene = labelled_scene(tmp_path)
    first, *others = scene.model.views
    for view in scene.model.views:
        rgba = np.full((view.height, view.width, 4), 0 if view is first else 255, np.uint8)
        scene.images.mkdir(exist_ok=True)
        Image.fromarray(rgba).save(scene.photo(view.name), "PNG")
    execute("label", Scene(scene.path), Label(), overwrite=True)
    assert (
        f"1 of {1 + len(others)} photos are wholly transparent and do not vote: {first.name}" in caplog.text
    )


# what lies in the folder of photos


def folder_of_photos(path: Path) -> Path:
    path.mkdir()
    for name in "ab":
        Image.fromarray(pixels()).save(path / f"{name}.jpg")
    return path


def made_by_sc3d(path: Path, name: str) -> None:
    """An output with its sidecar."""
    path.mkdir(parents=True, exist_ok=True)
    (path / f"{name}.json").write_text(json.dumps({"stage": "test", "settings": {}}, indent=1))


def test_a_scene_inside_the_folder_of_photos(tmp_path):
    photos = folder_of_photos(tmp_path / "photos")
    before, scene = digest(photos), Scene(photos / "out")
    prepare(photos, scene, Reconstruct())
    assert digest(scene.images) == before
    made_by_sc3d(scene.sparse.parent, "0")
    for name in ("train.jpg", "masks/a.png", "export/masks/b.png", "shot.png"):
        (scene.path / name).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(pixels()).save(scene.path / name)
    for folder in (photos, scene.images):
        assert [file.name for file in find_photos(folder)] == ["a.jpg", "b.jpg"]
        assert digest(folder) == before
    assert unused_files(photos) == "1 written by sc3d (out)"


def test_a_scene_that_is_the_folder_of_photos(tmp_path):
    photos = folder_of_photos(tmp_path / "photos")
    made_by_sc3d(photos, "gaussians.ply")
    for name in ("train.jpg", "masks/a.png", "masks.before/a.png", "truth/a.png", "export/masks.jpg"):
        (photos / name).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(pixels()).save(photos / name)
    assert [file.name for file in find_photos(photos)] == ["a.jpg", "b.jpg"]


def test_outputs_beside_their_sidecar_are_no_photos(tmp_path):
    photos = folder_of_photos(tmp_path / "photos")
    made_by_sc3d(photos, "fused")
    (photos / "fused").mkdir()
    Image.fromarray(pixels()).save(photos / "fused" / "c.png")
    assert len(find_photos(photos)) == 2


def test_folders_of_photos_that_only_look_like_scenes_stay(tmp_path):
    photos = tmp_path / "photos"
    photos.mkdir()
    for day in ("monday", "tuesday"):
        folder = folder_of_photos(photos / day)
        (folder / "classes.json").write_text("[]")
        shutil.copytree(folder, folder / "images")
        (folder / "a.json").write_text(json.dumps({"shapes": []}))
    assert len(find_photos(photos)) == 8


def test_leftovers_are_no_photos(tmp_path):
    photos = folder_of_photos(tmp_path / "photos")
    for name in ("._a.jpg", ".trash/c.jpg", "__MACOSX/d.jpg", "@eaDir/e.jpg", "Thumbnails/f.jpg"):
        (photos / name).parent.mkdir(exist_ok=True)
        shutil.copyfile(photos / "a.jpg", photos / name)
    assert [file.name for file in find_photos(photos)] == ["a.jpg", "b.jpg"]
    assert unused_files(photos).startswith("2 hidden (._a.jpg, .trash/c.jpg); 3 thumbnails or leftovers")


# links


def test_a_folder_of_photos_that_was_moved_is_named(tmp_path):
    photos = folder_of_photos(tmp_path / "photos")
    scene = Scene(tmp_path / "scene")
    scene.path.mkdir()
    link_photos(photos, scene.images)
    photos.rename(tmp_path / "elsewhere")
    for read in (
        lambda: check_photos(scene, ["a.jpg"]),
        lambda: find_photos(scene.images),
        lambda: scene.require(scene.images, hint="photos"),
        lambda: read_image(scene.photo("a.jpg")),
    ):
        with pytest.raises(
            InputError, match=r"images is a link to .*photos, which is not there: has it been moved"
        ):
            read()


def test_a_photo_that_is_a_broken_link_is_named(tmp_path):
    photos = folder_of_photos(tmp_path / "photos")
    (photos / "c.jpg").symlink_to(tmp_path / "gone.jpg")
    with pytest.raises(InputError, match=r"c.jpg is a link to .*gone.jpg, which is not there"):
        check_photo(photos / "c.jpg")
    scene = Scene(tmp_path / "scene")
    scene.path.mkdir()
    scene.masks.symlink_to(tmp_path / "no")
    with pytest.raises(InputError, match=r"masks is a link to .*no, which is not there"):
        scene.require(scene.masks, hint="")


# letters


@pytest.mark.parametrize("text", ["Gebäude", "дерево", "ğ ø ß é"])
def test_letters_are_drawn_or_replaced(text):
    drawn, font = lettering(text, 20)
    box = font.getmask("\uffff")
    for letter in drawn.replace(" ", ""):
        mask = font.getmask(letter)
        assert letter < "\x7f" or bytes(mask) != bytes(box)


def test_without_a_font_letters_become_similar_ones(monkeypatch):
    monkeypatch.setattr("sc3d.view.lettering.fonts", list)
    assert lettering("Gebäude und Straße", 17)[0] == "Gebaude und Strasse"
    assert lettering("道路", 17)[0] == "U+9053U+8DEF"
    assert lettering("road", 17)[0] == "road"
    lettering.cache_clear()


def test_the_legend_names_classes_in_any_script(tmp_path):
    scene = labelled_scene(tmp_path)
    entries = json.loads(scene.classes.read_text())
    entries[0]["name"] = "Straße 道路"
    scene.classes.write_text(json.dumps(entries))
    image = np.zeros((60, 400, 3), np.uint8)
    assert add_legend(image, "label", scene.class_table()).shape[0] > 60
    assert data_uri(image).startswith("data:image/jpeg")
