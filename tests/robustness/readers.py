"""Every reader of sc3d with small valid files, for the fuzzers: `READERS[name].build(folder)`, damage one of
`targets`, `read(folder)`.
"""

from __future__ import annotations

import json
import shutil
from functools import cache
from pathlib import Path

import numpy as np
from PIL import Image

from tests.builders import CLASSES
from tests.robustness.hostile_files import (
    LITTLE,
    Reader,
    exif,
    labelled_ply,
    mesh_ply,
    picture,
    splats_ply,
    tracked_model,
)

HERE = Path(__file__).parent
TEXT = {".json", ".txt", ".xml", ".csv", ".xyz", ".obj", ".prj", ".asc"}
PLACE = (46.84269, -91.99443, 198.0)


def _write(folder: Path, **files: bytes | str) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in files.items():
        path = folder / name.replace("__", ".")
        path.write_bytes(content.encode() if isinstance(content, str) else content)


# ---- the scene's own files


def _build_model(folder: Path, text: bool) -> None:
    model = tracked_model()
    folder.mkdir(parents=True, exist_ok=True)
    (model.write_text if text else model.write_binary)(str(folder))
    for name in ("rigs", "frames") if text else ():  # as models of older versions
        (folder / f"{name}.txt").unlink()


def _read_model(folder: Path) -> object:
    from sc3d.geometry.cameras import project, rays
    from sc3d.scene.scene import read_sparse_model

    model = read_sparse_model(folder)
    for view in model.views[:2]:  # what a camera that was accepted must be able to do
        small = view.resized(8, 6)
        project(small, model.points), rays(small)
    return model


def _read_cloud(folder: Path) -> object:
    from sc3d.io.clouds import read_cloud

    return [read_cloud(file) for file in sorted(folder.glob("*.*"))]


def _read_mesh(folder: Path) -> object:
    from sc3d.geometry.raycast import Surface
    from sc3d.io.clouds import read_mesh

    for file in sorted(folder.glob("*.ply")):
        mesh = read_mesh(file)
        Surface.from_mesh(
            mesh.vertex.positions.numpy().astype(np.float64), mesh.triangle.indices.numpy(), np.zeros(3)
        )


def _read_labelled(folder: Path) -> object:
    from sc3d.scene.labelled_cloud import read_labelled, read_votes, with_labels

    cloud, labels = read_labelled(folder / "seeds.ply", "label")
    votes = read_votes(cloud)
    np.bincount(labels.label, minlength=256)
    return with_labels(cloud, np.zeros((len(labels.label), 3)), labels, votes)


def _read_splats(folder: Path) -> object:
    import torch

    from sc3d.geometry.cameras import look_at, pinhole_view
    from sc3d.io.splats import read_splat_ply
    from sc3d.splatting.gaussians import Gaussians
    from sc3d.splatting.rendering import render

    gaussians = Gaussians.from_arrays(read_splat_ply(folder / "gaussians.ply")[0])
    view = pinhole_view("a", (24, 16), (20, 20, 12, 8), look_at(np.array([0.0, 0, 6]), np.zeros(3)))
    with torch.no_grad():
        return render(gaussians, view)


@cache
def _trainer():
    from dataclasses import replace

    from sc3d.splatting.trainer import Trainer
    from tests.splatting.scenes import photographed, ring, valley
    from tests.splatting.test_trainer import SHORT

    data, *_ = photographed(ring()[:3], valley(), wave=3.0, noise=0.05, num_points=60)
    trainer = Trainer(data, replace(SHORT, fill=False, max_gaussians=60))
    trainer.step()  # before it, the optimizers are empty
    return trainer


def _build_checkpoint(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    _trainer().save(folder / "train.checkpoint")


def _read_checkpoint(folder: Path) -> object:
    return _trainer().resume(folder / "train.checkpoint")


def _build_photos(folder: Path) -> None:
    details = {"exif": exif()}
    _write(
        folder,
        a__jpg=picture("JPEG", **details),
        b__jpg=picture("JPEG", progressive=True, **details),
        c__png=picture("PNG", **details),
        d__tif=picture("TIFF"),
        e__tif=picture("TIFF", compression="tiff_lzw"),
        f__tif=picture("TIFF", compression="jpeg"),
    )


def _read_photos(folder: Path) -> object:
    from sc3d.georeferencing.focal import exif_focal
    from sc3d.georeferencing.geotags import read_geotag
    from sc3d.io.images import read_image, read_orientation
    from sc3d.io.photo_folder import find_photos

    return [
        (read_image(photo).shape, read_orientation(photo), read_geotag(photo), exif_focal(photo))
        for photo in find_photos(folder)
    ]


def _build_masks(folder: Path) -> None:
    _write(folder, a__png=picture("PNG", "L"), b__png=picture("PNG", "L", optimize=True))


def _read_masks(folder: Path) -> object:
    from sc3d.io.mask_images import read_index_image
    from sc3d.scene.class_table import parse_classes
    from sc3d.scene.scene import match_masks

    table = parse_classes([{"id": i, "name": str(i), "color": [i, i, i]} for i in range(1, 4)], "test")
    return [
        read_index_image(file)
        for file in match_masks(folder, {"a.jpg": (40, 30), "b.jpg": (80, 60)}, table).values()
    ]


def _read_classes(folder: Path) -> object:
    from sc3d.scene.class_table import read_classes

    table = read_classes(folder / "classes.json")
    json.dumps(table.as_json(), ensure_ascii=False).encode()
    return table.palette, table.num_ids


def _read_georeference(folder: Path) -> object:
    from sc3d.georeferencing.georeference import read_georeference
    from sc3d.scene.scene import Scene

    return read_georeference(Scene(folder)).to_crs(np.zeros((2, 3)))


def _build_sidecars(folder: Path) -> None:
    record = {
        "stage": "label",
        "settings": {"consensus": 0.66},
        "inputs": {"cloud.ply": "00"},
        "versions": {"sc3d": "0.3.0"},
        "seconds": 1.5,
        "peak_memory_mb": 10,
        "summary": {"points": 5},
    }
    _write(
        folder,
        seeds__ply__json=json.dumps(record),
        metrics__json=json.dumps({"labels": {"oa": 0.5, "iou": {"road": 0.5}}, "photos": ["a.jpg"]}),
        seeds__ply=labelled_ply(),
    )


def _read_sidecars(folder: Path) -> object:
    from sc3d.report.data import load_report_data
    from sc3d.runner import _finished
    from sc3d.scene.scene import Scene
    from sc3d.settings.labels import Label

    record = {"stage": "label", "settings": {"consensus": 0.66}, "inputs": {"cloud.ply": "00"}}
    return _finished(record, [folder / "seeds.ply"], Scene(folder), Label()), load_report_data(
        Scene(folder)
    ).records


def _read_weights(folder: Path) -> object:
    from sc3d.segmentation.models import find_weights, model_type

    return model_type(find_weights("owner/model", folder, download=False))


# ---- masks and projects of other programs


def _read_mask_files(folder: Path) -> object:
    from sc3d.segmentation.mask_formats.source import MaskFiles, read_masks

    table = _many_classes()
    file = next(
        path
        for path in sorted(folder.iterdir())
        if path.suffix in (".json", ".xml") and path.name != "mapping.json"
    )
    mapping = folder / "mapping.json"
    masks = read_masks(
        MaskFiles(file, "auto", mapping if mapping.exists() else None),
        {f"DJI_000{i}.jpg": (64, 48) for i in (1, 2)},
        table,
    )
    return [mask.read() for mask in masks.values()]


def _build_colored(folder: Path) -> None:
    colors = np.zeros((48, 64, 3), np.uint8)
    colors[:20], colors[30:, :30] = [4, 0, 0], [1, 0, 0]  # of `_read_mask_files`
    folder.mkdir(parents=True, exist_ok=True)
    Image.fromarray(colors).save(folder / "DJI_0001.png")
    palette = Image.fromarray(colors[::2, ::2, 0])
    palette.putpalette([value for index in range(256) for value in (index, 255 - index, 9)])
    palette.save(folder / "DJI_0002.png")
    Image.fromarray(colors[..., 0]).save(folder / "DJI_0003.png")


def _read_colored(folder: Path) -> object:
    """A folder of colors, then one of ids, as `segment --format` takes them."""
    from sc3d.segmentation.mask_formats.pngs import is_colored
    from sc3d.segmentation.mask_formats.source import MaskFiles, read_masks

    found, table = [], _many_classes()
    for number in range(1, 4):
        file = folder / f"DJI_000{number}.png"
        kind = "color" if is_colored(file) else "index"
        ids = folder.parent / f"{folder.name}-{kind}"
        ids.mkdir(exist_ok=True)
        shutil.copyfile(file, ids / "DJI_0001.png")
        found += [
            mask.read()
            for mask in read_masks(MaskFiles(ids, kind), {"DJI_0001.jpg": (64, 48)}, table).values()
        ]
    return found


def _build_strokes(folder: Path) -> None:
    shapes = [
        {
            "label": "road",
            "shape_type": kind,
            "points": [[3.5 + row, 4], [20, 9.25], [30, 28], [9, 20]][:count],
            "width": width,
        }
        for row, (kind, count, width) in enumerate(
            [("linestrip", 3, 5), ("polygon", 4, 0), ("point", 1, 9), ("rectangle", 2, 0), ("circle", 2, 0)]
        )
    ]
    shapes.append({"label": "_background_", "shape_type": "line", "points": [[1, 1], [38, 29]]})
    labelme = {
        "version": "5.5.0",
        "imagePath": "a.jpg",
        "imageWidth": 40,
        "imageHeight": 30,
        "imageData": None,
        "shapes": shapes,
    }
    colors = np.zeros((30, 40, 3), np.uint8)
    colors[:9] = [4, 0, 0]
    _write(folder, a__json=json.dumps(labelme))
    Image.fromarray(colors).save(folder / "b.png")
    _write(folder / "photos", a__jpg=picture("JPEG"), b__jpg=picture("JPEG"))


def _read_strokes(folder: Path) -> object:
    from sc3d.segmentation.strokes.files import read_strokes

    return [strokes.paint(20, 15) for strokes in read_strokes(folder, folder / "photos", _many_classes())]


CORRECTIONS = {
    "version": 1,
    "log": [
        {
            "id": "a",
            "time": "2026-05-01T12:00:00Z",
            "class": "road",
            "balls": [{"radius": 0.5, "centers": [[0, 1, 2], [0.5, 1, 2]]}],
            "cameras": {"a.jpg": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 5]]},
        },
        {
            "id": "b",
            "time": "2026-05-01",
            "class": None,
            "polygon": [[0, 0], [1, 0], [1, 1]],
            "z": [0, 3],
        },
        {"id": "c", "time": "2026-05-02", "undo": "b"},
        {"id": "d", "time": "2026-05-02", "redo": "b"},
    ],
}


def _read_corrections(folder: Path) -> object:
    from sc3d.scene.corrections import read_log, standing

    points = np.zeros((5, 3))
    return [one.shape.contain(points) for one in standing(read_log(folder / "corrections.json"))]


def _many_classes():
    from sc3d.scene.class_table import parse_classes

    names = ["building", "house", "wall", "road", "car", "tree", "grass", "water"]
    return parse_classes(
        [{"id": 1 + row, "name": name, "color": [1 + row, 0, 0]} for row, name in enumerate(names)], "test"
    )


def _copy_mask_file(name: str):
    def build(folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(HERE.parent / "segmentation" / "mask_files" / name, folder / Path(name).name)
        _write(
            folder,
            mapping__json=json.dumps(
                dict.fromkeys(("vehicle", "sky", "person", "roof", "lawn", "thing", "crown"), "road")
            ),
        )

    return build


def _read_project(folder: Path) -> object:
    from sc3d.importers.frames import near_origin
    from sc3d.importers.model import guess_observations
    from sc3d.importers.photos import locate_photos
    from sc3d.importers.project import project_files, read_project
    from sc3d.settings.reconstruction import Import

    path = next(
        (
            file
            for file in folder.iterdir()
            if file.suffix in (".xml", ".opf") or file.name.endswith("parameters.txt")
        ),
        folder,
    )
    project_files(path, Import())
    project, _ = locate_photos(near_origin(read_project(path, Import()), 32615), None)
    return (
        guess_observations(project.views[:1], project.points)
        if project.observations is None
        else project.observations
    )


def _build_project(kind: str):
    def build(folder: Path) -> None:
        from tests.importers import test_importers as made

        views, points = made.fly(), made.probe(20)
        folder.mkdir(parents=True, exist_ok=True)
        if kind == "nerfstudio":
            shutil.copytree(
                HERE.parent / "importers" / "files" / "nerfstudio_opencv", folder, dirs_exist_ok=True
            )
            shutil.rmtree(folder / "colmap", ignore_errors=True)
        elif kind.startswith("opensfm"):
            tracks = "OPENSFM_TRACKS_VERSION_v2\n" + "".join(
                f"{view.name}\t{100 + row}\t{row}\t0.01\t-0.02\t0.001\t1\t2\t3\t-1\t-1\n"
                for view in views
                for row in range(9)
            )
            _write(
                folder,
                reconstruction__json=json.dumps(
                    made.opensfm_json(views, points, PLACE if kind.endswith("place") else None)
                ),
                tracks__csv=tracks,
            )
        elif kind == "metashape":
            reference = 'LOCAL_CS["Local",LOCAL_DATUM["x",0],UNIT["meter",1]]'
            _write(folder, cameras__xml=made.metashape_xml(views, made.metashape_lens(), reference))
        elif kind == "pix4d":
            import pyproj

            (folder / "x_calibrated_camera_parameters.txt").write_text(made.pix4d_text(views))
            (folder / "x_wkt.prj").write_text(pyproj.CRS.from_epsg(32615).to_wkt())
            (folder / "x_offset.xyz").write_text("576000 5188000 0\n")
        elif kind == "opf":
            frame = {
                "crs": {"definition": "EPSG:32615"},
                "base_to_canonical": {"scale": [1, 1, 1], "shift": [-576000, -5188000, 0], "swap_xy": False},
            }
            made.write_opf(folder, views, points, frame)

    return build


def _read_geometries(folder: Path) -> object:
    from sc3d.importers.clouds import read_geometry, to_open3d

    return [to_open3d(read_geometry(file)) for file in sorted(folder.iterdir())]


def _build_las(suffix: str):
    def build(folder: Path) -> None:
        from tests.importers import test_importers as made

        folder.mkdir(parents=True, exist_ok=True)
        made.write_las(folder / f"cloud.{suffix}", made.surveyed(60))

    return build


def _build_pcd(form: str):
    def build(folder: Path) -> None:
        import open3d as o3d

        folder.mkdir(parents=True, exist_ok=True)
        cloud = o3d.t.geometry.PointCloud(
            o3d.core.Tensor(np.random.default_rng(0).normal(size=(30, 3)).astype(np.float32))
        )
        cloud.point.colors = o3d.core.Tensor(np.full((30, 3), 9, np.uint8))
        o3d.t.io.write_point_cloud(
            str(folder / "cloud.pcd"), cloud, write_ascii=form == "ascii", compressed=form == "compressed"
        )

    return build


def _build_texts(folder: Path) -> None:
    rows = "\n".join(f"{row}.5 {row % 7} 1.25 10 20 {row}" for row in range(30))
    _write(
        folder,
        a__xyz=rows,
        b__txt="x,y,z,r,g,b\n" + rows.replace(" ", ","),
        d__obj="v 0 0 0 0.1 0.2 0.3\nv 1 0 0 0 0 0\nv 0 1 0 1 1 1\nv 1 1 0 1 1 1\nf 1 2 3\nf 1/1 2/2 3/3 -1\n",
    )


def _read_control_points(folder: Path) -> object:
    from sc3d.georeferencing.control_points import read_control_points

    return read_control_points(folder / "gcp_list.txt", ["a.jpg", "b.jpg"])


def _one(name: str, content) -> object:
    return lambda folder: _write(
        folder, **{name.replace(".", "__"): content() if callable(content) else content}
    )


GCP = "EPSG:32615\n" + "".join(
    f"{576000 + 10 * i} {5188000 + 7 * i * i} {200 + i} {100 + i} {90 + i} {photo} gcp{i}\n"
    for i in range(4)
    for photo in ("a.jpg", "b.jpg")
)
GEOREFERENCE = json.dumps(
    {
        "epsg": 32615,
        "offset": [576000, 5188000, 0],
        "origin": list(PLACE),
        "local_from_world": np.eye(4).tolist(),
        "altitude_offset": 0.5,
        "figures": {"gps": {"rms": 1}},
    }
)
PARTS = ("cameras", "images", "points3D")
PROJECT_FILES = {
    "opensfm-place": ("reconstruction.json",),
    "nerfstudio": ("transforms.json", "sparse_pc.ply"),
    "opensfm": ("reconstruction.json", "tracks.csv"),
    "metashape": ("cameras.xml",),
    "pix4d": ("x_calibrated_camera_parameters.txt", "x_wkt.prj", "x_offset.xyz"),
    "opf": ("site.opf", "camera-list.json", "calibrated-cameras.json", "tracks.gltf", "tracks.bin"),
}

READERS: dict[str, Reader] = {
    "corrections": Reader(
        _one("corrections.json", lambda: json.dumps(CORRECTIONS).encode()),
        _read_corrections,
        ("corrections.json",),
    ),
    "colmap-binary": Reader(
        lambda folder: _build_model(folder, False),
        _read_model,
        tuple(f"{name}.bin" for name in (*PARTS, "rigs", "frames")),
    ),
    "colmap-text": Reader(
        lambda folder: _build_model(folder, True), _read_model, tuple(f"{name}.txt" for name in PARTS)
    ),
    "ply-cloud": Reader(_one("cloud.ply", labelled_ply), _read_cloud, ("cloud.ply",)),
    "ply-cloud-text": Reader(_one("cloud.ply", lambda: labelled_ply("ascii")), _read_cloud, ("cloud.ply",)),
    "ply-cloud-big": Reader(
        _one("cloud.ply", lambda: labelled_ply("binary_big_endian")), _read_cloud, ("cloud.ply",)
    ),
    "ply-mesh": Reader(_one("mesh.ply", lambda: mesh_ply(LITTLE)), _read_mesh, ("mesh.ply",)),
    "ply-mesh-text": Reader(_one("mesh.ply", lambda: mesh_ply("ascii")), _read_mesh, ("mesh.ply",)),
    "labelled": Reader(_one("seeds.ply", labelled_ply), _read_labelled, ("seeds.ply",)),
    "splats": Reader(_one("gaussians.ply", splats_ply), _read_splats, ("gaussians.ply",)),
    "checkpoint": Reader(_build_checkpoint, _read_checkpoint, ("train.checkpoint",)),
    "photos": Reader(_build_photos, _read_photos, ("a.jpg", "b.jpg", "c.png", "d.tif", "e.tif", "f.tif")),
    "masks": Reader(_build_masks, _read_masks, ("a.png", "b.png")),
    "classes": Reader(_one("classes.json", json.dumps(CLASSES)), _read_classes, ("classes.json",)),
    "georeference": Reader(
        _one("georeference.json", GEOREFERENCE), _read_georeference, ("georeference.json",)
    ),
    "sidecars": Reader(_build_sidecars, _read_sidecars, ("seeds.ply.json", "metrics.json")),
    "weights": Reader(
        lambda folder: _write(
            folder / "model",
            config__json='{"model_type": "sam2", "architectures": ["A"]}',
            a__safetensors=b"",
        ),
        _read_weights,
        ("model/config.json",),
    ),
    "coco": Reader(_copy_mask_file("coco.json"), _read_mask_files, ("coco.json", "mapping.json")),
    "coco-compressed": Reader(
        _copy_mask_file("coco_compressed.json"), _read_mask_files, ("coco_compressed.json",)
    ),
    "labelme": Reader(_copy_mask_file("labelme/DJI_0001.json"), _read_mask_files, ("DJI_0001.json",)),
    "masks-color": Reader(
        _build_colored, _read_colored, tuple(f"DJI_000{number}.png" for number in range(1, 4))
    ),
    "strokes": Reader(_build_strokes, _read_strokes, ("a.json", "b.png")),
    "cvat": Reader(_copy_mask_file("cvat.xml"), _read_mask_files, ("cvat.xml",)),
    **{kind: Reader(_build_project(kind), _read_project, files) for kind, files in PROJECT_FILES.items()},
    "las": Reader(_build_las("las"), _read_geometries, ("cloud.las",)),
    "laz": Reader(_build_las("laz"), _read_geometries, ("cloud.laz",)),
    **{
        f"pcd-{form}": Reader(_build_pcd(form), _read_geometries, ("cloud.pcd",))
        for form in ("ascii", "binary", "compressed")
    },
    "text-clouds": Reader(_build_texts, _read_geometries, ("a.xyz", "b.txt", "d.obj")),
    "control-points": Reader(_one("gcp_list.txt", GCP), _read_control_points, ("gcp_list.txt",)),
}
