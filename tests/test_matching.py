"""Which photo pairs `sc3d reconstruct` matches."""

from dataclasses import replace

import cv2
import numpy as np
import pycolmap
import pytest
from PIL import Image

from sc3d import sfm
from sc3d.commands.run import list_stages
from sc3d.errors import InputError
from sc3d.georeferencing.geotags import Geotag
from sc3d.georeferencing.gps import Flight
from sc3d.runner import execute
from sc3d.scene.scene import Scene
from sc3d.settings.outputs import Run
from sc3d.settings.reconstruction import Mapping, Reconstruct
from sc3d.sfm import FEW, MATCH_ALL, choose_mapper, choose_matching, map_photos, num_pairs
from sc3d.stages import map_photos as map_photos_stage
from sc3d.stages import reconstruct
from sc3d.stages.reconstruct import prepare, steps
from sc3d.synthetic.exif import geodetic, photo_exif


def names(count):
    return [f"{row:03d}.jpg" for row in range(count)]


def flight(count, astray=()):
    places = geodetic(np.array([[10.0 * row, row % 7, 50.0] for row in range(count)]))
    tags = {name: Geotag(tuple(place)) for name, place in zip(names(count), places.tolist(), strict=True)}
    return Flight(tags, "area", tags["000.jpg"].geodetic, frozenset(astray))


def test_auto_matches_all_of_few_photos_and_neighbors_of_many():
    few, many = MATCH_ALL, MATCH_ALL + 1
    assert choose_matching("auto", names(few), flight(few)) == "exhaustive"
    assert choose_matching("auto", names(many), flight(many)) == "spatial"
    assert choose_matching("auto", names(many), None) == "vocabulary"
    # spatial would match photos without a place with no other
    assert choose_matching("auto", names(many), flight(few)) == "vocabulary"
    assert choose_matching("auto", names(many), flight(many, astray=["007.jpg"])) == "vocabulary"
    assert choose_matching("exhaustive", names(many), None) == "exhaustive"
    assert num_pairs(few, "auto") == num_pairs(few, "exhaustive")
    assert num_pairs(many, "auto") == num_pairs(many, "spatial")


def test_auto_maps_few_photos_in_turn_and_many_at_once():
    assert [choose_mapper("auto", count) for count in (2, FEW, FEW + 1)] == ["incremental"] * 2 + ["global"]
    assert choose_mapper("incremental", FEW + 1) == "incremental" and choose_mapper("global", 2) == "global"


@pytest.fixture
def photos(tmp_path):
    """Six photos of one plane in a row, one of them named with a blank, and one of elsewhere."""
    folder, rng = tmp_path / "photos", np.random.default_rng(0)
    folder.mkdir()
    noise = [rng.normal(128, 30, (side, 2 * side)).astype(np.float32) for side in (30, 120, 300)]
    ground = sum(cv2.resize(each, (600, 300), interpolation=cv2.INTER_CUBIC) for each in noise) / 3
    for row in range(6):
        pixels = ground[20:260, 55 * row : 55 * row + 320]
        file = folder / ("a photo 2.jpg" if row == 2 else f"{row}.jpg")
        Image.fromarray(np.clip(pixels, 0, 255).astype(np.uint8)).save(
            file, quality=95, exif=photo_exif(row, None)
        )
    return folder


def verified(database):
    with pycolmap.Database.open(database) as opened:
        found = {image.image_id: image.name for image in opened.read_all_images()}
        pairs, inliers = opened.read_two_view_geometry_num_inliers()
    rows = [pycolmap.pair_id_to_image_pair(pair) for pair in pairs]
    return {
        tuple(sorted((found[a], found[b]))): count
        for (a, b), count in zip(rows, inliers, strict=True)
        if count
    }


def test_vocabulary_matches_the_same_as_all_where_photos_are_few_whatever_they_are_called(photos, tmp_path):
    found, listed = {}, sorted(file.name for file in photos.iterdir())
    for matching in ("exhaustive", "vocabulary"):
        database = tmp_path / f"{matching}.db"
        settings = Mapping(matching=matching, max_features=800)
        sfm._extract(database, photos, listed, settings, photos, None)
        sfm._match(database, len(listed), settings)
        found[matching] = verified(database)
    assert found["vocabulary"] == found["exhaustive"]
    assert ("1.jpg", "a photo 2.jpg") in found["vocabulary"]


def test_only_the_pairs_of_the_list_are_matched(photos, tmp_path, monkeypatch):
    monkeypatch.setattr(sfm, "ALIKE", 0)
    monkeypatch.setattr(sfm, "IN_ORDER", 1)
    listed = sorted(file.name for file in photos.iterdir())
    settings = Mapping(matching="vocabulary", max_features=500)
    sfm._extract(tmp_path / "database.db", photos, listed, settings, photos, None)
    sfm._match(tmp_path / "database.db", len(listed), settings)
    found = verified(tmp_path / "database.db")
    assert found and set(found) <= {tuple(sorted(pair)) for pair in zip(listed, listed[1:])}


def test_finished_work_of_many_photos_is_kept(photos, tmp_path, monkeypatch):
    scene = Scene(tmp_path / "scene")
    settings = prepare(photos, scene, Reconstruct(matching="exhaustive"))
    monkeypatch.setattr(
        map_photos_stage, "run", lambda scene, settings: scene.mapped.mkdir(parents=True) or {"photos": 6}
    )
    execute("map_photos", scene, steps(settings)[0][1])
    for module in (sfm, reconstruct):
        monkeypatch.setattr(module, "MATCH_ALL", 4)
    assert prepare(photos, scene, Reconstruct()).matching == "exhaustive"
    assert prepare(photos, scene, Reconstruct(max_size=800)).matching == "vocabulary"
    assert prepare(photos, scene, Reconstruct(matching="sequential")).matching == "sequential"


def test_spatial_without_gps_is_refused_and_says_what_to_take(photos, tmp_path):
    with pytest.raises(InputError, match="auto"):
        map_photos(photos, ["0.jpg", "1.jpg"], tmp_path / "mapped", Mapping(matching="spatial"))


def test_work_is_known_by_what_auto_stands_for(photos, tmp_path, monkeypatch, caplog):
    scene = Scene(tmp_path / "scene")
    settings = prepare(photos, scene, Reconstruct())
    assert settings == replace(Reconstruct(), matching="exhaustive", mapper="incremental")
    assert {step.matching for _, step in steps(settings)} == {"exhaustive"}
    stages = dict(
        list_stages(Run(photos, scene.path, reconstruct=settings), scene, Run(photos, scene.path).segment)
    )
    assert stages["map_photos"] == Mapping()  # as of scenes from before there was auto
    for module in (sfm, reconstruct):
        monkeypatch.setattr(module, "MATCH_ALL", 4)
    with caplog.at_level("INFO"):
        assert prepare(photos, scene, Reconstruct()).matching == "vocabulary"
    assert "not all have GPS" in caplog.text
    prepare(photos, scene, Reconstruct(matching="exhaustive"))
    assert "--matching exhaustive compares 15 pairs" in caplog.text
