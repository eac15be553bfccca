"""Models of other programs as people have them: several, partial, in foreign frames, with lenses and names
that are easily misread; right, refused in one line, or told with a number.
"""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pyproj
import pytest
from PIL import Image

from sc3d.errors import InputError
from sc3d.geometry.cameras import View
from sc3d.georeferencing.georeference import from_origin, read_georeference, write_georeference
from sc3d.georeferencing.gps import read_flight
from sc3d.importers.metashape import largest_correction
from sc3d.importers.photos import locate_photos
from sc3d.importers.project import Project, read_project
from sc3d.io.colmap import build_model, load_model
from sc3d.scene.scene import Scene
from sc3d.settings.reconstruction import Import
from sc3d.synthetic.exif import photo_exif
from tests.importers.test_importers import (
    PLACE,
    SIZE,
    fails,
    fly,
    metashape_lens,
    metashape_xml,
    opensfm_json,
    pix4d_text,
    probe,
    run,
    same_projections,
    write_photos,
)

SMALL = (64, 48)
BLANK = "2026-11-29 10-15-00 Straße {}.jpg"


def read(path: Path, images: Path | None = None, **settings) -> tuple[Project, Path | None]:
    settings = Import(images=images, **settings)
    return locate_photos(read_project(path, settings), images)


def small(views: list[View]) -> list[View]:
    return [view.resized(*SMALL) for view in views]


def names(project: Project) -> list[str]:
    return [view.name for view in project.views]


def rename(views: list[View], pattern: str) -> list[View]:
    return [replace(view, name=pattern.format(row)) for row, view in enumerate(views)]


def save_model(folder: Path, views: list[View], text: bool = False, points: int = 4) -> Path:
    """A COLMAP model whose views all see all points."""
    folder.mkdir(parents=True)
    xyz, rows = probe(points), np.arange(points)
    model = build_model(
        views, xyz, np.zeros((points, 3)), [(rows, rows[:, None] + [[1.0, 2.0]])] * len(views)
    )
    (model.write_text if text else model.write_binary)(str(folder))
    return folder


def transforms(folder: Path, views: list[View], name: str = "transforms.json", **top) -> Path:
    """A transforms.json in which all lens values are at the top; `top`: these, None = not stated."""
    stated = {"w": SMALL[0], "h": SMALL[1], "fl_x": 50.0} | top
    frames = []
    for view in views:
        matrix = np.linalg.inv(view.cam_from_world) * [1, -1, -1, 1]
        frames.append({"file_path": view.name, "transform_matrix": matrix.tolist()})
    folder.mkdir(parents=True, exist_ok=True)
    content = {key: value for key, value in stated.items() if value is not None} | {"frames": frames}
    (folder / name).write_text(json.dumps(content))
    return folder / name


def change(file: Path, edit) -> Path:
    content = json.loads(file.read_text())
    edit(content)
    file.write_text(json.dumps(content))
    return file


def warning(caplog) -> str:
    """The one warning."""
    (record,) = [record for record in caplog.records if record.levelname == "WARNING"]
    return record.getMessage()


class TestSeveralModels:
    @pytest.mark.parametrize(
        "places",
        [
            ("sparse/0", "sparse/1"),
            ("sparse", "sparse_txt"),
            ("sparse", "dense/sparse"),
            ("sparse/0", "dense/0/sparse"),
            ("0", "1"),
            ("sparse/10", "sparse/2"),
        ],
    )
    def test_colmap_model_with_most_photos(self, tmp_path, caplog, places):
        views = fly(count=8)
        save_model(tmp_path / places[0], views[:3], text=True)
        save_model(tmp_path / places[1], views[2:])
        project, _ = read(tmp_path)
        assert names(project) == names(Project("", views[2:]))
        told = warning(caplog)
        assert f"{places[1]}, with 6 photos" in told and f"{places[0]} (3 photos)" in told
        assert "2 are not in it (shot_0.jpg, shot_1.jpg)" in told

    def test_photos_of_the_model_that_is_read(self, tmp_path):
        """Undistorted photos lie beside their own model; the original ones are taken if both have all."""
        for place in ("sparse/0", "dense/sparse"):
            save_model(tmp_path / place, small(fly()))
            write_photos(tmp_path / Path(place).parts[0].replace("sparse", ".") / "images", small(fly()))
        assert read(tmp_path)[1] == tmp_path / "images"
        assert read(tmp_path / "dense")[1] == tmp_path / "dense" / "images"

    def test_copy_of_a_model_is_no_warning_and_a_damaged_one_in_nobodys_way(self, tmp_path, caplog):
        save_model(tmp_path / "sparse" / "0", fly())
        save_model(tmp_path / "sparse_txt", fly(), text=True)
        assert len(read(tmp_path)[0].views) == 6 and not [
            record for record in caplog.records if record.levelname == "WARNING"
        ]
        file = tmp_path / "sparse" / "0" / "images.bin"
        file.write_bytes(file.read_bytes()[:99])
        assert read(tmp_path)[0].notes["read"].endswith("sparse_txt")

    def test_all_models_damaged(self, tmp_path):
        for number in "01":
            folder = save_model(tmp_path / "sparse" / number, fly())
            (folder / "images.bin").write_bytes(b"\xff" * 30)
        with pytest.raises(InputError, match="damaged"):
            read(tmp_path)

    def test_opensfm(self, tmp_path, caplog):
        parts = opensfm_json(fly(count=6), probe(3), None)
        other = opensfm_json(rename(fly(count=4), "other_{}.jpg"), probe(3), None)[1]
        (tmp_path / "reconstruction.json").write_text(json.dumps([other, *parts]))
        assert len(read(tmp_path)[0].views) == 6
        assert "those of 4, 0 photos, of which 4 are not in it (other_0.jpg" in warning(caplog)

    def test_metashape_chunks(self, tmp_path, caplog):
        one, two = (metashape_xml(rename(fly(count=count), "s{}.jpg"), metashape_lens()) for count in (2, 5))
        chunk = two[two.index("<chunk") : two.index("</document>")]
        (tmp_path / "a.xml").write_text(one.replace("</document>", f"{chunk}</document>"))
        project, _ = read(tmp_path / "a.xml")
        assert len(project.views) == 5
        assert "2 chunks: 'Chunk 1', with most placed photos (5)" in warning(caplog)

    def test_pix4d_and_blender_say_what_is_not_read(self, tmp_path, caplog):
        for count, name in ((1, "a"), (3, "b")):
            (tmp_path / f"{name}_calibrated_camera_parameters.txt").write_text(pix4d_text(fly(count=count)))
        assert len(read(tmp_path)[0].views) == 3 and "left out: a_cal" in warning(caplog)
        caplog.clear()
        for part in ("train", "test"):
            transforms(tmp_path / "nerf", rename(fly(), "./train/r_{}"), f"transforms_{part}.json")
        assert len(read(tmp_path / "nerf")[0].views) == 6
        assert "only transforms_train.json is read" in warning(caplog)

    def test_scene_of_our_own(self, tmp_path, caplog):
        save_model(tmp_path / "sparse" / "0", fly(count=2))
        save_model(tmp_path / "sparse" / "1", fly(count=5))
        assert len(Scene(tmp_path).model.views) == 2
        assert "sparse/0 has 2 photos, but the model beside it" in warning(caplog)
        caplog.clear()
        assert len(read(tmp_path / "sparse" / "0")[0].views) == 2
        assert "sparse/0 has 2 photos, but the model beside it" in warning(caplog)
        caplog.clear()
        write_georeference(Scene(tmp_path), from_origin(PLACE))  # is that of sparse/0
        project, _ = read(tmp_path)
        assert len(project.views) == 2 and project.georeference == from_origin(PLACE)
        assert "the model beside it" in warning(caplog)
        with pytest.raises(InputError, match="move its files there"):
            load_model(save_model(tmp_path / "other" / "sparse", fly()) / "0")


class TestNames:
    def check(self, project: Project, folder: Path | None, views: list[View]) -> None:
        assert names(project) == names(Project("", views)) and folder is not None
        assert all((folder / name).is_file() for name in names(project))

    @pytest.mark.parametrize("ending", ["\n", "\r\n"])
    @pytest.mark.parametrize("mark", [b"", b"\xef\xbb\xbf"])
    def test_colmap_text(self, tmp_path, ending, mark):
        views = rename(small(fly()), f"100 MEDIA/{BLANK}")
        for file in save_model(tmp_path / "model", views, text=True).iterdir():
            file.write_bytes(mark + file.read_bytes().replace(b"\n", ending.encode()))
        self.check(*read(tmp_path / "model", write_photos(tmp_path / "photos", views)), views)

    def test_colmap_text_of_our_own(self, tmp_path, caplog):
        views = rename(small(fly()), BLANK)
        save_model(tmp_path / "scene" / "sparse" / "0", views)
        write_photos(tmp_path / "scene" / "images", views)
        run("export", tmp_path / "scene", "--format", "colmap-text")
        assert "6 of 6 photo names have blanks" in caplog.text
        text = tmp_path / "scene" / "export" / "colmap-text"
        run("import", text, tmp_path / "other", "--images", tmp_path / "scene" / "images")
        model = Scene(tmp_path / "other").model
        assert [view.name for view in model.views] == names(Project("", views))
        assert same_projections(model.views, views, probe()) < 1e-6

    @pytest.mark.parametrize("pattern", [BLANK, "a.b.c {}.jpg", "Brücke {}.JPG", "日本 {}.jpg"])
    def test_other_programs(self, tmp_path, pattern):
        views = rename(small(fly(count=3)), pattern)
        folder = write_photos(tmp_path / "photos", views)
        large = rename(fly(count=3), pattern)
        (tmp_path / "a.xml").write_text(metashape_xml(large, metashape_lens()))
        (tmp_path / "a_calibrated_camera_parameters.txt").write_text(pix4d_text(large))
        (tmp_path / "reconstruction.json").write_text(json.dumps(opensfm_json(large, probe(3), None)))
        transforms(tmp_path, rename(views, f"./somewhere/{pattern}"))
        save_model(tmp_path / "sparse", views)
        for file in ("a.xml", "a_calibrated_camera_parameters.txt", "reconstruction.json", "transforms.json"):
            self.check(*read(tmp_path / file, folder), views)
        self.check(*read(tmp_path, folder, source="colmap"), views)

    def test_text_of_windows(self, tmp_path):
        """Pix4D writes the code page of its machine."""
        views = rename(fly(count=2), "Brücke {}.jpg")
        (tmp_path / "a_calibrated_camera_parameters.txt").write_bytes(pix4d_text(views).encode("cp1252"))
        self.check(*read(tmp_path, write_photos(tmp_path / "photos", small(views))), views)

    def test_decomposed_letters_and_case(self, tmp_path):
        views = rename(small(fly(count=2)), "bru\u0308cke_{}.jpg")
        folder = write_photos(tmp_path / "photos", rename(views, "Br\u00fccke_{}.JPG"))
        self.check(*read(transforms(tmp_path, views), folder), rename(views, "Br\u00fccke_{}.JPG"))

    @pytest.mark.parametrize("root", ["", "C:\\project\\", "..\\", ".\\", "\\\\server\\share\\"])
    def test_backslashes(self, tmp_path, root):
        views = rename(small(fly(count=2)), "{}.jpg")
        folder = write_photos(tmp_path / "images", rename(views, "10{}MEDIA/DJI.jpg"))
        for row in range(2):  # the same name would be ambiguous without its folder
            (folder / f"10{row}MEDIA" / "DJI.jpg").rename(folder / f"10{row}MEDIA" / f"DJI_{row}.jpg")
        file = transforms(tmp_path, views)
        change(
            file,
            lambda content: [
                frame.update(file_path=f"{root}images\\10{row}MEDIA\\DJI_{row}.jpg")
                for row, frame in enumerate(content["frames"])
            ],
        )
        self.check(*read(file), rename(views, "10{0}MEDIA/DJI_{0}.jpg"))

    def test_byte_order_marks(self, tmp_path):
        views = rename(small(fly(count=2)), "a_{}.jpg")
        folder = write_photos(tmp_path / "photos", views)
        file = transforms(tmp_path, views)
        file.write_bytes(b"\xef\xbb\xbf" + file.read_bytes())
        self.check(*read(file, folder), views)
        xml = metashape_xml(rename(fly(count=2), "a_{}.jpg"), metashape_lens())
        for number, content in enumerate(
            [b"\xef\xbb\xbf" + xml.encode(), xml.replace("UTF-8", "UTF-16").encode("utf-16")]
        ):
            (tmp_path / f"{number}.xml").write_bytes(content)
            self.check(*read(tmp_path / f"{number}.xml", folder), views)

    def test_folders_stay_where_no_photos_are_found(self, tmp_path):
        views = rename(small(fly(count=2)), "10{}MEDIA/a.jpg")
        assert names(read(save_model(tmp_path / "model", views))[0]) == names(Project("", views))
        file = transforms(tmp_path, rename(views, "images/10{}MEDIA/a.jpg"))
        assert names(read(file)[0]) == names(Project("", views))


class TestPhotos:
    def test_some_are_gone(self, tmp_path, capsys, caplog):
        """The rest comes in, with its points and tracks."""
        views = rename(small(fly()), "{}.jpg")
        save_model(tmp_path / "sparse" / "0", views)
        extra = replace(views[0], name="never_aligned.jpg")
        write_photos(tmp_path / "images", [*views[:4], extra])
        run("import", tmp_path, tmp_path / "scene")
        model = Scene(tmp_path / "scene").model
        assert [view.name for view in model.views] == [f"{row}.jpg" for row in range(4)]
        assert len(model.points) == 4 and [len(track) for track in model.tracks] == 4 * [4]
        assert same_projections(model.views, views[:4], probe()) < 1e-6
        assert "2 of 6 photos left out: 2 not in " in caplog.text and "(4.jpg, 5.jpg)" in caplog.text
        record = json.loads((tmp_path / "scene" / "sparse" / "0.json").read_text())
        assert sum(record["summary"]["left_out"].values()) == 2
        assert record["summary"]["photos_without_camera"] == "1 (never_aligned.jpg)"

    @pytest.mark.parametrize("kind", ["transforms", "opensfm", "pix4d", "metashape"])
    def test_some_are_gone_in_every_program(self, tmp_path, kind):
        views = fly(count=4)
        file = {
            "transforms": lambda: transforms(tmp_path, views),
            "opensfm": lambda: tmp_path / "reconstruction.json",
            "pix4d": lambda: tmp_path / "a_calibrated_camera_parameters.txt",
            "metashape": lambda: tmp_path / "a.xml",
        }[kind]()
        content = {
            "opensfm": lambda: json.dumps(opensfm_json(views, probe(3), None)),
            "pix4d": lambda: pix4d_text(views),
            "metashape": lambda: metashape_xml(views, metashape_lens()),
        }
        if kind in content:
            file.write_text(content[kind]())
        photos = write_photos(tmp_path / "photos", small(views[:3]))
        project, _ = read(file, photos)
        assert names(project) == [f"shot_{row}.jpg" for row in range(3)]
        assert project.left_out[f"not in {photos}"] == ["shot_3" if kind == "metashape" else "shot_3.jpg"]
        (photos / "shot_0.jpg").rename(photos / "other.jpg")
        for name in ("shot_1.jpg", "shot_2.jpg"):
            (photos / name).unlink()
        with pytest.raises(InputError, match="none of the 4 photos"):
            read(file, photos)

    @pytest.mark.parametrize("kind", ["colmap", "transforms"])
    def test_photos_of_one_of_two_folders(self, tmp_path, kind):
        """Cameras count photos anew: the name of the folder given tells which of two are meant."""
        views = [
            replace(view, name=f"{'ab'[row % 2]}/DJI_{row // 2}.JPG") for row, view in enumerate(small(fly()))
        ]
        folder = write_photos(tmp_path / "shots", views)
        path = save_model(tmp_path / "m", views) if kind == "colmap" else transforms(tmp_path / "m", views)
        project, found = read(path, folder / "a")
        assert names(project) == ["DJI_0.JPG", "DJI_1.JPG", "DJI_2.JPG"] and found == folder / "a"
        np.testing.assert_allclose(
            [view.center for view in project.views], [view.center for view in views[::2]], atol=1e-9
        )

    def test_no_photo_is_left(self, tmp_path):
        views = [
            replace(view, name=f"{'ab'[row % 2]}/DJI_{row // 2}.JPG") for row, view in enumerate(small(fly()))
        ]
        photos = write_photos(tmp_path / "c", rename(views[:3], "DJI_{}.JPG"))
        with pytest.raises(InputError, match="no photo is left: 6 that share a photo"):
            read(save_model(tmp_path / "m", views), photos)

    def test_images_that_are_no_folder(self, tmp_path):
        with pytest.raises(InputError, match="is not a folder"):
            read(transforms(tmp_path, fly()), tmp_path / "nothing")

    @pytest.mark.parametrize(
        "path", ["/etc/passwd", "../../secret/shot_1.jpg", "images/../../../x/shot_1.jpg"]
    )
    def test_path_that_leads_out(self, tmp_path, path):
        views = rename(small(fly()), "images/shot_{}.jpg")
        folder = write_photos(tmp_path / "project", views) / "images"
        file = transforms(tmp_path / "project", views)
        change(file, lambda content: content["frames"][2].update(file_path=path))
        project, found = read(file)
        assert found == folder and len(project.views) == 5
        assert [len(value) for value in project.left_out.values()] == [1]
        assert "leads out of the project" in next(iter(project.left_out))

    def test_points_that_lead_out(self, tmp_path, caplog):
        for outside in (tmp_path / "secret.ply", "../secret.ply", "..\\secret.ply"):
            (tmp_path / "secret.ply").write_bytes(
                b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\nend_header\n0 0 0\n"
            )
            caplog.clear()
            views = rename(fly(), "images/{}.jpg")
            file = transforms(tmp_path / "project", views, ply_file_path=str(outside))
            assert not len(read(file)[0].points) and "leads out of the project" in warning(caplog)

    def test_names_that_act_on_terminals(self, tmp_path, caplog):
        views = rename(small(fly(count=3)), "a_{}.jpg")
        write_photos(tmp_path / "photos", views[:2])
        views[2] = replace(views[2], name="\x1b[2Jx\n.jpg")
        run("import", transforms(tmp_path, views), tmp_path / "scene", "--images", tmp_path / "photos")
        told = next(record.getMessage() for record in caplog.records if "left out" in record.getMessage())
        assert told.isprintable() and "1 of 3 photos" in told

    @pytest.mark.parametrize("root", ["/home/somebody/project/", "C:/Users/somebody/project/"])
    def test_project_that_was_moved(self, tmp_path, root):
        """All paths are absolute, of another machine."""
        views = rename(small(fly()), "images/shot_{}.jpg")
        write_photos(tmp_path, views)
        project, folder = read(transforms(tmp_path, rename(views, root + "images/shot_{}.jpg")))
        assert folder == tmp_path / "images" and names(project) == [f"shot_{row}.jpg" for row in range(6)]

    def test_two_cameras_of_one_photo(self, tmp_path):
        """Which of them is right is not to be guessed, unless one names it exactly."""
        views = rename(small(fly(count=4)), "s_{}.jpg")
        write_photos(tmp_path, views)
        views[1] = replace(views[1], name="s_0.jpg")
        views[3] = replace(views[3], name="other/s_2.jpg")
        project, _ = read(transforms(tmp_path, views))
        assert names(project) == ["s_2.jpg"]
        assert [len(value) for value in project.left_out.values()] == [3]

    def test_no_size_is_stated(self, tmp_path):
        views = rename(small(fly(count=3)), "./train/r_{}")
        photos = write_photos(tmp_path / "elsewhere", rename(views, "deep/r_{}.png"))
        file = transforms(tmp_path, views, w=None, h=None, fl_x=None, camera_angle_x=0.69)
        for project, folder in (read(file, photos), read_beside(tmp_path, file, views)):
            camera = project.views[0].camera
            assert (camera.width, camera.height) == SMALL and folder is not None
            assert camera.params[0] == pytest.approx(32 / np.tan(0.345))
        (photos / "deep" / "r_1.png").unlink()
        project, _ = read(file, photos)
        assert len(project.views) == 2 and [len(value) for value in project.left_out.values()] == [1]
        for row in range(3):
            (tmp_path / "train" / f"r_{row}.png").unlink()
        with pytest.raises(InputError, match="no photos in"):
            read(file)
        (tmp_path / "train").rmdir()
        with pytest.raises(InputError, match="no w and h"):
            read(file)


def read_beside(folder: Path, file: Path, views: list[View]) -> tuple[Project, Path | None]:
    write_photos(folder, [replace(view, name=f"{view.name}.png") for view in views])
    return read(file)


class TestLenses:
    K = {"k1": 0.05, "k2": -0.01, "k3": 0.002, "k4": -0.0005}

    def camera(self, folder: Path, edit=lambda content: None, **top) -> pycolmap.Camera:
        views = rename(fly(), "images/shot_{}.jpg")
        return read(change(transforms(folder, views, **top), edit))[0].views[0].camera

    def test_fisheye_of_instant_ngp(self, tmp_path):
        expected = pycolmap.Camera(
            model="OPENCV_FISHEYE", width=64, height=48, params=[50, 50, 32, 24, 0.05, -0.01, 0.002, -0.0005]
        )
        corner = np.array([[0.6, 0.5, 1.0]])
        everywhere = [
            self.camera(tmp_path, is_fisheye=True, p1=0, p2=0, **self.K),
            self.camera(tmp_path, lambda content: content["frames"][0].update(self.K, is_fisheye=True)),
            self.camera(tmp_path, camera_model="OPENCV_FISHEYE", **self.K),
            self.camera(tmp_path, camera_model="RADIAL_FISHEYE", **self.K),
        ]
        for camera in everywhere:
            np.testing.assert_allclose(camera.img_from_cam(corner), expected.img_from_cam(corner))
        assert self.camera(tmp_path, is_fisheye=False, k1=0.05).model_name == "OPENCV"
        with pytest.raises(InputError, match="p1 and p2 of a fisheye"):
            self.camera(tmp_path, is_fisheye=True, p1=0.1, **self.K)

    @pytest.mark.parametrize(
        "top, word",
        [
            ({"camera_model": "EQUIRECTANGULAR"}, "EQUIRECTANGULAR"),
            ({"camera_model": "FULL_OPENCV"}, "FULL_OPENCV"),
            ({"equirectangular": True}, "equirectangular"),
            ({"latlong": True}, "latlong"),
            ({"orthographic": True}, "orthographic"),
            ({"ftheta_p0": 0.1}, "ftheta_p0"),
            ({"k5": 0.1}, "k5"),
            ({"is_fisheye": True, "camera_model": "OPENCV"}, "contradict"),
            ({"is_fisheye": "yes"}, "no number"),
            ({"w": 64.5}, "whole"),
        ],
    )
    def test_lenses_without_a_model(self, tmp_path, top, word):
        with pytest.raises(InputError, match=word):
            self.camera(tmp_path, **top)

    def test_values_of_single_frames(self, tmp_path, caplog):
        """nerfstudio counts those at the top, instant-ngp those of the frame."""
        own = lambda content: content["frames"][0].update(fl_x=70.0)
        assert self.camera(tmp_path, own, aabb_scale=16).params[0] == 70.0 and not caplog.records
        assert self.camera(tmp_path, own, camera_model="OPENCV").params[0] == 50.0
        assert "1 of 6 frames differ from those at the top" in warning(caplog)
        assert self.camera(tmp_path, own, fl_x=None, camera_angle_x=1.0).params[0] == 70.0

    def test_rolling_shutter(self, tmp_path, caplog):
        self.camera(tmp_path, rolling_shutter=[0, 0, 1])
        assert "rolling shutter" in warning(caplog)

    def test_spherical_camera_of_colmap(self, tmp_path):
        camera = pycolmap.Camera(model="EQUIRECTANGULAR", width=200, height=100, params=[200, 100])
        views = [replace(view, camera=camera) for view in fly()]
        with pytest.raises(InputError, match="spherical"):
            read(save_model(tmp_path / "model", views))

    def test_spherical_cameras_among_others_of_opensfm(self, tmp_path, caplog):
        content = opensfm_json(fly(), probe(3), None)
        content[1]["cameras"]["360"] = {"projection_type": "spherical", "width": 200, "height": 100}
        content[1]["cameras"]["unused"] = {"projection_type": "dual"}
        content[1]["shots"]["shot_2.jpg"]["camera"] = "360"
        (tmp_path / "reconstruction.json").write_text(json.dumps(content))
        project, _ = read(tmp_path)
        assert len(project.views) == 5 and list(project.left_out.values()) == [["shot_2.jpg"]]
        assert "'spherical' has no COLMAP model" in next(iter(project.left_out))

    def test_dual_lens_of_opensfm(self, tmp_path):
        content = opensfm_json(fly(), probe(3), None)
        content[1]["cameras"]["v2 dji"]["projection_type"] = "dual"
        (tmp_path / "reconstruction.json").write_text(json.dumps(content))
        with pytest.raises(InputError, match="'dual' has no COLMAP model"):
            read(tmp_path)

    def test_distortion_of_four_values(self, tmp_path):
        """k1 to k4 of a fisheye; for others it may be k1 k2 p1 p2 as well."""
        values = [0.01, 0.002, 0.0, 0.0]
        file = transforms(tmp_path, small(fly()), distortion_params=values)
        with pytest.raises(InputError, match="other than 6 values"):
            read(file, write_photos(tmp_path / "p", small(fly())))
        change(file, lambda content: content.update(camera_model="OPENCV_FISHEYE"))
        assert read(file, tmp_path / "p")[0].views[0].camera.params[4:6].tolist() == values[:2]


class TestMetashape:
    def write(self, folder: Path, *edits: tuple[str, str]) -> Path:
        content = metashape_xml(fly(), metashape_lens())
        for old, new in edits:
            assert old in content
            content = content.replace(old, new, 1)
        (folder / "cameras.xml").write_text(content)
        return folder / "cameras.xml"

    def corrections(self, value: float) -> tuple[str, str]:
        coefficients = " ".join(map(str, value * np.random.default_rng(0).normal(size=96)))
        return "<k1>", f'<corrections type="fourier"><coeffs>{coefficients}</coeffs></corrections><k1>'

    def test_additional_corrections(self, tmp_path, caplog):
        read(self.write(tmp_path, self.corrections(0.0)))
        assert not caplog.records
        read(self.write(tmp_path, self.corrections(0.01)))
        assert "additional corrections (up to 0." in warning(caplog)
        with pytest.raises(InputError, match=r"additional corrections \(17 px\), more than 1 px"):
            read(self.write(tmp_path, self.corrections(1.0)))
        read(self.write(tmp_path, self.corrections(1.0)), tolerance=50.0)

    def test_largest_correction_is_that_of_the_series(self):
        pairs = np.zeros((48, 2))
        pairs[1] = 0.3, 0.4  # one wave
        assert largest_correction(pairs) == pytest.approx(0.5)
        pairs[5] = 0.4, -0.3  # its sine
        assert largest_correction(pairs) == pytest.approx(0.5)
        assert largest_correction(np.full((48, 2), 0.5)) > 17  # 24 cosines of both at the middle
        assert largest_correction(np.full((7, 2), 0.5)) == pytest.approx(3.5 * np.sqrt(2))  # unknown: bound

    @pytest.mark.parametrize(
        "term, word",
        [("<b2>-0.3</b2>", "skew"), ("<p3>0.1</p3>", "p3 and p4"), ("<skew>-0.3</skew>", "skew")],
    )
    def test_small_terms_are_left_out_with_a_figure(self, tmp_path, caplog, term, word):
        project, _ = read(self.write(tmp_path, ("<k1>", f"{term}<k1>")))
        assert len(project.views) == 6
        assert f"{word} (up to 0.1" in warning(caplog) and "1 of 1 lenses" in warning(caplog)

    def test_every_camera_that_is_left_out_is_counted(self, tmp_path, capsys, caplog):
        master = '<camera id="9" sensor_id="0" label="slave" master_id="0"/></group>'
        file = self.write(
            tmp_path,
            ("</group>", master),
            ('<camera id="1" ', '<camera id="1" enabled="false" '),
            (
                '<camera id="2" sensor_id="0" component_id="0"',
                '<camera id="2" sensor_id="0" component_id="7"',
            ),
            ('<camera id="3" sensor_id="0"', '<camera id="3" sensor_id="5"'),
            ('<camera id="4" sensor_id="0"', '<camera id="4" sensor_id="6"'),
            (
                "</sensors>",
                '<sensor id="5" label="360" type="spherical"/><sensor id="6" label="x"/></sensors>',
            ),
        )
        run("import", file, tmp_path / "scene")
        told = next(record.getMessage() for record in caplog.records if "left out" in record.getMessage())
        assert "6 of 8 photos left out" in told and len(Scene(tmp_path / "scene").model.views) == 2
        for part in (
            "1 disabled (shot_1)",
            "1 of a rig but for its master, without a pose of their own (slave)",
            "1 without a position, as they are not aligned (unaligned)",
            "1 of other components, which nothing places to the others (shot_2)",
            "spherical sensors have no COLMAP model) (shot_3)",
            "1 without a calibrated sensor (shot_4)",
        ):
            assert part in told, told

    def test_components_that_each_have_a_transform(self, tmp_path, caplog):
        component = "<component id='7'><transform><scale>2</scale></transform></component></components>"
        project, _ = read(
            self.write(
                tmp_path,
                ('label="Component 1">', 'label="Component 1"><transform><scale>1</scale></transform>'),
                ("</components>", component),
                (
                    '<camera id="2" sensor_id="0" component_id="0"',
                    '<camera id="2" sensor_id="0" component_id="7"',
                ),
            )
        )
        assert len(project.views) == 6 and "2 components are read as of one frame" in warning(caplog)

    def test_none_is_aligned(self, tmp_path, capsys):
        content = metashape_xml(fly(), metashape_lens())
        while "<transform>" in content:
            start = content.index("<transform>")
            content = content[:start] + content[content.index("</transform>") + len("</transform>") :]
        (tmp_path / "a.xml").write_text(content)
        told = fails(capsys, "import", tmp_path / "a.xml", tmp_path / "scene")
        assert "7 without a position, as they are not aligned (shot_0, shot_1, shot_2 and 4 more)" in told

    def test_rolling_shutter(self, tmp_path, caplog):
        read(
            self.write(
                tmp_path,
                ('<property name="pix', '<property name="rolling_shutter" value="full"/><property name="pix'),
            )
        )
        assert "6 of 6 photos have a rolling shutter" in warning(caplog)


class TestFrames:
    def test_gps_of_all_of_two_photos(self, tmp_path, caplog):
        """All have it, and still it is too little: it says how many are needed."""
        for row in range(2):
            exif = photo_exif(row, np.array([-37.8, 144.96 + row / 1e4, 50.0]))
            Image.new("RGB", SMALL).save(tmp_path / f"{row}.jpg", exif=exif)
        with caplog.at_level("WARNING"):
            assert read_flight(tmp_path, ["0.jpg", "1.jpg"]) is None
        assert "2 of 2 photos have GPS, 3 are needed" in caplog.text and "only 2 of 2" not in caplog.text

    def opensfm(self, folder: Path, reference: tuple, **shot) -> Project:
        content = opensfm_json(fly(), probe(3), reference)
        for view in content[1]["shots"].values():
            view.update(shot)
        (folder / "reconstruction.json").write_text(json.dumps(content))
        return read(folder)[0]

    def test_opensfm_without_gps(self, tmp_path, caplog):
        nothing = {"gps_dop": 999999.0, "gps_position": [0.0, 0.0, 0.0]}
        assert self.opensfm(tmp_path, (0.0, 0.0, 0.0), **nothing).georeference is None
        assert "have no GPS" in caplog.text
        assert self.opensfm(tmp_path, (0.0, 0.0, 0.0), gps_position=None).georeference is None
        # a place given otherwise, as by control points
        assert self.opensfm(tmp_path, PLACE, **nothing).georeference.epsg == 32615

    def test_flight_in_the_gulf_of_guinea(self, tmp_path):
        for place in ((0.0, 0.0, 30.0), (0.0003, -0.0002, 30.0)):
            found = self.opensfm(tmp_path, place, gps_dop=5.0).georeference
            assert found is not None and found.epsg in (32630, 32631)

    @pytest.mark.parametrize("mark", ["", "\ufeff"])
    def test_local_coordinates_of_pix4d(self, tmp_path, caplog, mark):
        (tmp_path / "a_calibrated_camera_parameters.txt").write_text(pix4d_text(fly()))
        (tmp_path / "a_wkt.prj").write_text(
            f'{mark}LOCAL_CS["Local Coordinates (m)",LOCAL_DATUM["Local Datum",0],UNIT["metre",1]]'
        )
        assert read(tmp_path)[0].georeference is None
        assert "local coordinates" in warning(caplog)

    def test_pix4d_without_its_offset(self, tmp_path, caplog):
        (tmp_path / "a_calibrated_camera_parameters.txt").write_text(pix4d_text(fly()))
        (tmp_path / "a_wkt.prj").write_text(pyproj.CRS.from_epsg(32615).to_wkt("WKT1_ESRI"))
        assert read(tmp_path)[0].georeference is None
        assert "a_offset.xyz is missing" in warning(caplog)
        large = [view.shifted(-np.array([576000.0, 5188000.0, 200.0])) for view in fly()]
        (tmp_path / "a_calibrated_camera_parameters.txt").write_text(pix4d_text(large))
        project, _ = read(tmp_path)
        assert project.georeference is not None and np.abs(project.views[0].center).max() < 1000
        np.testing.assert_allclose(
            project.georeference.to_crs(project.views[0].center[None])[0], large[0].center, atol=1e-6
        )

    @pytest.mark.parametrize("kind", ["colmap", "metashape"])
    def test_geocentric_coordinates_without_a_crs(self, tmp_path, caplog, kind):
        """As COLMAP's model_aligner writes them, and Metashape where the reference is left out."""
        views, points = fly(), probe(4)
        geodesy = pycolmap.GPSTransform()

        def ecef(enu: np.ndarray) -> np.ndarray:
            geodetic = np.asarray(geodesy.enu_to_ellipsoid(np.atleast_2d(enu), *PLACE))
            return np.asarray(geodesy.ellipsoid_to_ecef(geodetic))

        zero = ecef(np.zeros(3))[0]
        left, _, right = np.linalg.svd((ecef(np.eye(3)) - zero).T)
        moved = []
        for view in views:
            pose = np.eye(4)
            pose[:3, :3] = view.cam_from_world[:3, :3] @ (left @ right).T
            pose[:3, 3] = -pose[:3, :3] @ ecef(view.center)[0]
            moved.append(replace(view, cam_from_world=pose))
        if kind == "metashape":
            file = tmp_path / "a.xml"
            file.write_text(metashape_xml(moved, metashape_lens(), transform=(np.eye(3), zero, 1.0)))
        else:
            file = tmp_path / "model"
            file.mkdir()
            rows = np.arange(4)
            seen = [(rows, rows[:, None] + [[1.0, 2.0]])] * len(views)
            build_model(moved, ecef(points), np.zeros((4, 3)), seen).write_binary(str(file))
        run("import", file, tmp_path / "scene")
        assert "read as those of WGS 84" in caplog.text
        scene, truth = Scene(tmp_path / "scene"), from_origin(PLACE)
        found = read_georeference(scene)
        assert found is not None and found.epsg == 32615
        centers, expected = (np.array([view.center for view in some]) for some in (scene.model.views, views))
        np.testing.assert_allclose(found.to_crs(centers), truth.to_crs(expected), atol=1e-3)
        if kind == "colmap":
            np.testing.assert_allclose(found.to_crs(scene.model.points), truth.to_crs(points), atol=1e-3)
            here = found.from_crs(truth.to_crs(probe()))
            assert same_projections(scene.model.views, views, probe(), here) < 0.01

    def test_chunk_of_metashape_that_is_not_referenced(self, tmp_path):
        (tmp_path / "a.xml").write_text(metashape_xml(fly(), metashape_lens()))
        assert "arbitrary" in read(tmp_path / "a.xml")[0].notes["scale"]

    def test_transforms_say_nothing_of_a_place(self, tmp_path):
        assert read(transforms(tmp_path, rename(fly(), "images/{}.jpg")))[0].georeference is None


class TestPartialModels:
    @pytest.mark.parametrize("text", [True, False])
    def test_without_points(self, tmp_path, text):
        folder = save_model(tmp_path / "model", fly(), text, points=0)
        assert len(read(folder)[0].views) == 6
        (folder / f"points3D.{'txt' if text else 'bin'}").unlink()
        assert len(read(folder)[0].views) == 6

    @pytest.mark.parametrize("text", [True, False])
    def test_without_the_points_that_photos_see(self, tmp_path, text):
        folder = save_model(tmp_path / "model", fly(), text)
        (folder / f"points3D.{'txt' if text else 'bin'}").unlink()
        project, _ = read(folder)
        assert len(project.views) == 6 and not len(project.points)
        (folder / f"images.{'txt' if text else 'bin'}").unlink()
        with pytest.raises(InputError, match="no file of photos"):
            read(folder)

    def test_points_of_keypoints_that_are_gone(self, tmp_path):
        """An editor has emptied the lines of keypoints, but not the file of points."""
        folder = save_model(tmp_path / "model", fly(), text=True)
        lines = (folder / "images.txt").read_text().splitlines()
        heads = [line if line.startswith("#") or ".jpg" in line else "" for line in lines]
        (folder / "images.txt").write_text("\n".join(heads) + "\n")
        with pytest.raises(InputError, match="name keypoints that its photos .* do not list"):
            read(folder)

    def test_one_camera_per_photo(self, tmp_path):
        views = [
            replace(
                view,
                camera=pycolmap.Camera(
                    model="PINHOLE", width=SIZE[0], height=SIZE[1], params=[500 + row, 501, 320, 240]
                ),
            )
            for row, view in enumerate(fly())
        ]
        save_model(tmp_path / "model", views)
        run("import", tmp_path / "model", tmp_path / "scene")
        assert [view.camera.params[0] for view in Scene(tmp_path / "scene").model.views] == list(
            range(500, 506)
        )

    def test_rig_of_colmap(self, tmp_path):
        """Poses of a rig's second camera come from its frame; some of its photos are gone."""
        views = small(fly(count=4))
        save_rig(tmp_path / "sparse" / "0", views)
        photos = write_photos(tmp_path / "images", views)
        (photos / "shot_3.jpg").unlink()
        run("import", tmp_path, tmp_path / "scene")
        assert same_projections(Scene(tmp_path / "scene").model.views, views[:3], probe()) < 1e-6

    def test_rig_with_a_camera_that_is_not_placed(self, tmp_path):
        save_rig(tmp_path / "binary", small(fly(count=4)))
        folder = tmp_path / "text"
        folder.mkdir()
        pycolmap.Reconstruction(str(tmp_path / "binary")).write_text(str(folder))
        lines = (folder / "rigs.txt").read_text().splitlines()
        (folder / "rigs.txt").write_text("\n".join([*lines[:-1], "1 2 CAMERA 1 CAMERA 2 0"]))
        with pytest.raises(InputError, match="camera 2 of rig 1 has no pose"):
            read(folder)


def save_rig(folder: Path, views: list[View]) -> None:
    """Pairs of views as frames of a rig; `views` are changed so that all pairs have the offset of the first."""
    model, rig = pycolmap.Reconstruction(), pycolmap.Rig(rig_id=1)
    offset = views[1].cam_from_world @ np.linalg.inv(views[0].cam_from_world)
    for number in (1, 2):
        camera = pycolmap.Camera(views[0].camera.todict())
        camera.camera_id = number
        model.add_camera(camera)
    rig.add_ref_sensor(model.camera(1).sensor_id)
    rig.add_sensor(model.camera(2).sensor_id, pycolmap.Rigid3d(offset[:3]))
    model.add_rig(rig)
    for row in range(0, len(views), 2):
        views[row + 1] = replace(views[row + 1], cam_from_world=offset @ views[row].cam_from_world)
        frame = pycolmap.Frame(frame_id=row + 1, rig_id=1)
        images = []
        for number in (0, 1):
            image = pycolmap.Image(
                name=views[row + number].name, camera_id=number + 1, image_id=row + number + 1
            )
            image.frame_id = frame.frame_id
            frame.add_data_id(image.data_id)
            images.append(image)
        frame.rig_from_world = pycolmap.Rigid3d(views[row].cam_from_world[:3])
        model.add_frame(frame)
        for image in images:
            model.add_image(image)
        model.register_frame(frame.frame_id)
    folder.mkdir(parents=True)
    model.write_binary(str(folder))
