"""What `sc3d check` finds, and that it says nothing of photos that are all right."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from sc3d import cli
from sc3d.errors import InputError
from sc3d.georeferencing.geotags import Geotag, read_geotag
from sc3d.georeferencing.gps import Flight
from sc3d.io.images import read_image, read_small
from sc3d.preflight.appearance import exposure_of, sharpness_of
from sc3d.preflight.check import check_folder
from sc3d.preflight.classes import check_classes
from sc3d.preflight.coverage import coverage_of
from sc3d.preflight.looks import GRID, Look
from sc3d.preflight.overlap import overlap_of
from sc3d.preflight.pairs import Pair, groups
from sc3d.preflight.positions import jumps
from sc3d.report.sections import check_section, number_grid
from sc3d.scene.scene import Scene, SparseModel
from sc3d.synthetic.exif import geodetic, photo_exif
from tests.builders import ORIGIN, views, write_bare_scene, write_model

ANYWHERE = np.random.default_rng(1).uniform(0.02, 0.98, (200, 2))


def texture(size: int, seed: int) -> np.ndarray:
    """(size, size, 3) uint8 with structure of all scales, like ground."""
    rng, pixels = np.random.default_rng(seed), np.zeros((size, size, 3), np.float32)
    for side in (8, 32, 128, size // 2):
        noise = rng.normal(0, 1, (side, side, 3)).astype(np.float32)
        pixels += cv2.resize(noise, (size, size), interpolation=cv2.INTER_CUBIC)
    return np.clip(128 + 30 * pixels, 0, 255).astype(np.uint8)


def look(sharp: float = 0.0, bright: float = -1.0) -> Look:
    """Of a photo whose content says nothing: sharpness differs from place to place by more than photos do."""
    content = np.random.default_rng(0).normal(0, 0.5, (GRID, GRID))
    none = np.zeros((0, 2), np.float32)
    return Look((800, 600), none, none, content + sharp, content + bright, 0.0, 0.0)


def chain_of(count: int, reach: int = 3) -> list[Pair]:
    rows = [(row, row + step) for row in range(count) for step in range(1, reach + 1) if row + step < count]
    return [Pair(first, second, ANYWHERE, ANYWHERE) for first, second in rows]


def test_blur_is_found_beside_one_another_and_differences_of_content_are_none():
    sharp = np.random.default_rng(2).normal(0, 0.03, 20)
    sharp[[5, 6, 12]] += np.log(0.5)
    share, blurred = sharpness_of([look(value) for value in sharp], chain_of(20))
    assert np.flatnonzero(blurred).tolist() == [5, 6, 12]
    assert share[5] == pytest.approx(0.5, abs=0.06) and share[0] == pytest.approx(1, abs=0.1)
    assert not sharpness_of([look(value) for value in sharp[:5]], chain_of(5))[1].any()


def test_a_photo_without_a_pair_is_held_against_all_photos():
    looks = [look(value) for value in np.random.default_rng(3).normal(0, 0.05, 12)] + [look(np.log(0.3))]
    assert np.flatnonzero(sharpness_of(looks, chain_of(12))[1]).tolist() == [12]


def test_exposure_is_in_stops_against_the_others_and_small_drifts_are_none():
    stops = np.linspace(-0.5, 0.5, 20)
    stops[9] = -3
    found, wrong = exposure_of([look(bright=-1 + value) for value in stops], chain_of(20))
    assert np.flatnonzero(wrong).tolist() == [9]
    assert found[9] == pytest.approx(-3, abs=0.2)


def test_photos_hang_together_by_pairs():
    pairs = [Pair(*rows, ANYWHERE, ANYWHERE) for rows in ((0, 1), (3, 2), (1, 2), (5, 6))]
    assert sorted(groups(7, pairs), key=min) == [{0, 1, 2, 3}, {4}, {5, 6}]


def test_overlap_is_the_hull_of_what_both_show():
    y, x = np.mgrid[0.01:0.99:20j, 0.01:0.49:20j]
    left = np.stack([x.ravel(), y.ravel()], axis=1)
    found = overlap_of(3, [Pair(0, 1, left, left + (0.5, 0)), Pair(0, 2, left, left)])
    assert found.partners.tolist() == [2, 1, 1]
    assert found.best == pytest.approx([0.5, 0.5, 0.5], abs=0.05)
    assert found.covered == pytest.approx([0.5, 0, 0], abs=0.05)


def flight_of(places: np.ndarray) -> Flight:
    tags = {f"{row:02d}.jpg": Geotag(tuple(place)) for row, place in enumerate(geodetic(places).tolist())}
    return Flight(tags, "area", next(iter(tags.values())).geodetic)


STRIPS = np.array([[15.0 * (row % 6), 20.0 * (row // 6), 50.0] for row in range(24)])


@pytest.mark.parametrize("away", [(25.0, 0, 0), (0, 0, -20.0), (0, 300.0, 0)])
def test_a_jump_of_gps_is_found_against_cameras_of_any_frame(away):
    rng = np.random.default_rng(4)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    centers = {f"{row:02d}.jpg": 0.1 * turn @ place + 7 for row, place in enumerate(STRIPS)}
    places = STRIPS + rng.normal(0, 1, STRIPS.shape)
    offsets, wrong = jumps(flight_of(places), centers)
    assert not wrong and max(offsets.values()) < 6
    places[8] += away
    offsets, wrong = jumps(flight_of(places), centers)
    assert list(wrong) == ["08.jpg"]
    assert wrong["08.jpg"] == pytest.approx(np.linalg.norm(away), abs=5)


def test_without_cameras_steps_of_the_flight_tell_and_turns_are_none():
    places = STRIPS.copy()
    places[6:12, 0], places[18:, 0] = places[6:12, 0][::-1], places[18:, 0][::-1]
    assert jumps(flight_of(places), {}) == ({}, {})
    places[9] += (0, 120, 0)
    assert list(jumps(flight_of(places), {})[1]) == ["09.jpg"]
    assert not jumps(flight_of(np.random.default_rng(5).permutation(places)), {})[1]


def test_coverage_counts_photos_per_place_north_first():
    x, y = np.meshgrid(np.linspace(0, 32, 65), np.linspace(0, 16, 33))
    points = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    whole, west = np.arange(len(points)), np.flatnonzero(points[:, 0] < 16)
    south = np.flatnonzero(points[:, 1] < 8)
    found = coverage_of(SparseModel([], points, points, [whole, west, south]), points, True)
    assert found is not None and found.cell == pytest.approx(1, abs=0.05)
    assert (found.photos[2, 4], found.photos[2, -4], found.photos[-3, 4], found.photos[-3, -4]) == (
        2,
        1,
        3,
        2,
    )
    assert found.enough == pytest.approx(0.25, abs=0.05)
    assert set(found.text()) <= set("123\n")


@pytest.fixture
def scene(tmp_path):
    """Masks and cameras over a square, half road and half grass, with sparse points that all photos see."""
    scene = Scene(write_bare_scene(tmp_path / "scene"))
    x, y = np.meshgrid(np.linspace(-2, 2, 12), np.linspace(-2, 2, 12))
    points = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1) + ORIGIN
    rows = np.arange(len(points))
    scene.__dict__["model"] = SparseModel(views(), points, points, [rows] * len(views()))
    return scene


def test_masks_that_agree_are_not_weak_and_those_that_do_not_are(scene):
    road, grass = check_classes(scene)
    assert (road.name, road.photos, road.views, road.weakness) == ("road", 5, 5, "")
    assert road.agreement is not None and road.agreement > 0.97
    for view in views()[:2]:  # call all of it grass
        file = scene.masks / f"{Path(view.name).stem}.png"
        Image.fromarray(np.where(np.array(Image.open(file)), 3, 0).astype(np.uint8)).save(file)
    road, grass = check_classes(scene)
    assert road.agreement == pytest.approx(0.6, abs=0.02) and "many say grass" in road.weakness
    assert not grass.weakness
    for view in views()[2:]:
        (scene.masks / f"{Path(view.name).stem}.png").unlink()
    assert [each.weakness for each in check_classes(scene)] == ["in no mask", "in the masks of 2 photos only"]


def test_a_photo_is_read_small_as_it_would_be_large(tmp_path):
    pixels = texture(900, 0)[:600]
    Image.fromarray(pixels).save(tmp_path / "a.jpg", quality=95)
    Image.fromarray(pixels).save(tmp_path / "a.png")
    for name in ("a.jpg", "a.png"):
        small, size = read_small(tmp_path / name, 200)
        whole = cv2.resize(read_image(tmp_path / name), (200, 133), interpolation=cv2.INTER_AREA)
        assert size == (900, 600) and small.shape == whole.shape
        assert np.corrcoef(small.ravel(), whole.ravel())[0, 1] > 0.97
    assert read_small(tmp_path / "a.jpg", 2000)[0].shape == (600, 900, 3)


def photos(folder: Path, blurred: int | None = None, elsewhere: int | None = None) -> Path:
    """A flight of 3 x 3 photos over a plane, without GPS."""
    folder.mkdir(parents=True)
    ground, other = texture(900, 1), texture(320, 2)
    for row in range(9):
        top, left = 160 * (row // 3), 120 * (row % 3)
        pixels = ground[top : top + 320, left : left + 400]
        if row == blurred:
            pixels = cv2.GaussianBlur(pixels, (0, 0), 2)
        if row == elsewhere:
            pixels = cv2.resize(other, (400, 320))
        exif = photo_exif(row, None)
        Image.fromarray(pixels).save(folder / f"{row:02d}.jpg", quality=95, exif=exif)
    return folder


def test_good_photos_raise_no_alarm_and_missing_gps_is_no_problem(tmp_path):
    result = check_folder(photos(tmp_path / "photos"), None)
    assert result.ready and [finding.kind for finding in result.findings] == ["no-gps"]
    assert len(result.photos) == 9 and min(each.partners for each in result.photos.values()) >= 3


def test_a_blurred_photo_and_one_of_elsewhere_are_found_and_told(tmp_path, capsys):
    folder = photos(tmp_path / "photos", blurred=5, elsewhere=7)
    (folder / "09.jpg").write_bytes((folder / "00.jpg").read_bytes()[:5000])
    with pytest.raises(SystemExit) as ended:
        cli.main(["check", str(folder), "--json", str(tmp_path / "check.json")])
    assert ended.value.code == 1
    told = json.loads((tmp_path / "check.json").read_text())
    found = {each["kind"]: each["photos"] for each in told["findings"] if each["problem"]}
    assert found["blur"][0] == "05.jpg" and set(found["blur"]) <= {"05.jpg", "07.jpg"}
    assert found["unregistered"] == ["07.jpg"] and found["unreadable"] == ["09.jpg"]
    assert not told["ready"] and set(told["seconds"]) >= {"map_photos", "train", "report"}
    assert sorted(file.name for file in folder.parent.iterdir()) == ["check.json", "photos"]
    text = check_section(told)
    assert "Not ready" in text and "05.jpg" in text


def test_in_a_scene_photos_without_camera_and_cameras_without_photo_are_told(tmp_path):
    scene = Scene(tmp_path)
    folder = photos(scene.images)
    write_model(scene.sparse, views())
    (folder / "08.jpg").rename(folder / "PHOTO_0.JPG")  # the letter case of a view's name differs
    result = check_folder(folder, scene)
    found = {each.kind: each.photos for each in result.findings}
    assert found["missing"] == tuple(f"photo_{row}.jpg" for row in range(1, 5))
    assert found["unregistered"] == tuple(f"{row:02d}.jpg" for row in range(8))
    assert result.coverage is None


def test_photos_that_show_nothing_are_told_apart_from_those_that_do(tmp_path):
    for row in range(2):
        Image.fromarray(np.full((60, 80, 3), 120, np.uint8)).save(tmp_path / f"{row}.jpg")
    result = check_folder(tmp_path, None)
    assert not result.ready and result.findings[0].told == (
        "0.jpg (little texture)",
        "1.jpg (little texture)",
    )
    assert result.photos["0.jpg"].sharpness is None and json.dumps(result.as_json())
    clear = np.zeros((60, 80, 4), np.uint8)
    Image.fromarray(clear).save(tmp_path / "2.png")
    assert check_folder(tmp_path, None).findings[0].kind == "transparent"


def test_a_folder_without_photos_and_a_scene_without_them_are_refused(tmp_path, scene):
    for path, reason in ((tmp_path / "none", "is not a folder"), (scene.path, "images is missing")):
        with pytest.raises(SystemExit) as ended:
            cli.main(["check", str(path)])
        assert ended.value.code == 2, reason
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="no photos"):
        check_folder(tmp_path / "empty", None)


def test_a_report_takes_a_check_of_any_content():
    for content in ({}, {"findings": None}, {"findings": [1, {}], "coverage": {"photos": [[1], [2, 3]]}}):
        assert isinstance(check_section(content), str)
    assert number_grid([["a"]]) is None and number_grid([[1, 2], [0, 3]]) is not None
    html = check_section({"ready": True, "findings": [{"kind": "gps", "text": "<b>", "photos": ["<i>"]}]})
    assert "<b>" not in html and "<i>" not in html


@pytest.mark.slow
def test_three_planted_faults_in_the_photos_of_the_demo(tmp_path):
    cli.main(["synthesize", str(tmp_path / "site"), *"--views 24 --width 640 --num-points 1000".split()])
    folder = tmp_path / "site" / "images"
    assert check_folder(folder, None).ready
    pixels = {row: read_image(folder / f"view_{row:03d}.jpg") for row in (5, 11, 18)}
    tag = read_geotag(folder / "view_018.jpg")
    assert tag is not None
    jump = np.array(tag.geodetic) + (40 / 111_200, 0, 0)
    _save(folder / "view_005.jpg", cv2.GaussianBlur(pixels[5], (0, 0), 2))
    _save(folder / "view_011.jpg", cv2.resize(texture(640, 2), pixels[11].shape[1::-1]))
    _save(folder / "view_018.jpg", pixels[18], photo_exif(18, jump))
    result = check_folder(folder, None)
    found = {each.kind: each.photos for each in result.findings}
    assert found.pop("blur")[0] == "view_005.jpg"
    assert found == {"unregistered": ("view_011.jpg",), "gps": ("view_018.jpg",)}


def _save(file: Path, pixels: np.ndarray, exif: Image.Exif | None = None) -> None:
    """With the EXIF that the photo has, unless there is another."""
    kept = exif or Image.open(file).getexif()
    Image.fromarray(pixels).save(file, quality=95, exif=kept)


def test_photos_that_leave_too_few_are_named(tmp_path):
    for name in ("one.jpg", "two.jpg"):
        (tmp_path / name).write_text("none")
    with pytest.raises(InputError, match="2 of 2 cannot: one.jpg, two.jpg"):
        check_folder(tmp_path, None)
