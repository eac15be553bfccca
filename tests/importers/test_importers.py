"""Other programs' projects, clouds and meshes: written as those programs write them (or by their own code),
read back to the same projections.
"""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import laspy
import numpy as np
import open3d as o3d
import pycolmap
import pyproj
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from sc3d.cli import main
from sc3d.errors import InputError
from sc3d.geometry.cameras import View, look_at, project
from sc3d.geometry.distortion import DistortionModel, to_camera
from sc3d.georeferencing.georeference import Georeference, from_origin, read_georeference, write_georeference
from sc3d.importers.model import guess_observations
from sc3d.importers.opensfm import _distortion_model as opensfm_model
from sc3d.importers.project import read_project
from sc3d.io.colmap import load_model
from sc3d.scene.scene import Scene, read_sparse_model
from sc3d.settings.reconstruction import Import
from tests.builders import CLASSES, ORIGIN, ground, truth_mask, write_model
from tests.builders import views as bare_views

FILES = Path(__file__).parent / "files"
PLACE = (46.84269, -91.99443, 198.0)
SIZE = (640, 480)
CAMERAS = {  # distorted, principal point off center
    "OPENCV": [505.5, 503.25, 331.5, 226.75, -0.11, 0.04, 0.0012, -0.0023],
    "FULL_OPENCV": [505.5, 503.25, 331.5, 226.75, -0.11, 0.04, 0.0012, -0.0023, -0.012, 0, 0, 0],
    "OPENCV_FISHEYE": [305.5, 303.25, 311.5, 251.75, -0.03, 0.011, -0.004, 0.0006],
    "RADIAL": [505.5, 320, 240, -0.11, 0.04],
}


def run(*arguments) -> None:
    main([str(argument) for argument in arguments])


def fails(capsys, *arguments) -> str:
    """Run a command that must refuse its input; returns its one line."""
    capsys.readouterr()
    with pytest.raises(SystemExit) as stopped:
        run(*arguments)
    error = capsys.readouterr().err
    assert stopped.value.code == 2 and "Traceback" not in error, error
    return next(line for line in error.splitlines() if line.startswith("sc3d:"))


def fly(model: str = "OPENCV", count: int = 6) -> list[View]:
    camera = pycolmap.Camera(model=model, width=SIZE[0], height=SIZE[1], params=CAMERAS[model], camera_id=1)
    rng = np.random.default_rng(5)
    centers = [[20 * np.cos(step), 15 * np.sin(step), 30 + step] for step in range(count)]
    return [
        View(f"shot_{row}.jpg", camera, look_at(np.array(center), rng.normal(0, 3, 3)))
        for row, center in enumerate(centers)
    ]


def probe(count: int = 300) -> np.ndarray:
    return np.random.default_rng(1).uniform([-14, -12, -1], [14, 12, 3], (count, 3))


def write_photos(folder: Path, views: list[View]) -> Path:
    for view in views:
        (folder / view.name).parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", (view.width, view.height)).save(folder / view.name)
    return folder


def same_projections(
    found: list[View], views: list[View], points: np.ndarray, moved: np.ndarray | None = None
) -> float:
    """Largest distance, px, between where two sets of views see points (`moved`: the points in the frame of
    `found`); all must see the same ones.
    """
    by_name = {Path(view.name).stem: view for view in found}
    assert set(by_name) == {Path(view.name).stem for view in views}
    worst = 0.0
    for view in views:
        first, second = (
            project(view, points)[0],
            project(by_name[Path(view.name).stem], points if moved is None else moved)[0],
        )
        inside = np.isfinite(first).all(axis=1) & (first > 0).all(axis=1) & (first < SIZE).all(axis=1)
        assert inside.sum() > 30
        worst = max(worst, float(np.abs(first - second)[inside].max()))
    return worst


def metashape_xml(
    views: list[View],
    distortion: dict,
    reference: str = "",
    transform: tuple | None = None,
    extra: str = "",
    kind: str = "frame",
) -> str:
    """Cameras as Metashape exports them; `transform`: rotation, translation and scale to geocentric (or
    local) coordinates.
    """
    inner = "".join(f"<{name}>{value!r}</{name}>" for name, value in distortion.items())
    rotation, translation, scale = transform or (np.eye(3), np.zeros(3), 1.0)
    cameras = []
    for row, view in enumerate(views):
        matrix = np.eye(4)
        matrix[:3, :3] = rotation.T @ view.cam_from_world[:3, :3].T
        matrix[:3, 3] = rotation.T @ (view.center - translation) / scale
        numbers = " ".join(repr(float(value)) for value in matrix.ravel())
        cameras.append(
            f'<camera id="{row}" sensor_id="0" component_id="0" label="{Path(view.name).stem}"><transform>{numbers}</transform><orientation>1</orientation></camera>'
        )
    flat = " ".join(repr(float(value)) for value in rotation.ravel())
    placed = (
        (
            f'<transform><rotation locked="true">{flat}</rotation><translation>{" ".join(repr(float(value)) for value in translation)}</translation>'
            f"<scale>{scale!r}</scale></transform>"
        )
        if transform
        else ""
    )
    return (
        f'<?xml version="1.0" encoding="UTF-8"?>\n{extra}<document version="2.0.0"><chunk label="Chunk 1" enabled="true"><sensors next_id="1">'
        f'<sensor id="0" label="FC6310" type="{kind}"><resolution width="{SIZE[0]}" height="{SIZE[1]}"/><property name="pixel_width" value="0.0024"/>'
        f'<calibration type="{kind}" class="initial"><resolution width="{SIZE[0]}" height="{SIZE[1]}"/><f>400</f></calibration>'
        f'<calibration type="{kind}" class="adjusted"><resolution width="{SIZE[0]}" height="{SIZE[1]}"/>{inner}</calibration></sensor></sensors>'
        f'<components next_id="1" active_id="0"><component id="0" label="Component 1">{placed}</component></components>'
        f'<cameras next_id="9" next_group_id="1"><group id="0" label="Group 1" type="folder">{"".join(cameras)}</group>'
        f'<camera id="8" sensor_id="0" label="unaligned"><orientation>1</orientation></camera></cameras>'
        + (f"<reference>{reference}</reference>" if reference else "")
        + "</chunk></document>\n"
    )


def metashape_lens() -> dict[str, float]:
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = CAMERAS["FULL_OPENCV"][:9]
    return {
        "f": fy,
        "cx": cx - SIZE[0] / 2,
        "cy": cy - SIZE[1] / 2,
        "b1": fx - fy,
        "k1": k1,
        "k2": k2,
        "k3": k3,
        "p1": p2,
        "p2": p1,
    }


def opensfm_json(views: list[View], points: np.ndarray, reference: tuple | None) -> list[dict]:
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = CAMERAS["FULL_OPENCV"][:9]
    size = max(SIZE)
    camera = {
        "projection_type": "brown",
        "width": SIZE[0],
        "height": SIZE[1],
        "focal_x": fx / size,
        "focal_y": fy / size,
        "c_x": (cx - SIZE[0] / 2) / size,
        "c_y": (cy - SIZE[1] / 2) / size,
        "k1": k1,
        "k2": k2,
        "p1": p1,
        "p2": p2,
        "k3": k3,
    }
    shots = {}
    for view in views:
        vector = pycolmap.Rotation3d(view.cam_from_world[:3, :3])
        angle = 2 * np.arctan2(np.linalg.norm(vector.quat[:3]), vector.quat[3])
        axis = vector.quat[:3] / np.linalg.norm(vector.quat[:3])
        shots[view.name] = {
            "rotation": (angle * axis).tolist(),
            "translation": view.cam_from_world[:3, 3].tolist(),
            "camera": "v2 dji",
            "gps_position": view.center.tolist(),
        }
    listed = {
        str(100 + row): {"coordinates": point.tolist(), "color": [10.0, 20.0, float(row % 256)]}
        for row, point in enumerate(points)
    }
    found = {"cameras": {"v2 dji": camera}, "shots": shots, "points": listed}
    if reference:
        found["reference_lla"] = dict(zip(("latitude", "longitude", "altitude"), reference))
    return [{"cameras": {}, "shots": {}}, found]


def write_opf(folder: Path, views: list[View], points: np.ndarray, frame: dict | None = None) -> None:
    """A project in the Open Photogrammetry Format: every view sees every third point."""
    fx, _, cx, cy, k1, k2, p1, p2, k3 = CAMERAS["FULL_OPENCV"][:9]
    internals = {
        "type": "perspective",
        "focal_length_px": fx,
        "principal_point_px": [cx, cy],
        "radial_distortion": [k1, k2, k3],
        "tangential_distortion": [p1, p2],
    }
    ids = [2**63 + row for row in range(len(views))]
    cameras = []
    for uid, view in zip(ids, views):
        rotation = view.cam_from_world[:3, :3].T * [1, -1, -1]
        angles = Rotation.from_matrix(rotation).as_euler("XYZ", degrees=True)
        camera = {
            "id": uid,
            "sensor_id": 7,
            "orientation_deg": angles.tolist(),
            "position": view.center.tolist(),
        }
        cameras.append(camera)
    listed = [{"id": uid, "uri": f"../photos/{view.name}"} for uid, view in zip(ids, views)]
    documents = {
        "camera-list": {"cameras": [*listed, {"id": 5, "uri": "../photos/lost%20one.jpg"}]},
        "input-cameras": {"sensors": [{"id": 7, "image_size_px": list(SIZE)}], "captures": []},
        "calibrated-cameras": {"cameras": cameras, "sensors": [{"id": 7, "internals": internals}]},
        "scene-reference-frame": frame,
    }
    items = []
    for name, content in documents.items():
        kind = f"application/opf-{name}+json"
        if content is not None:
            (folder / f"{name}.json").write_text(json.dumps({"format": kind, "version": "1.0", **content}))
            items.append(
                {"type": name.replace("-", "_"), "resources": [{"format": kind, "uri": f"{name}.json"}]}
            )
    items.append({"type": "calibration", "resources": [{"format": "model/gltf+json", "uri": "tracks.gltf"}]})
    write_opf_tracks(folder, ids, views, points)
    project_file = {"format": "application/opf-project+json", "version": "1.0", "items": items}
    (folder / "site.opf").write_text(json.dumps(project_file))


def write_opf_tracks(folder: Path, ids: list[int], views: list[View], points: np.ndarray) -> None:
    seen = [list(range(row % 3, len(views), 3)) for row in range(len(points))]
    counts = np.array([len(rows) for rows in seen])
    first = np.cumsum(counts) - counts
    ranges = b"".join(
        int(a).to_bytes(5, "little") + int(n).to_bytes(3, "little") for a, n in zip(first, counts)
    )
    pixels = [project(views[view], points[row][None])[0][0] for row, rows in enumerate(seen) for view in rows]
    arrays = [
        (points[:, [0, 2, 1]] * [1, 1, -1]).astype("<f4"),
        np.tile(np.uint8([9, 8, 7, 255]), (len(points), 1)),
        np.concatenate(seen).astype("<u4")[:, None],
        np.frombuffer(ranges, "<u4").reshape(-1, 2),
        np.array(pixels, "<f4"),
    ]
    kinds = [("VEC3", 5126), ("VEC4", 5121), ("SCALAR", 5125), ("VEC2", 5125), ("VEC2", 5126)]
    offsets = np.cumsum([0, *(array.nbytes for array in arrays)])
    (folder / "tracks.bin").write_bytes(b"".join(array.tobytes() for array in arrays))
    extension = {
        "cameraUids": ids,
        "cameraIds": 2,
        "pointIndexRanges": 3,
        "imagePoints": {"pixelCoordinates": 4},
    }
    primitive = {
        "attributes": {"POSITION": 0, "COLOR_0": 1},
        "mode": 0,
        "extensions": {"OPF_mesh_primitive_matches": extension},
    }
    content = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": [
            {"bufferView": row, "componentType": kind, "type": name, "count": len(array)}
            for row, (array, (name, kind)) in enumerate(zip(arrays, kinds))
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": int(start), "byteLength": array.nbytes}
            for start, array in zip(offsets, arrays)
        ],
        "buffers": [{"uri": "tracks.bin", "byteLength": int(offsets[-1])}],
    }
    (folder / "tracks.gltf").write_text(json.dumps(content))


def pix4d_text(views: list[View]) -> str:
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = CAMERAS["FULL_OPENCV"][:9]
    lines = [
        "fileName imageWidth imageHeight",
        "camera matrix K [3x3]",
        "radial distortion [3x1]",
        "tangential distortion [2x1]",
        "camera position t [3x1]",
        "camera rotation R [3x3]",
        "camera model m = K [R|-Rt] X",
        "",
    ]
    for view in views:
        lines += [
            f"{view.name} {SIZE[0]} {SIZE[1]}",
            f"{fx!r} 0 {cx!r}",
            f"0 {fy!r} {cy!r}",
            "0 0 1",
            f"{k1!r} {k2!r} {k3!r}",
            f"{p1!r} {p2!r}",
            *(
                " ".join(repr(float(value)) for value in row)
                for row in (view.center, *view.cam_from_world[:3, :3])
            ),
            "",
        ]
    return "\n".join(lines)


class TestRoundTrips:
    """Every format: written from known cameras, imported by the command, the same projections and positions."""

    @pytest.fixture
    def scene(self, tmp_path):
        views = fly("OPENCV")
        write_model(tmp_path / "scene" / "sparse" / "0", views)
        write_photos(tmp_path / "scene" / "images", views)
        return tmp_path / "scene"

    @pytest.mark.parametrize("model", ["OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE", "RADIAL"])
    def test_transforms_json_of_our_own(self, tmp_path, model):
        views = fly(model)
        write_model(tmp_path / "scene" / "sparse" / "0", views)
        write_photos(tmp_path / "scene" / "images", views)
        write_georeference(Scene(tmp_path / "scene"), from_origin(PLACE, altitude_offset=1.5))
        run("export", tmp_path / "scene", "--format", "transforms")
        run("import", tmp_path / "scene" / "export" / "transforms", tmp_path / "other")
        assert read_georeference(Scene(tmp_path / "other")) == from_origin(PLACE, altitude_offset=1.5)
        assert same_projections(Scene(tmp_path / "other").model.views, views, probe()) < 1e-6
        assert (tmp_path / "other" / "images").resolve() == (tmp_path / "scene" / "images").resolve()

    @pytest.mark.parametrize("binary", [True, False])
    def test_colmap(self, tmp_path, scene, binary):
        project_folder = scene / "sparse" / "0"
        if not binary:
            run("export", scene, "--format", "colmap-text")
            project_folder = scene / "export" / "colmap-text"
        run("import", project_folder, tmp_path / "other", "--images", scene / "images")
        assert same_projections(Scene(tmp_path / "other").model.views, fly(), probe()) < 1e-6

    def test_opensfm(self, tmp_path):
        views, points = fly(), probe(50)
        views = [
            replace(
                view,
                camera=pycolmap.Camera(
                    model="FULL_OPENCV", width=SIZE[0], height=SIZE[1], params=CAMERAS["FULL_OPENCV"]
                ),
            )
            for view in views
        ]
        write_photos(tmp_path / "osfm" / "images", views)
        (tmp_path / "osfm" / "reconstruction.json").write_text(json.dumps(opensfm_json(views, points, PLACE)))
        tracks, size = ["OPENSFM_TRACKS_VERSION_v2"], max(SIZE)
        for view in views:
            for row, pixel in enumerate(project(view, points)[0]):
                if np.isfinite(pixel).all():
                    x, y = (pixel - np.array(SIZE) / 2) / size
                    tracks.append(
                        "\t".join(map(str, [view.name, 100 + row, row, x, y, 0.01, 10, 20, 30, -1, -1]))
                    )
        # a track that was not triangulated
        tracks.append("\t".join(map(str, [views[0].name, 7, 7, 0.1, 0.1, 0.01, 1, 2, 3, -1, -1])))
        (tmp_path / "osfm" / "tracks.csv").write_text("\n".join(tracks) + "\n")
        run("import", tmp_path / "osfm", tmp_path / "scene")
        model = Scene(tmp_path / "scene").model
        assert same_projections(model.views, views, probe()) < 1e-6
        np.testing.assert_allclose(model.points, points, atol=1e-12)
        assert [len(track) for track in model.tracks] == [
            int(np.isfinite(project(view, points)[0]).all(axis=1).sum()) for view in views
        ]
        reconstruction = pycolmap.Reconstruction(str(tmp_path / "scene" / "sparse" / "0"))
        reconstruction.update_point_3d_errors()
        # the pixels of the tracks are where the cameras see the points
        assert reconstruction.compute_mean_reprojection_error() < 1e-6
        found = read_georeference(Scene(tmp_path / "scene"))
        assert found.epsg == 32615 and found.origin == PLACE and not found.is_moved

    @pytest.mark.parametrize("topocentric", [True, False])
    def test_odm_project(self, tmp_path, topocentric):
        views, points = (
            [
                replace(
                    view,
                    camera=pycolmap.Camera(
                        model="FULL_OPENCV", width=SIZE[0], height=SIZE[1], params=CAMERAS["FULL_OPENCV"]
                    ),
                )
                for view in fly()
            ],
            probe(20),
        )
        enu, root = from_origin(PLACE), tmp_path / "odm"
        write_photos(root / "images", views)
        (root / "opensfm").mkdir()
        (root / "odm_georeferencing").mkdir()
        (root / "odm_georeferencing" / "coords.txt").write_text(
            "WGS84 UTM 15N\n576600 5188100\n1.0 2.0 3.0\n"
        )
        geocoords = Georeference(32615, (576600.0, 5188100.0, 0.0))
        corners = np.vstack([np.zeros(3), np.eye(3)])
        moved = geocoords.from_crs(enu.to_crs(corners))
        # as ODM projects: linear, then the nearest rotation
        matrix, shift = (moved[1:] - moved[0]).T, moved[0]
        in_utm = []
        for view in views:
            left, _, right = np.linalg.svd(view.cam_from_world[:3, :3] @ np.linalg.inv(matrix))
            pose = np.eye(4)
            pose[:3, :3] = left @ right
            pose[:3, 3] = -pose[:3, :3] @ (matrix @ view.center + shift)
            in_utm.append(replace(view, cam_from_world=pose))
        content = opensfm_json(in_utm, points @ matrix.T + shift, PLACE)
        for view in views:
            content[1]["shots"][view.name]["gps_position"] = view.center.tolist()  # stays topocentric
        (root / "opensfm" / "reconstruction.json").write_text(json.dumps(content))
        if topocentric:
            (root / "opensfm" / "reconstruction.topocentric.json").write_text(
                json.dumps(opensfm_json(views, points, PLACE))
            )
        run("import", root, tmp_path / "scene", "--from", "odm")
        found = read_georeference(Scene(tmp_path / "scene"))
        assert (found.origin is not None) == topocentric and found.epsg == 32615
        model = Scene(tmp_path / "scene").model
        here = found.from_crs(enu.to_crs(probe()))
        # ODM's own rounding of rotations and scale
        assert same_projections(model.views, views, probe(), here) < (1e-5 if topocentric else 0.5)
        np.testing.assert_allclose(
            found.to_crs(np.array([view.center for view in model.views])),
            enu.to_crs(np.array([view.center for view in views])),
            atol=1e-6 if topocentric else 1e-2,
        )

    def test_pix4d(self, tmp_path):
        views = [
            replace(
                view,
                camera=pycolmap.Camera(
                    model="FULL_OPENCV", width=SIZE[0], height=SIZE[1], params=CAMERAS["FULL_OPENCV"]
                ),
            )
            for view in fly()
        ]
        params = tmp_path / "site" / "1_initial" / "params"
        params.mkdir(parents=True)
        (params / "site_calibrated_camera_parameters.txt").write_text(pix4d_text(views))
        (params / "site_offset.xyz").write_text("576600.000 5188100.000 150.000\n")
        (params / "site_wkt.prj").write_text(pyproj.CRS.from_epsg(32615).to_wkt("WKT1_ESRI"))
        run(
            "import",
            tmp_path / "site",
            tmp_path / "scene",
            "--images",
            write_photos(tmp_path / "photos", views),
        )
        assert same_projections(Scene(tmp_path / "scene").model.views, views, probe()) < 1e-6
        assert read_georeference(Scene(tmp_path / "scene")) == Georeference(
            32615, (576600.0, 5188100.0, 150.0)
        )

    def opf_site(self, folder: Path, frame: dict | None) -> tuple[list[View], np.ndarray]:
        fx, _, *rest = CAMERAS["FULL_OPENCV"]
        camera = pycolmap.Camera(model="FULL_OPENCV", width=SIZE[0], height=SIZE[1], params=[fx, fx, *rest])
        views = [replace(view, camera=camera) for view in fly()]
        (folder / "project").mkdir(parents=True)
        write_photos(folder / "photos", views)
        write_opf(folder / "project", views, probe(60), frame)
        return views, probe(60)

    @pytest.mark.parametrize(
        ("epsg", "vertical", "scale", "unit"),
        [
            (32615, "", [1.0, 1, 1], 1.0),
            (2229, "", [1200 / 3937] * 3, 1200 / 3937),
            (32615, "+6360", [1, 1, 1200 / 3937], 1),
        ],
    )
    def test_opf(self, tmp_path, caplog, epsg, vertical, scale, unit):
        """6360: heights in US survey feet."""
        shift = [-576600.0 * scale[0], -5188100.0 * scale[1], -150.0 * scale[2]]
        definition = pyproj.CRS.from_user_input(f"EPSG:{epsg}{vertical}").to_wkt()
        frame = {
            "crs": {"definition": definition},
            "base_to_canonical": {"scale": scale, "shift": shift, "swap_xy": False},
        }
        views, points = self.opf_site(tmp_path, frame)
        run("import", tmp_path / "project", tmp_path / "scene")
        model = Scene(tmp_path / "scene").model
        assert same_projections(model.views, views, probe()) < 1e-6
        assert np.abs(model.points - points).max() < 1e-6 and (model.colors == [9, 8, 7]).all()
        found = read_georeference(Scene(tmp_path / "scene"))
        base = found.to_crs(points)
        # base coordinates times scale, plus shift, heights in the unit of eastings
        assert (
            found.epsg == epsg and np.abs((base[:, :2] * scale[:2] + shift[:2]) - points[:, :2]).max() < 1e-6
        )
        assert np.abs(base[:, 2] * unit - (points[:, 2] - shift[2])).max() < 1e-6
        loaded = load_model(Scene(tmp_path / "scene").sparse)
        for point in list(loaded.points3D.values())[:9]:
            for element in point.track.elements:
                image = loaded.images[element.image_id]
                view = next(view for view in views if image.name.endswith(view.name))
                pixel = project(view, point.xyz[None])[0][0]
                assert np.abs(image.points2D[element.point2D_idx].xy - pixel).max() < 1e-3
            assert point.track.length() in (2, 3, 4)
        assert "1 that are not calibrated (../photos/lost one.jpg)" in caplog.text

    def test_opf_orientations_as_pyopf_has_them(self, tmp_path):
        converter = pytest.importorskip("opf_tools.opf2colmap.converter")
        views, _ = self.opf_site(tmp_path, None)
        content = json.loads((tmp_path / "project" / "calibrated-cameras.json").read_text())
        for view, camera in zip(views, content["cameras"]):
            quaternion, translation = converter.orient_pos_computation(
                np.array(camera["orientation_deg"]), np.array(camera["position"])
            )
            rotation = Rotation.from_quat(np.roll(quaternion, -1)).as_matrix()
            assert np.abs(rotation - view.cam_from_world[:3, :3]).max() < 1e-6
            assert np.abs(translation - view.cam_from_world[:3, 3]).max() < 1e-6

    def test_opf_without_a_place_and_with_a_fisheye(self, tmp_path, caplog):
        self.opf_site(tmp_path, None)
        path = tmp_path / "project" / "calibrated-cameras.json"
        content = json.loads(path.read_text())
        content["sensors"].append({"id": 8, "internals": {"type": "fisheye"}})
        content["cameras"][0]["sensor_id"] = 8
        path.write_text(json.dumps(content))
        run("import", tmp_path / "project" / "site.opf", tmp_path / "scene")
        assert read_georeference(Scene(tmp_path / "scene")) is None
        assert "1 of a fisheye lens, which no COLMAP model has (../photos/shot_0.jpg)" in caplog.text
        path.unlink()
        with pytest.raises(SystemExit):
            run("import", tmp_path / "project" / "site.opf", tmp_path / "other")

    @pytest.mark.parametrize(
        "reference",
        [
            'LOCAL_CS["Local Coordinates (m)",UNIT["meter",1]]',
            'ENGCRS["Site",EDATUM["Peg"],CS[Cartesian,3],AXIS["x",east],AXIS["y",north],AXIS["z",up],LENGTHUNIT["m",1]]',
        ],
    )
    def test_metashape_local(self, tmp_path, caplog, reference):
        views = [
            replace(
                view,
                camera=pycolmap.Camera(
                    model="FULL_OPENCV", width=SIZE[0], height=SIZE[1], params=CAMERAS["FULL_OPENCV"]
                ),
            )
            for view in fly()
        ]
        transform = (pycolmap.Rotation3d(np.array([0.3, -1.0, 0.5])).matrix(), np.array([3.0, 4, 5]), 12.354)
        (tmp_path / "cameras.xml").write_text(metashape_xml(views, metashape_lens(), reference, transform))
        run(
            "import",
            tmp_path / "cameras.xml",
            tmp_path / "scene",
            "--images",
            write_photos(tmp_path / "photos", views),
        )
        assert same_projections(Scene(tmp_path / "scene").model.views, views, probe()) < 1e-6
        assert read_georeference(Scene(tmp_path / "scene")) is None
        assert "stays unknown" not in caplog.text

    @pytest.mark.parametrize("epsg, expected", [(4326, 32615), (32615, 32615), (26991, 26991)])
    def test_metashape_on_earth(self, tmp_path, epsg, expected):
        """Chunk to geocentric coordinates, at 12.35 chunk units per meter, as a real export has it."""
        views = [
            replace(
                view,
                camera=pycolmap.Camera(
                    model="FULL_OPENCV", width=SIZE[0], height=SIZE[1], params=CAMERAS["FULL_OPENCV"]
                ),
            )
            for view in fly()
        ]
        geodesy = pycolmap.GPSTransform()

        def ecef(points: np.ndarray) -> np.ndarray:
            return np.asarray(
                geodesy.ellipsoid_to_ecef(np.asarray(geodesy.enu_to_ellipsoid(np.atleast_2d(points), *PLACE)))
            )

        left, _, right = np.linalg.svd((ecef(np.eye(3)) - ecef(np.zeros((1, 3)))).T)
        axes, zero = left @ right, ecef(np.zeros((1, 3)))[0]
        geocentric = []
        for view in views:
            pose = np.eye(4)
            pose[:3, :3] = view.cam_from_world[:3, :3] @ axes.T
            pose[:3, 3] = -pose[:3, :3] @ ecef(view.center)[0]
            geocentric.append(replace(view, cam_from_world=pose))
        transform = (pycolmap.Rotation3d(np.array([0.3, -1.0, 0.5])).matrix(), zero + [50, -20, 30], 12.354)
        reference = pyproj.CRS.from_epsg(epsg).to_wkt("WKT1_GDAL")
        (tmp_path / "cameras.xml").write_text(
            metashape_xml(geocentric, metashape_lens(), reference, transform)
        )
        run("import", tmp_path / "cameras.xml", tmp_path / "scene")
        found, truth = read_georeference(Scene(tmp_path / "scene")), from_origin(PLACE, expected)
        assert found.epsg == expected and found.origin is not None
        model = Scene(tmp_path / "scene").model
        centers, expected_centers = (
            np.array([view.center for view in some]) for some in (model.views, views)
        )
        # a millimeter at UTM size
        np.testing.assert_allclose(found.to_crs(centers), truth.to_crs(expected_centers), atol=1e-3)
        assert same_projections(model.views, views, probe(), found.from_crs(truth.to_crs(probe()))) < 0.01


class TestFilesOfTheToolsThemselves:
    @pytest.mark.parametrize("name", ["opencv", "fisheye"])
    def test_transforms_json_by_nerfstudio(self, tmp_path, name):
        """Written by colmap_to_json of nerfstudio 1.1.5 from the COLMAP model beside it; its
        applied_transform is undone.
        """
        run("import", FILES / f"nerfstudio_{name}", tmp_path / "scene")
        found, truth = (
            Scene(tmp_path / "scene").model,
            read_sparse_model(FILES / f"nerfstudio_{name}" / "colmap"),
        )
        assert (
            same_projections(
                found.views,
                truth.views,
                np.random.default_rng(2).uniform([-4, -4, -0.5], [4, 4, 1.5], (300, 3)),
            )
            < 1e-6
        )
        # nerfstudio writes them as text of a few digits
        np.testing.assert_allclose(found.points, truth.points, atol=1e-4)
        np.testing.assert_array_equal(found.colors, truth.colors)
        assert sum(map(len, found.tracks)) > 100  # guessed, so that train and extract can start

    def test_null_in_transforms_json_says_nothing(self, tmp_path):
        content = json.loads((FILES / "nerfstudio_opencv" / "transforms.json").read_text())
        cameras = []
        for name, value in (("without", {}), ("null", {"cx": None, "k1": None, "fl_y": None})):
            some = {key: kept for key, kept in content.items() if key not in ("cx", "k1", "fl_y")} | value
            (tmp_path / f"transforms_{name}.json").write_text(json.dumps(some))
            project = read_project(tmp_path / f"transforms_{name}.json", Import())
            cameras.append([view.camera.params for view in project.views])
        np.testing.assert_array_equal(*cameras)

    @pytest.mark.parametrize("number", range(9))
    def test_lenses_of_opensfm(self, number):
        """Projections computed by OpenSfM's own C++ code, in its convention: the center of the first pixel is
        (0, 0).
        """
        case = json.loads((FILES / "opensfm_projections.json").read_text())["cameras"][number]
        camera = to_camera(opensfm_model(case["camera"], "test"), 0.01, "test")
        np.testing.assert_allclose(
            camera.img_from_cam(np.array(case["points"])), np.array(case["pixels"]) + 0.5, atol=1e-3
        )

    def test_pix4d_as_documented(self, tmp_path):
        """The example of a calibrated_camera_parameters.txt in nFrames' documentation."""
        (tmp_path / "a_calibrated_camera_parameters.txt").write_text("""fileName imageWidth imageHeight
camera matrix K [3x3]
radial distortion [3x1]
tangential distortion [2x1]
camera position t [3x1]
camera rotation R [3x3]
camera model m = K [R|-Rt] X

DSC00002.JPG 6000 4000
5246.67817210519115178613 0 3014.21699955007488824776
0 5246.67817210519115178613 2056.96346303672453359468
0 0 1
-0.15994587090269449248 0.13993097057610345835 0.00932908149389201011
0.00077353649206159862 -0.00081332657209028754
-892.50251487949105921871 11.21358547207746880758 -4.01732550695115442352
-0.99840813078053458618 -0.01161539151567758145 -0.05519317957190545548
-0.00681563617726710196 0.99623997911544937001 -0.08636811399786505083
0.05598885152258621656 -0.08585445062421988294 -0.99473326164012199069
""")
        (view,) = read_project(tmp_path, Import()).views
        assert view.camera.model_name == "FULL_OPENCV" and (view.width, view.height) == (6000, 4000)
        np.testing.assert_allclose(view.center, [-892.5025, 11.2136, -4.0173], atol=1e-4)
        assert view.cam_from_world[2, 2] < -0.99  # looks down


class TestLenses:
    LENS = DistortionModel(
        4000, 3000, (3700.0, 3701.0), (2011.0, 1472.0), (-0.09, -0.076, 0.116), (0.0003, -0.0001)
    )

    def lens_project(self, distortion: DistortionModel, points: np.ndarray) -> np.ndarray:
        """Metashape's formula in plain numpy (tangential terms under OpenCV's names)."""
        x, y = (points[:, :2] / points[:, 2:]).T
        if distortion.fisheye:
            radius = np.hypot(x, y)
            x, y = np.arctan(radius) / radius * [x, y]
        r2 = x**2 + y**2
        factor = sum(k * r2 ** (n + 1) for n, k in enumerate(distortion.radial)) + 1
        p1, p2 = distortion.tangential
        u, v = (
            x * factor + 2 * p1 * x * y + p2 * (r2 + 2 * x**2),
            y * factor + 2 * p2 * x * y + p1 * (r2 + 2 * y**2),
        )
        return np.stack(
            [
                distortion.focal[0] * u + distortion.skew * v + distortion.principal[0],
                distortion.focal[1] * v + distortion.principal[1],
            ],
            axis=1,
        )

    def points(self, reach: float = 0.5) -> np.ndarray:
        return np.random.default_rng(0).uniform(
            [-reach, -0.8 * reach, 1], [reach, 0.8 * reach, 1], (500, 3)
        ) * np.random.default_rng(1).uniform(1, 50, (500, 1))

    @pytest.mark.parametrize(
        "changes, model",
        [
            ({}, "FULL_OPENCV"),
            ({"radial": (-0.09, 0.0, 0.0, 0.0)}, "OPENCV"),
            ({"radial": (), "tangential": (0.0, 0.0)}, "PINHOLE"),
            # k4 of a real Mavic 3M, as the nearest quotient
            ({"radial": (-0.0919, -0.0763, 0.1163, -0.0761)}, "FULL_OPENCV"),
            ({"fisheye": True, "tangential": (0.0, 0.0)}, "OPENCV_FISHEYE"),
            ({"fisheye": True}, "THIN_PRISM_FISHEYE"),
            (
                {"fisheye": True, "radial": (-0.03, 0.01, -0.002, 0.001, -0.0003), "tangential": (0.0, 0.0)},
                "RAD_TAN_THIN_PRISM_FISHEYE",
            ),
        ],
    )
    def test_every_lens_projects_as_its_formula(self, changes, model):
        distortion = replace(self.LENS, **changes)
        camera = to_camera(distortion, 0.01, "test")
        assert camera.model_name == model
        np.testing.assert_allclose(
            camera.img_from_cam(self.points()), self.lens_project(distortion, self.points()), atol=0.01
        )

    @pytest.mark.parametrize(
        "changes, word",
        [
            ({"skew": -0.306}, "skew"),
            ({"focal": (0.0, 1.0)}, "positive"),
            ({"radial": (np.nan,)}, "finite"),
            ({"prism": (0.1, 0.0)}, "prism"),
            ({"radial": (-0.4, 0.9, -3.0, 5.0, 8.0, -9.0)}, "radial polynomial"),
            ({"fisheye": True, "radial": (0.1,) * 5}, "no COLMAP model"),
        ],
    )
    def test_what_colmap_has_not_is_refused(self, changes, word):
        with pytest.raises(InputError, match=word):
            to_camera(replace(self.LENS, **changes), 0.01, "test")

    def test_tolerance_in_the_message_is_enough(self):
        distortion = replace(self.LENS, skew=-0.306)
        with pytest.raises(InputError) as caught:
            to_camera(distortion, 0.01, "test")
        tolerance = float(str(caught.value).split("--tolerance ")[1])
        assert 0.1 < tolerance < 0.2
        camera = to_camera(distortion, tolerance, "test")
        assert (
            np.abs(
                camera.img_from_cam(self.points(0.4)) - self.lens_project(distortion, self.points(0.4))
            ).max()
            < tolerance
        )


class TestBadProjects:
    def check(self, capsys, tmp_path, path, *words, options=()):
        message = fails(capsys, "import", path, tmp_path / "scene", *options)
        assert all(word in message for word in words), message
        assert not (tmp_path / "scene" / "sparse").exists()

    def test_unknown_and_empty(self, capsys, tmp_path):
        self.check(capsys, tmp_path, tmp_path / "nothing", "does not exist")
        (tmp_path / "empty").mkdir()
        self.check(capsys, tmp_path, tmp_path / "empty", "no project that is known")
        self.check(capsys, tmp_path, tmp_path / "empty", "XML", options=("--from", "metashape"))
        (tmp_path / "empty" / "transforms.json").write_text('{"frames": []}')
        self.check(capsys, tmp_path, tmp_path / "empty", "no photo")

    @pytest.mark.parametrize(
        "extra",
        [
            '<!DOCTYPE document [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;">]>',
            '<!DOCTYPE document SYSTEM "file:///etc/passwd">',
        ],
    )
    def test_document_types_and_entities(self, capsys, tmp_path, extra):
        (tmp_path / "cameras.xml").write_text(metashape_xml(fly(), metashape_lens(), extra=extra))
        self.check(capsys, tmp_path, tmp_path / "cameras.xml", "document type")

    @pytest.mark.parametrize(
        "change, word",
        [
            (("<f>503.25</f>", ""), "focal length"),
            (('type="frame"', 'type="spherical"'), "spherical"),
            (("</chunk>", ""), "not valid XML"),
            (("<k1>", "<b2>4</b2><k1>"), "skew"),
            (("<k1>", "<p3>4</p3><k1>"), "p3"),
            (("<transform>", "<transform>x "), "16 finite numbers"),
        ],
    )
    def test_metashape(self, capsys, tmp_path, change, word):
        (tmp_path / "cameras.xml").write_text(metashape_xml(fly(), metashape_lens()).replace(*change))
        self.check(capsys, tmp_path, tmp_path / "cameras.xml", word)

    @pytest.mark.parametrize(
        "change, word",
        [
            (lambda content: content["frames"][0].pop("file_path"), "file_path"),
            (lambda content: content.update(camera_model="EQUIRECTANGULAR"), "EQUIRECTANGULAR"),
            (lambda content: content["frames"][1].update(transform_matrix=[[1, 2], [3, 4]]), "frame 1"),
            (lambda content: content.pop("fl_x"), "fl_x"),
            (
                lambda content: content["frames"][2].update(transform_matrix=np.diag([1, 1, -1, 1]).tolist()),
                "no rotation",
            ),
            (lambda content: content.update(fl_x="wide"), "fl_x"),
            (lambda content: content.update(k4=1, k3=-0.5), "radial polynomial"),
        ],
    )
    def test_nerfstudio(self, capsys, tmp_path, change, word):
        content = json.loads((FILES / "nerfstudio_opencv" / "transforms.json").read_text())
        change(content)
        (tmp_path / "transforms.json").write_text(json.dumps(content))
        self.check(capsys, tmp_path, tmp_path / "transforms.json", word)

    @pytest.mark.parametrize(
        "change, word",
        [
            (lambda part: part["cameras"]["v2 dji"].update(projection_type="spherical"), "spherical"),
            (lambda part: part["cameras"]["v2 dji"].pop("width"), "lacks"),
            (lambda part: part["shots"]["shot_0.jpg"].update(rotation=[1, 2]), "shot_0"),
            (lambda part: part["points"]["100"].pop("coordinates"), "points"),
            (lambda part: [point.update(color=[9, 9, 9, 9]) for point in part["points"].values()], "points"),
            (lambda part: part.update(reference_lla={"latitude": 1}), "reference_lla"),
        ],
    )
    def test_opensfm(self, capsys, tmp_path, change, word):
        content = opensfm_json(fly(), probe(3), PLACE)
        change(content[1])
        (tmp_path / "osfm").mkdir()
        (tmp_path / "osfm" / "reconstruction.json").write_text(json.dumps(content))
        self.check(capsys, tmp_path, tmp_path / "osfm", word)

    @pytest.mark.parametrize(
        "change, word",
        [
            (("0 0 1\n", ""), "cut off"),
            (("camera model m", "model"), "as Pix4D writes"),
            (("640 480", "640"), "line 9"),
            (("radial distortion [3x1]", "fisheye polynomial"), "fisheye"),
        ],
    )
    def test_pix4d(self, capsys, tmp_path, change, word):
        (tmp_path / "a_calibrated_camera_parameters.txt").write_text(
            pix4d_text(fly()).replace(change[0], change[1], 1)
        )
        self.check(capsys, tmp_path, tmp_path / "a_calibrated_camera_parameters.txt", word)

    def test_photos(self, capsys, tmp_path):
        views = fly()
        (tmp_path / "cameras.xml").write_text(metashape_xml(views, metashape_lens()))
        photos = write_photos(tmp_path / "photos", [replace(view, name=f"x{view.name}") for view in views])
        self.check(
            capsys, tmp_path, tmp_path / "cameras.xml", "shot_0", "--images", options=("--images", photos)
        )
        Image.new("RGB", (480, 640)).save(photos / "shot_0.jpg")
        self.check(capsys, tmp_path, tmp_path / "cameras.xml", "480x640", options=("--images", photos))


def test_photos_in_subfolders_are_found_by_their_label(tmp_path):
    views = fly()
    (tmp_path / "cameras.xml").write_text(metashape_xml(views, metashape_lens()))
    photos = write_photos(tmp_path / "photos", [replace(view, name=f"flight/{view.name}") for view in views])
    run("import", tmp_path / "cameras.xml", tmp_path / "scene", "--images", photos)
    assert {view.name for view in Scene(tmp_path / "scene").model.views} == {
        f"flight/{view.name}" for view in views
    }
    assert Scene(tmp_path / "scene").photo("flight/shot_0.jpg").is_file()


def test_guessed_observations_are_the_nearest_points(tmp_path):
    views = fly()
    rng = np.random.default_rng(4)
    # a roof over a floor
    points = np.vstack(
        [
            rng.uniform([-14, -12, 0], [14, 12, 0.2], (4000, 3)),
            rng.uniform([-14, -12, -9], [14, 12, -8.8], (4000, 3)),
        ]
    )
    for view, (rows, pixels) in zip(views, guess_observations(views, points)):
        expected, depth = project(view, points)
        np.testing.assert_allclose(pixels, expected[rows])
        # the floor shows beside the roof, and between points of it
        assert (rows < 4000).mean() > 0.9 and len(rows) > 1000
        cells = {}
        # the plain twin
        for row in np.flatnonzero(
            np.isfinite(expected).all(axis=1) & (expected >= 0).all(axis=1) & (expected < SIZE).all(axis=1)
        ):
            cells.setdefault(tuple((expected[row] * 64 / 640).astype(int)), []).append(row)
        twin = [
            row
            for members in cells.values()
            for row in members
            if depth[row] <= min(depth[other] for other in members) * 1.03
        ]
        assert sorted(twin) == sorted(rows)


UTM = np.array([576673.0, 5188174.0, 199.0])


def surveyed(count: int = 500) -> np.ndarray:
    """Positions at UTM size, whole millimeters."""
    return np.round(np.random.default_rng(3).uniform([-30, -30, -2], [30, 30, 8], (count, 3)) + UTM, 3)


def write_las(path: Path, points: np.ndarray, epsg: int | None = 32615, point_format: int = 7) -> Path:
    header = laspy.LasHeader(point_format=point_format, version="1.4")
    header.offsets, header.scales = np.floor(points.min(axis=0)), [0.001] * 3
    header.add_extra_dim(laspy.ExtraBytesParams("confidence", np.float32))
    if epsg:
        header.add_crs(pyproj.CRS.from_epsg(epsg))
    file = laspy.LasData(header)
    file.xyz = points
    file.classification = np.arange(len(points)) % 12
    file.confidence = np.linspace(0, 1, len(points))
    for name, factor in (("red", 65535), ("green", 0), ("blue", 256)):
        file[name] = np.full(len(points), factor, np.uint16)
    file.write(path)
    return path


def attributes(path: Path) -> dict[str, np.ndarray]:
    return {name: values.numpy() for name, values in o3d.t.io.read_point_cloud(str(path)).point.items()}


class TestClouds:
    @pytest.mark.parametrize("suffix", [".las", ".laz"])
    def test_las_alone_makes_a_scene_with_a_place(self, tmp_path, suffix):
        run("import", write_las(tmp_path / f"cloud{suffix}", surveyed()), tmp_path / "scene")
        scene = Scene(tmp_path / "scene")
        found, table = read_georeference(scene), attributes(scene.cloud)
        assert found.epsg == 32615 and found.origin is None
        assert table["positions"].dtype == np.float64 and np.abs(table["positions"]).max() < 1000
        np.testing.assert_allclose(found.to_crs(table["positions"]), surveyed(), atol=1e-6)
        np.testing.assert_array_equal(table["classification"].ravel(), np.arange(500) % 12)
        np.testing.assert_allclose(table["confidence"].ravel(), np.linspace(0, 1, 500), atol=1e-6)
        assert (table["colors"] == [255, 0, 1]).all()

    @pytest.mark.parametrize("epsg", [32615, 26915, 2232])
    def test_las_into_a_scene_in_enu(self, tmp_path, epsg):
        """Into the world of the cameras, also from another CRS; to 1 mm."""
        scene, truth = Scene(tmp_path / "scene"), probe(400)
        write_model(scene.sparse, fly())
        write_georeference(scene, from_origin(PLACE))
        points = from_origin(PLACE, epsg).to_crs(truth)
        run("import", write_las(tmp_path / "cloud.laz", points, epsg), tmp_path / "scene")
        np.testing.assert_allclose(attributes(scene.cloud)["positions"], truth, atol=1e-3)
        assert read_georeference(scene) == from_origin(PLACE) and len(scene.model.views) == 6

    def test_cloud_without_crs_is_recognized_by_where_the_cameras_are(self, tmp_path):
        scene, truth = Scene(tmp_path / "scene"), probe(400)
        write_model(scene.sparse, fly())
        write_georeference(scene, from_origin(PLACE))
        run(
            "import",
            write_las(tmp_path / "cloud.laz", from_origin(PLACE).to_crs(truth), None),
            tmp_path / "scene",
        )
        np.testing.assert_allclose(attributes(scene.cloud)["positions"], truth, atol=1e-3)
        run("import", write_las(tmp_path / "local.laz", truth, None), tmp_path / "scene")
        np.testing.assert_allclose(attributes(scene.cloud)["positions"], truth, atol=1e-3)

    def test_cloud_with_crs_needs_to_know_where_the_cameras_are(self, capsys, tmp_path):
        write_model(tmp_path / "scene" / "sparse" / "0", fly())
        assert "sc3d georeference" in fails(
            capsys, "import", write_las(tmp_path / "cloud.laz", surveyed()), tmp_path / "scene"
        )

    def test_las_in_degrees_is_refused(self, capsys, tmp_path):
        write_las(tmp_path / "cloud.las", surveyed(), 4326)
        assert "degrees" in fails(capsys, "import", tmp_path / "cloud.las", tmp_path / "scene")

    @pytest.mark.parametrize("name", ["classification", "scalar_Classification"])
    def test_ply_keeps_what_it_holds(self, tmp_path, name):
        cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor(surveyed()))
        cloud.point[name] = o3d.core.Tensor((np.arange(500) % 9).astype(np.float32)[:, None])
        cloud.point["curvature"] = o3d.core.Tensor(np.linspace(0, 2, 500)[:, None])
        cloud.point.colors = o3d.core.Tensor(np.tile(np.uint8([1, 2, 3]), (500, 1)))
        o3d.t.io.write_point_cloud(str(tmp_path / "in.ply"), cloud)
        run("import", tmp_path / "in.ply", tmp_path / "scene", "--epsg", 32615)
        table = attributes(tmp_path / "scene" / "cloud.ply")
        np.testing.assert_allclose(
            read_georeference(Scene(tmp_path / "scene")).to_crs(table["positions"]), surveyed(), atol=1e-6
        )
        np.testing.assert_array_equal(table["classification"].ravel(), np.arange(500) % 9)
        np.testing.assert_allclose(table["curvature"].ravel(), np.linspace(0, 2, 500))
        assert table["classification"].dtype == np.uint8 and (table["colors"] == [1, 2, 3]).all()

    @pytest.mark.parametrize(
        "name, lines",
        [
            ("a.xyz", ["{0} {1} {2} 10 20 30"]),
            ("a.txt", ["//X Y Z R G B", "{0},{1},{2},10,20,30"]),
            ("a.csv", ["x;y;z;r;g;b", "{0};{1};{2};10;20;30"]),
            ("a.pts", ["500", "{0} {1} {2} -1200 10 20 30"]),
        ],
    )
    def test_text(self, tmp_path, name, lines):
        rows = [lines[-1].format(*(f"{value:.3f}" for value in point)) for point in surveyed()]
        (tmp_path / name).write_text("\n".join([*lines[:-1], *rows]))
        run("import", tmp_path / name, tmp_path / "scene")
        table = attributes(tmp_path / "scene" / "cloud.ply")
        # no CRS is stated: they stay as they are
        np.testing.assert_array_equal(table["positions"], surveyed())
        assert (table["colors"] == [10, 20, 30]).all() and read_georeference(
            Scene(tmp_path / "scene")
        ) is None

    def test_pcd(self, tmp_path):
        points = probe(100).astype(np.float32)
        cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor(points))
        cloud.point["intensity"] = o3d.core.Tensor(np.arange(100, dtype=np.float32)[:, None])
        o3d.t.io.write_point_cloud(str(tmp_path / "in.pcd"), cloud)
        run("import", tmp_path / "in.pcd", tmp_path / "scene")
        table = attributes(tmp_path / "scene" / "cloud.ply")
        np.testing.assert_array_equal(table["positions"], points.astype(np.float64))
        np.testing.assert_array_equal(table["intensity"].ravel(), np.arange(100))

    @pytest.mark.parametrize(
        "name, content, word",
        [
            ("a.xyz", "1 2\n3 4\n", "x y z"),
            ("a.xyz", "1 2 3\n1 2 x\n", "line 2"),
            ("a.xyz", "", "x y z"),
            ("a.las", "nothing", "is not a LAS file"),
            ("a.obj", "v 1 2 3\n", "no triangles"),
            ("a.obj", "v 1 2 3\nf 1 2 9\n", "does not hold"),
            ("a.xyz", "nan 1 2\n1 2 3\n", "finite"),
            ("a.stl", "solid", "can be read"),
        ],
    )
    def test_broken_files(self, capsys, tmp_path, name, content, word):
        (tmp_path / name).write_text(content)
        assert word in fails(capsys, "import", tmp_path / name, tmp_path / "scene", "--from", "cloud")
        assert not list((tmp_path / "scene").glob("*.ply"))


class TestMeshes:
    CORNERS = np.round(
        UTM + [[0, 0, 0], [1.25, 0, 0.125], [1.25, 1.5, 0.25], [0, 1.5, 0.001], [0.5, 0.5, 2]], 3
    )

    def check(self, tmp_path):
        found = read_georeference(Scene(tmp_path / "scene"))
        mesh = o3d.io.read_triangle_mesh(str(tmp_path / "scene" / "mesh.ply"))
        np.testing.assert_allclose(found.to_crs(np.asarray(mesh.vertices)), self.CORNERS, atol=1e-6)
        assert {tuple(triangle) for triangle in np.asarray(mesh.triangles)} == {
            (0, 1, 2),
            (0, 2, 3),
            (0, 1, 4),
        }
        assert (np.rint(np.asarray(mesh.vertex_colors) * 255) == [255, 128, 0]).all()

    def test_obj_with_quads_references_from_the_end_and_colors(self, tmp_path):
        vertices = [f"v {x:.3f} {y:.3f} {z:.3f} 1.0 0.502 0.0" for x, y, z in self.CORNERS]
        (tmp_path / "m.obj").write_text(
            "\n".join(
                [
                    "mtllib m.mtl",
                    *vertices,
                    "vt 0 0",
                    "vn 0 0 1",
                    "f 1/1/1 2/1/1 3/1/1 4/1/1",
                    "f -5//1 -4//1 -1//1",
                ]
            )
        )
        run("import", tmp_path / "m.obj", tmp_path / "scene", "--epsg", 32615)
        self.check(tmp_path)

    def test_ply_in_double(self, tmp_path):
        header = [
            "ply",
            "format ascii 1.0",
            "element vertex 5",
            *(f"property double {axis}" for axis in "xyz"),
            *(f"property uchar {color}" for color in ("red", "green", "blue")),
            "element face 3",
            "property list uchar int vertex_indices",
            "end_header",
        ]
        vertices = [f"{x:.3f} {y:.3f} {z:.3f} 255 128 0" for x, y, z in self.CORNERS]
        (tmp_path / "m.ply").write_text("\n".join([*header, *vertices, "3 0 1 2", "3 0 2 3", "3 0 1 4", ""]))
        run("import", tmp_path / "m.ply", tmp_path / "scene", "--epsg", 32615)
        self.check(tmp_path)


class TestColmapInACrs:
    def project(self, tmp_path: Path) -> Path:
        write_model(tmp_path / "project", bare_views())
        return tmp_path / "project"

    def test_large_coordinates_come_near_the_origin(self, tmp_path):
        run("import", self.project(tmp_path), tmp_path / "scene", "--epsg", 32615)
        scene = Scene(tmp_path / "scene")
        found = read_georeference(scene)
        assert found.origin is None and found.offset[2] == 0
        centers = np.array([view.center for view in scene.model.views])
        assert np.abs(centers[:, :2]).max() < 10
        np.testing.assert_allclose(
            found.to_crs(centers),
            [view.center for view in sorted(bare_views(), key=lambda view: view.name)],
            atol=1e-6,
        )

    def test_without_a_code_they_stay_and_it_says_so(self, tmp_path, caplog):
        run("import", self.project(tmp_path), tmp_path / "scene")
        assert "--epsg" in caplog.text and read_georeference(Scene(tmp_path / "scene")) is None
        np.testing.assert_allclose(
            Scene(tmp_path / "scene").model.views[0].center, bare_views()[0].center, atol=1e-6
        )

    def test_imported_scene_can_be_labelled(self, tmp_path):
        """COLMAP in UTM and a LAZ from elsewhere, with masks: labels on the same side of the line as the
        truth.
        """
        run(
            "import",
            self.project(tmp_path),
            tmp_path / "scene",
            "--epsg",
            32615,
            "--cloud",
            write_las(tmp_path / "c.laz", ground()),
        )
        scene = tmp_path / "scene"
        (scene / "classes.json").write_text(json.dumps(CLASSES))
        (scene / "masks").mkdir()
        for view in bare_views():
            Image.fromarray(truth_mask(view)).save(scene / "masks" / f"{Path(view.name).stem}.png")
        run("label", scene)
        table = attributes(scene / "seeds.ply")
        placed = read_georeference(Scene(scene)).to_crs(table["positions"]) - ORIGIN
        x, sure = placed[:, 0], np.abs(placed[:, 0]) > 0.2
        sure &= np.abs(placed[:, :2]).max(axis=1) < 3.75  # the masks say nothing of what is beyond 3.9 m
        assert (table["label"].ravel() == np.where(x < 0, 1, 3))[sure].mean() > 0.99


def test_a_second_import_is_skipped_and_photos_are_never_replaced(tmp_path, capsys, caplog):
    views = fly()
    shutil.copytree(FILES / "nerfstudio_opencv", tmp_path / "project")
    write_photos(tmp_path / "project" / "images", views)
    caplog.set_level("INFO")
    run("import", tmp_path / "project", tmp_path / "scene")
    run("import", tmp_path / "project", tmp_path / "scene")
    assert "up to date" in caplog.text
    write_photos(tmp_path / "taken" / "images", views[:1])
    assert "other photos" in fails(capsys, "import", tmp_path / "project", tmp_path / "taken")
