"""Photos that are linked, and pictures as addresses."""

import base64
import io

import numpy as np
import pytest
from PIL import Image

from sc3d.errors import InputError
from sc3d.io.images import data_uri, write_image
from sc3d.io.photo_folder import link_photos, require_place


def photos(path):
    for name in ("a.jpg", "sub/b.jpg"):
        write_image(path / name, np.zeros((8, 8, 3), np.uint8))
    return path


def test_photos_are_linked_once(tmp_path):
    source = photos(tmp_path / "source")
    for _ in range(2):  # again: nothing to do
        link_photos(source, tmp_path / "scene" / "images")
    assert (tmp_path / "scene" / "images").is_symlink()
    assert (tmp_path / "scene" / "images" / "sub" / "b.jpg").is_file()
    link_photos(source, source)
    assert not source.is_symlink() and len(list(source.rglob("*.jpg"))) == 2


def test_another_link_is_replaced_and_other_photos_are_kept(tmp_path):
    first, second = photos(tmp_path / "first"), photos(tmp_path / "second")
    link_photos(first, tmp_path / "images")
    link_photos(second, tmp_path / "images")
    assert (tmp_path / "images").resolve() == second
    for refusing in (require_place, link_photos):
        with pytest.raises(InputError, match="other photos"):
            refusing(first, second)
    assert not second.is_symlink()


@pytest.mark.parametrize("error", [OSError, NotImplementedError])
def test_photos_are_copied_where_links_are_not_possible(tmp_path, monkeypatch, error):
    def refuse(*_, **__):
        raise error

    monkeypatch.setattr("os.symlink", refuse)
    source = photos(tmp_path / "source")
    link_photos(source, tmp_path / "scene" / "images")
    copied = tmp_path / "scene" / "images"
    assert not copied.is_symlink()
    assert (copied / "sub" / "b.jpg").read_bytes() == (source / "sub" / "b.jpg").read_bytes()


@pytest.mark.parametrize(("suffix", "channels"), [(".png", 3), (".png", 4), (".jpg", 3)])
def test_an_address_holds_the_picture(suffix, channels):
    picture = np.zeros((16, 24, channels), np.uint8)
    picture[:, :, 0], picture[8:, :, 1], picture[..., 3:] = 250, 120, 128
    head, _, text = data_uri(picture, suffix).partition(",")
    with Image.open(io.BytesIO(base64.b64decode(text, validate=True))) as image:
        found = np.asarray(image)
        assert head == f"data:image/{image.format.lower()};base64"
    assert found.shape == picture.shape
    if suffix == ".png":
        np.testing.assert_array_equal(found, picture)
    else:
        assert np.abs(found.astype(int) - picture)[[2, 13]].max() < 12
