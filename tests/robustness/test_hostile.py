"""Broken and malicious scenes: COLMAP models, photos, masks, tables, links; and what must not be in the
source: one clear line within a second, little memory.
"""

from __future__ import annotations

import ast
import json
import os
import shutil
import struct
import sys
import zipfile
import zlib
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import sc3d
from sc3d.cli import main
from sc3d.errors import InputError
from sc3d.io.images import image_size, read_image
from sc3d.io.json_files import read_json, read_text
from sc3d.io.mask_images import read_index_image
from sc3d.io.photo_folder import find_photos
from sc3d.report.data import _read_sidecars, read_features
from sc3d.runner import MAX_SIDECAR
from sc3d.scene.class_table import read_classes
from sc3d.scene.depth_map import depth_map_size
from sc3d.scene.scene import match_masks, read_sparse_model
from sc3d.segmentation.strokes.files import MAX_POINTS, MAX_SHAPES, parse_shapes
from sc3d.settings.outputs import ViewCommand
from tests.builders import views, write_bare_scene, write_model
from tests.robustness.hostile_files import patch, picture, refused, tracked_model


@pytest.fixture(scope="module", autouse=True)
def warm(tmp_path_factory):
    """Kernels are loaded once, outside of what is timed."""
    folder = tmp_path_factory.mktemp("warm")
    tracked_model().write_binary(str(folder))
    read_sparse_model(folder)


def test_no_pickle_and_every_torch_load_takes_weights_only():
    for file in Path(sc3d.__file__).parent.rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
                given = {keyword.arg: getattr(keyword.value, "value", None) for keyword in node.keywords}
                if node.func.attr == "load" and getattr(node.func.value, "id", "") == "torch":
                    assert given.get("weights_only") is True, file
                assert given.get("allow_pickle") is not True and given.get("trust_remote_code") is not True, (
                    file
                )
                assert node.func.attr not in ("from_file", "read_pickle") and (
                    node.func.attr,
                    getattr(node.func.value, "id", ""),
                ) not in (("load", "yaml"), ("loads", "marshal")), file
            names = (
                [alias.name for alias in node.names]
                if isinstance(node, ast.Import)
                else [node.module]
                if isinstance(node, ast.ImportFrom)
                else []
            )
            assert not {"pickle", "cPickle", "dill", "joblib", "shelve", "marshal"} & {
                name.split(".")[0] for name in names if name
            }, file


# ---- COLMAP


@pytest.fixture
def model(tmp_path) -> Path:
    (tmp_path / "model").mkdir()
    tracked_model().write_binary(str(tmp_path / "model"))
    return tmp_path / "model"


@pytest.mark.parametrize("name", ["cameras", "images", "points3D", "rigs", "frames"])
@pytest.mark.parametrize("count", [0, 2**20, 2**60, 2**64 - 1])
def test_counts_of_a_model(model, name, count):
    patch(model / f"{name}.bin", 0, "<Q", count)
    refused(f"{name}.bin of the COLMAP model", read_sparse_model, model)


@pytest.mark.parametrize("count", [2**20, 2**31, 2**60, 2**64 - 1])
def test_track_and_keypoint_counts(model, count):
    patch(model / "points3D.bin", 8 + 43, "<Q", count)
    refused("points3D.bin of the COLMAP model", read_sparse_model, model)
    tracked_model().write_binary(str(model))
    patch(model / "images.bin", (model / "images.bin").read_bytes().index(b"\0", 8 + 64) + 1, "<Q", count)
    refused("images.bin of the COLMAP model", read_sparse_model, model)


@pytest.mark.parametrize("name", ["cameras", "images", "points3D", "rigs", "frames"])
def test_every_prefix_of_a_model_is_refused(model, name):
    file = model / f"{name}.bin"
    content = file.read_bytes()
    for length in range(0, len(content), 3):
        file.write_bytes(content[:length])
        with pytest.raises(InputError, match=f"{name}.bin of the COLMAP model"):
            read_sparse_model(model)
    file.write_bytes(content + b"\0")
    refused("more than it announces", read_sparse_model, model)
    file.write_bytes(content)
    assert len(read_sparse_model(model).points) == 5


def test_values_of_a_model(model):
    for position, form, value, match in (
        (16, "<Q", 2**40, "sizes from"),
        (16, "<Q", 0, "sizes from"),
        (16, "<Q", 99_999_999, "sizes from"),
        (32, "<d", np.nan, "finite"),
        (32, "<d", -5.0, "positive"),
        (12, "<i", 99, "unknown model 99"),
    ):
        tracked_model().write_binary(str(model))
        patch(model / "cameras.bin", position, form, value)
        refused(match, read_sparse_model, model)
    for quat in ((0, 0, 0, 0), (np.nan, 0, 0, 0)):
        tracked_model().write_binary(str(model))
        patch(model / "frames.bin", 16, "<4d", *quat)
        refused("not a rotation", read_sparse_model, model)
    tracked_model().write_binary(str(model))
    patch(model / "points3D.bin", 16, "<d", np.inf)
    refused("not finite", read_sparse_model, model)


def test_duplicate_ids(model):
    image = (model / "images.bin").read_bytes()
    length = image.index(b"\0", 72) + 9 + 24 * 6 - 8
    patch(model / "images.bin", 8 + length, "<I", 1)
    refused("photo 1 twice", read_sparse_model, model)
    tracked_model().write_binary(str(model))
    patch(model / "points3D.bin", 8 + 51 + 8 * 5, "<Q", 1)
    refused("COLMAP model", read_sparse_model, model)


def test_observations_of_points_that_were_filtered_out(model):
    whole = read_sparse_model(model)
    patch(model / "points3D.bin", 0, "<Q", 0)
    (model / "points3D.bin").write_bytes(bytes(8))
    assert (
        all(len(track) == 0 for track in read_sparse_model(model).tracks) and max(map(len, whole.tracks)) == 5
    )


@pytest.mark.parametrize(
    "name", ["../a.jpg", "/etc/passwd", "a/../../b.jpg", "..", ".", "a\\b.jpg", "a\nb.jpg", "\x1b[31m.jpg"]
)
def test_photo_names_that_lead_out_or_act_on_terminals(tmp_path, name):
    evil = views()
    object.__setattr__(evil[0], "name", name)
    write_model(tmp_path / "model", evil)
    refused("outside the scene", read_sparse_model, tmp_path / "model")


def test_name_that_is_no_text(model):
    patch(model / "images.bin", 72, "3s", b"\xff\xfe\xfd")
    refused("cannot read the COLMAP model", read_sparse_model, model)


# ---- photos and masks


def _chunk(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))


def _png(
    width: int, height: int, depth: int = 8, color: int = 0, extra: bytes = b"", data: bytes = b"\0" * 100
) -> bytes:
    return (
        b"\x89PNG\r\n\x1a\n"
        + _chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, depth, color, 0, 0, 0))
        + extra
        + _chunk(b"IDAT", zlib.compress(data))
        + _chunk(b"IEND", b"")
    )


def _jpeg_of_size(width: int, height: int) -> bytes:
    content = bytearray(picture("JPEG"))
    struct.pack_into(">HH", content, content.index(b"\xff\xc0") + 5, height, width)
    return bytes(content)


@pytest.mark.parametrize(
    "content",
    [
        _png(60000, 60000),
        _png(60000, 60000, color=2),
        _png(13000, 13000),
        _png(2**31 - 1, 1),
        _png(100_001, 1),
        _jpeg_of_size(60000, 60000),
        _jpeg_of_size(13000, 13000),
    ],
)
def test_decompression_bombs(tmp_path, content):
    for name in ("a.png", "a.jpg"):
        (tmp_path / name).write_bytes(content)
        for read in (image_size, read_image, read_index_image):
            refused("megapixels", read, tmp_path / name)


def test_bombs_in_the_details_of_a_png(tmp_path):
    packed = zlib.compress(bytes(200 << 20))
    for extra in (
        _chunk(b"zTXt", b"a\0\0" + packed),
        _chunk(b"iCCP", b"a\0\0" + packed),
        _chunk(b"iTXt", b"a\0\1\0\0\0" + packed),
    ):
        (tmp_path / "a.png").write_bytes(_png(4, 4, extra=extra, data=bytes(20)))
        refused("cannot read the mask", read_index_image, tmp_path / "a.png")


def test_every_prefix_of_a_photo_is_refused(tmp_path):
    """Decoders fill what is missing of a JPEG with gray and say nothing."""
    for name, content in (
        ("a.jpg", picture("JPEG")),
        ("b.jpg", picture("JPEG", progressive=True)),
        ("c.png", picture("PNG")),
    ):
        read_image_bytes(tmp_path / name, content)
        for length in range(0, len(content) - (12 if name == "c.png" else 1), 7):
            (tmp_path / name).write_bytes(content[:length])
            with pytest.raises(InputError):
                read_image(tmp_path / name)
    (tmp_path / "a.jpg").write_bytes(picture("JPEG")[:-300] + bytes(300))  # what a full disk leaves
    refused("cut off", read_image, tmp_path / "a.jpg")
    read_image_bytes(tmp_path / "a.jpg", picture("JPEG") + bytes(1000))  # padding, as some cameras write it


def read_image_bytes(path: Path, content: bytes) -> None:
    path.write_bytes(content)
    assert read_image(path).shape == (30, 40, 3)


@pytest.mark.parametrize(
    "content",
    [
        b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 10 10\nshowpage\n",
        b"P6 2 2 255\n" + bytes(12),
        b"GIF89a" + bytes(30),
        b"BM" + bytes(60),
        b"",
        b"\0" * 99,
    ],
)
def test_other_formats_are_not_opened(tmp_path, content):
    (tmp_path / "a.png").write_bytes(content)
    for read in (image_size, read_image, read_index_image):
        refused("not a JPEG, PNG or TIFF", read, tmp_path / "a.png")


def test_masks_of_sixteen_bits_and_of_an_absurd_size(tmp_path):
    Image.fromarray(np.full((6, 8), 700, np.uint16)).save(tmp_path / "a.png")
    refused("16 bits", read_index_image, tmp_path / "a.png")
    (tmp_path / "a.png").write_bytes(_png(12_000, 9_000))
    refused("100 megapixels", match_masks, tmp_path, {"a.jpg": (800, 600)}, None)


def test_multi_picture_jpegs_of_drones_are_read(tmp_path):
    first, second = (
        Image.fromarray(np.zeros((30, 40, 3), np.uint8)),
        Image.fromarray(np.ones((15, 20, 3), np.uint8)),
    )
    first.save(tmp_path / "a.jpg", "MPO", save_all=True, append_images=[second])
    assert image_size(tmp_path / "a.jpg") == (40, 30) and read_image(tmp_path / "a.jpg").shape == (30, 40, 3)


# ---- JSON, links, pipes


def test_json_that_is_deep_large_or_no_file(tmp_path):
    (tmp_path / "classes.json").write_text("[" * 100_000 + "]" * 100_000)
    refused("valid JSON", read_classes, tmp_path / "classes.json")
    (tmp_path / "classes.json").write_text("[" + "{}," * 500_000 + "{}]")
    refused("larger than 1 MiB", read_classes, tmp_path / "classes.json")
    (tmp_path / "number.json").write_text("[" + "9" * 100_000 + "]")
    refused("valid JSON", read_json, tmp_path / "number.json")
    os.mkfifo(tmp_path / "pipe.json")
    refused("cannot read", read_json, tmp_path / "pipe.json")  # and does not wait for somebody to write
    refused("cannot read", read_classes, tmp_path / "pipe.json")


def npz(path: Path, shape: tuple[int, ...], kind: str = "|u1", content: bytes = bytes(9)) -> Path:
    """A compressed depth map whose arrays announce a shape."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in ("depth", "normals", "num_views", "sky"):
            with archive.open(f"{name}.npy", "w") as file:
                header = {"descr": kind, "fortran_order": False, "shape": shape}
                np.lib.format.write_array_header_1_0(file, header)
                file.write(content)
    return path


@pytest.mark.parametrize(
    ("shape", "kind"),
    [
        ((60_000, 60_000), "|u1"),
        ((1, 10**6), "|u1"),
        ((3, 3, 10**9), "|u1"),
        ((3, 3), "|S99"),
        ((3, 3), "|O"),
    ],
)
def test_arrays_that_announce_too_much(tmp_path, monkeypatch, shape, kind):
    """A few compressed bytes hold gigabytes of zeros: refused by the header, before room is made."""
    monkeypatch.setattr(np.lib.format, "read_array", lambda *_, **__: pytest.fail("was read"))
    refused("damaged", depth_map_size, npz(tmp_path / "a.jpg.npz", shape, kind))


def test_depth_that_is_no_archive(tmp_path):
    file = tmp_path / "a.jpg.npz"
    refused("missing", depth_map_size, file)
    assert depth_map_size(npz(file, (3, 3))) == 3
    with file.open("wb") as stream:  # an array that is not packed; numpy would make room for it
        np.lib.format.write_array_header_1_0(
            stream, {"descr": "|u1", "fortran_order": False, "shape": (10**6, 10**6)}
        )
    refused("damaged", depth_map_size, file)
    for make in (os.mkfifo, Path.mkdir, lambda path: path.symlink_to("/dev/zero")):
        file.unlink()
        make(file)
        refused("damaged", depth_map_size, file)
        if file.is_dir():
            file.rmdir()
            file.touch()


def test_pipes_and_devices_are_not_waited_for(tmp_path, caplog):
    """In a report's records and features, and in every text."""
    for number, make in enumerate((os.mkfifo, lambda path: path.symlink_to("/dev/zero"))):
        for suffix in ("json", "geojson", "txt"):
            make(tmp_path / f"{number}.{suffix}")
        refused("cannot read", read_text, tmp_path / f"{number}.txt")
        assert read_features(tmp_path / f"{number}.geojson") is None
    (tmp_path / "big.json").write_text('{"stage": "label"}' + " " * MAX_SIDECAR)
    assert not _read_sidecars(tmp_path)
    assert caplog.text.count("left out of the report") == 3


def test_records_with_names_that_are_no_text(tmp_path):
    """A record may name a file whose name is not UTF-8."""
    scene = write_bare_scene(tmp_path / "scene")
    record = {"stage": "label", "settings": {"cloud": "a\udcff.ply"}, "summary": {}, "inputs": {}}
    (scene / "seeds.ply.json").write_text(json.dumps(record))
    main(["report", str(scene)])
    assert b"a\\udcff.ply" in (scene / "report.html").read_bytes()


def test_drawings_of_absurd_length(tmp_path):
    table = read_classes(write_bare_scene(tmp_path / "scene") / "classes.json")
    point = {"label": "road", "shape_type": "point", "points": [[1, 1]]}
    line = {"label": "road", "shape_type": "linestrip", "points": [[1, 1]] * (MAX_POINTS + 1)}
    for shapes in ([point] * (MAX_SHAPES + 1), [line]):
        refused("at most", parse_shapes, {"shapes": shapes}, "the drawing", (100, 100), table)
    assert len(parse_shapes({"shapes": [point] * 9}, "the drawing", (100, 100), table)) == 9


def test_masks_that_are_a_link_to_themselves(tmp_path, capsys):
    scene = write_bare_scene(tmp_path / "scene")
    (scene / "images").mkdir()
    for view in views():
        (scene / "images" / view.name).write_bytes(picture("JPEG", size=(view.width, view.height)))
    for name in ("masks", "truth", "images"):
        attacked = tmp_path / name
        shutil.copytree(scene, attacked)
        shutil.rmtree(attacked / name)
        (attacked / name).symlink_to(name)
        for arguments in (["segment", "--masks", str(scene / "truth")], ["evaluate"], ["label"]):
            with pytest.raises(SystemExit) as stopped:
                main([arguments[0], str(attacked), *arguments[1:]])
                sys.exit(0)
            assert stopped.value.code in (0, 2)
    assert "Traceback" not in capsys.readouterr().err


@pytest.mark.parametrize("name", ["a\nb", "\x1b[2J", "\ud800", "n" * 300, " "])
def test_class_names(tmp_path, name):
    (tmp_path / "classes.json").write_text(json.dumps([{"id": 1, "name": name, "color": [0, 0, 0]}]))
    refused("name", read_classes, tmp_path / "classes.json")


def test_class_names_cannot_lead_exports_out_of_the_scene(tmp_path):
    from sc3d.exporters.clouds import file_name

    for name in ("../../evil", "/etc/passwd", "..", "a/b", "C:\\x", "con", "\u202egpj"):
        assert (
            "/" not in file_name(name) and "\\" not in file_name(name) and not file_name(name).startswith(".")
        )


def test_links_out_of_a_folder(tmp_path):
    photos, secret = tmp_path / "photos", tmp_path / "secret.jpg"
    photos.mkdir()
    secret.write_bytes(picture("JPEG"))
    (photos / "a.jpg").write_bytes(picture("JPEG"))
    (photos / "b.jpg").symlink_to(photos / "a.jpg")
    assert len(find_photos(photos)) == 2  # within the folder
    (photos / "c.jpg").symlink_to(secret)
    refused("leads out of", find_photos, photos)
    (photos / "c.jpg").unlink()
    (tmp_path / "images").symlink_to(photos)
    assert len(find_photos(tmp_path / "images")) == 2  # the folder itself may be a link
    os.mkfifo(photos / "d.jpg")
    assert len(find_photos(photos)) == 2


@pytest.mark.parametrize("place", ["masks/photo_0.png", "seeds.ply"])
def test_scene_whose_files_are_links(tmp_path, capsys, place):
    """A mask that is a link out of the scene is not read; an output that is one is replaced, not what it
    leads to.
    """
    scene, outside = write_bare_scene(tmp_path / "scene"), tmp_path / "outside"
    outside.write_bytes((scene / "masks" / "photo_0.png").read_bytes())
    (scene / place).unlink(missing_ok=True)
    (scene / place).symlink_to(outside)
    before = outside.read_bytes()
    if place == "seeds.ply":
        main(["label", str(scene)])
        assert not (scene / place).is_symlink()
    else:
        with pytest.raises(SystemExit) as stopped:
            main(["label", str(scene)])
        assert stopped.value.code == 2 and "leads out of" in capsys.readouterr().err
    assert outside.read_bytes() == before


@pytest.mark.parametrize(
    ("link", "arguments"),
    [
        ("export", ["export", "SCENE", "--format", "masks", "--labelled", "SCENE/seeds.ply"]),
        ("sparse", ["georeference", "SCENE", "--epsg", "32615", "--offset", "1", "2", "3"]),
        ("masks", ["synthesize", "SCENE", "--views", "2", "--width", "64"]),
    ],
)
def test_folders_that_lead_out_of_the_scene_are_not_written(tmp_path, capsys, link, arguments):
    scene, outside = write_bare_scene(tmp_path / "scene"), tmp_path / "outside"
    if (scene / link).exists():
        (scene / link).rename(outside)
    else:
        outside.mkdir()
    (scene / link).symlink_to(outside, target_is_directory=True)
    before = sorted(outside.rglob("*"))
    if link == "sparse":  # only read from there: allowed
        main([argument.replace("SCENE", str(scene)) for argument in arguments])
    else:
        with pytest.raises(SystemExit) as stopped:
            main([argument.replace("SCENE", str(scene)) for argument in arguments])
        assert stopped.value.code == 2 and "link" in capsys.readouterr().err
    assert sorted(outside.rglob("*")) == before


# ---- servers


def test_servers_listen_on_loopback_unless_told_otherwise():
    from sc3d.annotate.server import ADDRESS
    from sc3d.view.web.page import LOCAL

    assert (
        ADDRESS
        == LOCAL
        == {field.name: field.default for field in fields(ViewCommand)}["host"]
        == "127.0.0.1"
    )
