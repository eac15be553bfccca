"""Where sc3d runs: other paths to the same scene, no place for caches, missing libraries, full disks, few photos,
many classes; and what is left out is told.
"""

from __future__ import annotations

import errno
import importlib
import json
import logging
import os
import re
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from sc3d import cli
from sc3d.errors import InputError, Sc3dError
from sc3d.exporters.packages import load
from sc3d.io import atomic, caches, requirements
from sc3d.io.clouds import read_cloud, write_geometry
from sc3d.io.provenance import PhotoFrames, digest
from sc3d.runner import execute, sidecar
from sc3d.scene.channels import Channels
from sc3d.scene.corrections import Balls, add_correction
from sc3d.scene.labelled_cloud import read_votes, vote_channels
from sc3d.scene.scene import Scene, SparseModel, require_views
from sc3d.settings.labels import Evaluate, Label, Propagate, Segment
from sc3d.settings.reconstruction import Import
from sc3d.stages import evaluate as evaluate_stage
from sc3d.stages import label as label_stage
from sc3d.stages import propagate as propagate_stage
from sc3d.stages.extract import _depth_range, _require_room
from sc3d.tiling import evaluate as tiled_evaluate
from sc3d.tiling import label as tiled_label
from sc3d.tiling import propagate as tiled_propagate
from sc3d.tiling.label_grid_file import write_field
from sc3d.tiling.work_folder import WorkFolder
from tests import builders
from tests.extraction.builders import data as five_views
from tests.extraction.builders import flat_square, surface_of


@dataclass(frozen=True)
class Copying:
    """Settings of a stage that copies its input."""

    source: Path | None = None
    output: Path | None = None
    model_dir: Path | None = None
    factor: int = 1


@pytest.fixture
def copying(monkeypatch):
    """The stage `copying`, which counts how often it runs."""
    runs: list[Path] = []

    def outputs(scene: Scene, settings: Copying) -> list[Path]:
        return [settings.output or scene.path / "copy.txt"]

    def run(scene: Scene, settings: Copying) -> dict:
        runs.append(scene.path)
        shutil.copyfile(settings.source or scene.path / "source.txt", outputs(scene, settings)[0])
        return {}

    stage = SimpleNamespace(
        inputs=lambda scene, settings: [scene.images, settings.source or scene.path / "source.txt"],
        outputs=outputs,
        run=run,
    )
    monkeypatch.setitem(sys.modules, "sc3d.stages.copying", stage)
    return runs


@pytest.fixture
def site(tmp_path, monkeypatch) -> Path:
    """A scene folder whose photos lie elsewhere; the working folder is its parent."""
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "a.jpg").write_bytes(b"a")
    scene = tmp_path / "site"
    scene.mkdir()
    (scene / "images").symlink_to(tmp_path / "photos")
    (scene / "source.txt").write_text("content")
    monkeypatch.chdir(tmp_path)
    return scene


def test_a_scene_is_the_same_by_every_path(copying, site, tmp_path, monkeypatch):
    execute("copying", Scene(Path("site")), Copying())
    link = tmp_path / "link"
    link.symlink_to(site)
    for path in (Path("site"), site, link, Path("./photos/../site"), Path("site/")):
        execute("copying", Scene(path), Copying())
    monkeypatch.chdir(site)
    execute("copying", Scene(Path(".")), Copying())
    assert len(copying) == 1
    inputs = json.loads((site / "copy.txt.json").read_text())["inputs"]
    assert list(inputs) == ["images", "source.txt"]


@pytest.mark.parametrize("move", [shutil.move, lambda old, new: shutil.copytree(old, new, symlinks=True)])
def test_a_moved_or_copied_scene_is_finished(copying, site, tmp_path, move):
    execute("copying", Scene(site), Copying())
    move(str(site), str(tmp_path / "elsewhere"))
    execute("copying", Scene(tmp_path / "elsewhere"), Copying())
    assert len(copying) == 1


def test_inputs_given_by_path_count_by_content(copying, site, tmp_path, monkeypatch):
    other = tmp_path / "other.txt"
    other.write_text("more")
    spelled = [other, Path("other.txt"), Path("site/../other.txt")]
    for source in spelled:
        execute("copying", Scene(site), Copying(source=source))
    monkeypatch.chdir(site)
    execute("copying", Scene(site), Copying(source=Path("../other.txt")))
    assert len(copying) == 1
    for source in (None, Path("source.txt"), site / "source.txt"):  # the scene's own, by name or not
        execute("copying", Scene(site), Copying(source=source))
    assert len(copying) == 2
    execute("copying", Scene(site), Copying(output=site / "copy.txt"))
    assert len(copying) == 2


def test_other_content_settings_and_folders_run_again(copying, site, tmp_path):
    execute("copying", Scene(site), Copying())
    (site / "source.txt").write_text("other")
    execute("copying", Scene(site), Copying())
    execute("copying", Scene(site), Copying(factor=2))
    execute("copying", Scene(site), Copying(factor=2, model_dir=tmp_path / "photos"))
    assert len(copying) == 4
    execute("copying", Scene(site), Copying(factor=2, model_dir=Path("photos")))  # the same folder
    assert len(copying) == 4
    (tmp_path / "photos" / "a.jpg").rename(tmp_path / "photos" / "b.jpg")
    execute("copying", Scene(site), Copying(factor=2, model_dir=Path("photos")))
    assert len(copying) == 5


@pytest.mark.parametrize("prefix", ["", "site/", "/gone/before/"])
def test_sidecars_of_earlier_versions_stay_valid(copying, site, prefix):
    execute("copying", Scene(site), Copying(source=site / "source.txt"))
    file = sidecar(site / "copy.txt")
    record = json.loads(file.read_text())
    record["inputs"] = {prefix + name: digest for name, digest in record["inputs"].items()}
    record["settings"]["source"] = f"{prefix}source.txt"
    file.write_text(json.dumps(record))
    execute("copying", Scene(Path("site")), Copying(source=Path("site/source.txt")))
    assert len(copying) == 1
    record["inputs"][f"{prefix}source.txt"] = "other content"
    file.write_text(json.dumps(record))
    execute("copying", Scene(Path("site")), Copying(source=Path("site/source.txt")))
    assert len(copying) == 2


@pytest.mark.parametrize(
    ("unknown", "asked", "again"),
    [
        (["model_dir", "output"], Copying(), False),
        (["factor"], Copying(), True),  # who knows how it was before
        (["model_dir"], Copying(model_dir=Path("photos")), True),
        (["source"], Copying(factor=2), True),
    ],
)
def test_options_that_a_sidecar_does_not_know_count_as_off(copying, site, unknown, asked, again):
    execute("copying", Scene(site), Copying())
    record = json.loads(sidecar(site / "copy.txt").read_text())
    for name in unknown:
        del record["settings"][name]
    sidecar(site / "copy.txt").write_text(json.dumps(record))
    execute("copying", Scene(site), asked)
    assert len(copying) == 1 + again


def test_unfinished_tiles_are_found_by_every_path(site, tmp_path):
    cloud = site / "cloud.ply"
    cloud.write_bytes(b"1")
    made = WorkFolder(site / "seeds.ply", "label", [cloud, site / "images"], Label(cloud=cloud))
    made.subfolder("tiles")
    here = WorkFolder(
        Path("site/seeds.ply"), "label", [Path("site/cloud.ply"), Path("site/images")], Label(cloud=Path("x"))
    )
    assert here.folder == made.folder and (here.folder / "tiles").is_dir()


def test_unfinished_tiles_go_with_the_content_of_their_inputs(tmp_path):
    """Another file of the same size, to which `cp -p` has given the same time."""
    cloud = tmp_path / "cloud.ply"
    cloud.write_bytes(b"1")
    found = cloud.stat()
    made = WorkFolder(tmp_path / "seeds.ply", "label", [cloud], Label())
    cloud.write_bytes(b"2")
    os.utime(cloud, ns=(found.st_atime_ns, found.st_mtime_ns))
    assert WorkFolder(tmp_path / "seeds.ply", "label", [cloud], Label()).folder != made.folder


@pytest.mark.parametrize(
    ("stage", "tiled", "settings", "read_later"),
    [
        (label_stage, tiled_label, Label(), []),
        (
            propagate_stage,
            tiled_propagate,
            Propagate(),
            ["georeference.json"],
        ),  # for objects, likewise at the end
        (evaluate_stage, tiled_evaluate, Evaluate(), ["masks"]),  # judged beside, when all tiles are done
    ],
)
def test_unfinished_tiles_go_with_each_input_of_their_stage(
    tmp_path, monkeypatch, stage, tiled, settings, read_later
):
    scene, found = builders.labelled_scene(tmp_path / "scene"), []
    shutil.copyfile(scene.labelled, scene.seeds)
    cloud = read_cloud(scene.seeds)
    for name, kind in (("normals", np.float32), ("num_views", np.int32)):
        cloud.point[name] = np.ones((len(cloud.point.positions), 3 if name == "normals" else 1), kind)
    for file in (scene.seeds, scene.labelled):
        write_geometry(file, cloud)
    add_correction(scene, "grass", Balls(((builders.ORIGIN[None], 1.0),)))

    def keep(output: Path, name: str, inputs: list, settings: object) -> None:
        found.extend(inputs)
        raise InterruptedError

    monkeypatch.setattr(tiled, "WorkFolder", keep)
    with pytest.raises(InterruptedError):
        getattr(tiled, f"{stage.__name__.rpartition('.')[2]}_scene")(scene, settings)
    later = {scene.path / name for name in read_later}
    assert set(stage.inputs(scene, settings)) - later <= set(found)


def turn(photo: Path) -> None:
    with Image.open(photo) as image:
        exif = image.getexif()
        exif[0x0112] = 3
        image.save(photo, exif=exif)


def test_frames_of_photos_are_names_sizes_orientation_and_alpha(tmp_path):
    photos = tmp_path / "images"
    photos.mkdir()

    def state() -> str:
        return digest(PhotoFrames(photos))

    assert state() == ""
    seen = {state()}
    colors = Image.new("RGB", (8, 6), "red"), Image.new("RGB", (8, 6), "blue")
    for change in (
        lambda: colors[0].save(photos / "a.jpg"),
        lambda: turn(photos / "a.jpg"),
        lambda: colors[0].save(photos / "a.jpg", xmp=b"<x:xmpmeta>pitch</x:xmpmeta>"),
        lambda: Image.new("RGB", (6, 8)).save(photos / "a.jpg"),
        lambda: Image.new("RGBA", (6, 8), (0, 0, 0, 255)).save(photos / "b.png"),
        lambda: Image.new("RGBA", (6, 8), (0, 0, 0, 0)).save(photos / "b.png"),
        lambda: (photos / "b.png").rename(photos / "c.png"),
        lambda: (photos / "d.jpg").write_bytes(b"damaged"),
        lambda: (photos / "d.jpg").write_bytes(b"Damaged"),
    ):
        change()
        assert state() not in seen
        seen.add(state())
    (photos / "d.jpg").unlink()
    colors[0].save(photos / "a.jpg")
    before = state()
    colors[1].save(photos / "a.jpg")  # other colors: no label changes
    assert state() == before


@pytest.mark.parametrize("stage", ["label", "evaluate", "refine", "masks"])
def test_photos_that_were_turned_are_looked_at_again(tmp_path, caplog, monkeypatch, stage):
    scene = builders.labelled_scene(tmp_path / "scene")
    name, settings = {
        "label": ("label", Label()),
        "evaluate": ("evaluate", Evaluate()),
        "refine": ("segment", Segment(refine=True)),
        "masks": ("segment", Segment(masks=scene.truth)),
    }[stage]
    module, times = importlib.import_module(f"sc3d.stages.{name}"), []
    run = module.run if stage != "evaluate" else lambda *_: scene.metrics.write_text("{}") and {}
    monkeypatch.setattr(module, "run", lambda *both: (times.append(1), run(*both))[1])
    if stage == "refine":
        from sc3d.segmentation.mask_refinement import Refinement

        monkeypatch.setattr(Refinement, "helps", True)
    for photo in (None, None, scene.images / "photo_1.jpg", None):
        if photo is not None:
            turn(photo)
        execute(name, scene, settings)
    assert len(times) == 2


def test_a_cloud_from_outside_goes_with_the_place_of_the_scene(tmp_path):
    """By its CRS it is brought into the world, which the georeference says."""
    scene = builders.labelled_scene(tmp_path / "scene")
    cloud = scene.labelled
    label = importlib.import_module("sc3d.stages.label").inputs
    assert scene.path / "georeference.json" in label(scene, Label(cloud=cloud))
    imports = importlib.import_module("sc3d.stages.import_project").inputs
    settings = Import(source="cloud", project=cloud, cloud=(cloud,))
    assert {scene.sparse, scene.path / "georeference.json"} <= set(imports(scene, settings))


@pytest.mark.skipif(sys.platform != "linux", reason="holes are made otherwise elsewhere")
def test_files_of_holes_are_not_read_for_hours(tmp_path):
    file = tmp_path / "cloud.ply"
    file.write_bytes(b"ply\n")
    os.truncate(file, 1 << 40)
    with pytest.raises(InputError, match="next to nothing is on the disk"):
        digest(file)
    file.unlink()
    file.write_bytes(bytes(1 << 12))
    os.truncate(file, 1 << 20)  # small: some disks keep few bytes of what is alike
    assert digest(file)


def test_a_scene_that_cannot_be_written_is_still_read(tmp_path, monkeypatch, caplog, capsys):
    """From an archive or another user: what is finished is finished, and outputs may lie elsewhere."""
    scene = builders.labelled_scene(tmp_path / "scene")
    cli.main(["label", str(scene.path)])
    before = atomic._is_writable
    monkeypatch.setattr(
        atomic, "_is_writable", lambda folder: scene.path not in (folder, *folder.parents) and before(folder)
    )
    cli.main(["label", str(scene.path)])
    assert "up to date" in caplog.text
    cli.main(["propagate", str(scene.path), "--method", "knn", "--output", str(tmp_path / "labelled.ply")])
    assert (tmp_path / "labelled.ply").is_file()
    with pytest.raises(SystemExit) as stopped:
        cli.main(["propagate", str(scene.path)])
    assert stopped.value.code == 2 and "cannot write to" in capsys.readouterr().err


def test_closed_streams_lead_to_nowhere(tmp_path):
    """Else the next file that is opened gets the number of standard output, and what libraries print."""
    command = f"{sys.executable} -c 'from sc3d.cli import main; main()'"
    environment = os.environ | {"PYTHONPATH": str(builders.ROOT)}
    for rest, status in ((" --help >&-", 0), (" --help >&- 2>&- <&-", 0), (" nothing 2>&-", 2)):
        done = subprocess.run(command + rest, shell=True, env=environment, capture_output=True, cwd=tmp_path)
        assert done.returncode == status and not done.stderr
    program = (
        "import os, sys; from sc3d.cli import open_closed_streams as fill; fill(); "
        "file = open('out', 'w'); os.write(1, b'printed'); print(file.fileno() > 2)"
    )
    shell = f'{sys.executable} -c "{program}" >&- 2>&-'
    assert subprocess.run(shell, shell=True, env=environment, cwd=tmp_path).returncode == 0
    assert (tmp_path / "out").read_text() == ""


def test_home_is_meant_by_a_tilde():
    assert cli.expanded(["~/site", "--masks=~/masks", "--name", "a~b"]) == [
        os.path.expanduser("~/site"),
        f"--masks={os.path.expanduser('~/masks')}",
        "--name",
        "a~b",
    ]


# ------------------------------------------------------------------------------------------ caches and libraries


@pytest.fixture
def temporary(tmp_path, monkeypatch) -> Path:
    """A folder of temporary files for all users."""
    folder = tmp_path / "tmp"
    folder.mkdir()
    folder.chmod(0o1777)
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    return folder


def test_caches_go_to_a_private_folder_where_nothing_else_can_be_written(temporary, monkeypatch):
    for variable in caches.CACHES:
        monkeypatch.delenv(variable, raising=False)
    monkeypatch.setattr(caches, "can_be_made", lambda folder: False)
    caches.provide_caches()
    kept = Path(os.environ["NUMBA_CACHE_DIR"])
    assert kept.parent.parent == temporary and kept.parent.stat().st_mode & 0o777 == 0o700
    assert str(kept) in caches.kernel_cache() and "NUMBA_CACHE_DIR" in caches.kernel_cache()
    assert caches.private_folder() == kept.parent  # the next run finds it
    monkeypatch.setenv("NUMBA_CACHE_DIR", "/mine")
    caches.provide_caches()
    assert os.environ["NUMBA_CACHE_DIR"] == "/mine"


@pytest.mark.parametrize("trap", ["open", "link", "file", "parent"])
def test_a_folder_that_others_can_change_holds_no_code(temporary, trap):
    usual = temporary / f"{caches.PREFIX}-{os.geteuid()}"
    if trap == "open":
        usual.mkdir()
        usual.chmod(0o777)
    elif trap == "link":
        (temporary / "theirs").mkdir(mode=0o700)
        usual.symlink_to(temporary / "theirs")
    elif trap == "file":
        usual.write_text("")
    else:
        temporary.chmod(0o777)  # not sticky
    folder = caches.private_folder()
    assert folder is not None and folder != usual and folder.stat().st_mode & 0o777 == 0o700


def test_places_for_caches(tmp_path, monkeypatch):
    assert caches.can_be_made(tmp_path / "a" / "b")
    (tmp_path / "file").write_text("")
    assert not caches.can_be_made(tmp_path / "file" / "b") and not caches.can_be_made(Path("/proc/1/b"))
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setenv("HOME", "relative")
    assert not caches.can_be_made(caches._user_caches())


@pytest.mark.parametrize(
    "error, told",
    [
        (
            ImportError("libGL.so.1: cannot open shared object file: No such file"),
            "libgl1 libegl1 libusb-1.0-0",
        ),
        (OSError("libusb-1.0.so.0: cannot open shared object file: No such"), "libusb-1.0-0"),
        (
            ImportError("libexpat.so.1: cannot open shared object file: No such"),
            "apt-get install .*libexpat1",
        ),
        (ImportError("libodd.so.7: cannot open shared object file: No such"), "apt-file search libodd.so.7"),
        (ImportError("/lib/libc.so.6: version `GLIBC_2.38' not found (required by /a/b.so)"), "GLIBC_2.38"),
        (ModuleNotFoundError("No module named 'rasterio'", name="rasterio"), r"pip install 'sc3d\[geo\]'"),
        (ModuleNotFoundError("No module named 'cv2'", name="cv2"), "pip install opencv-python-headless"),
        (RuntimeError("cannot cache function 'f': no locator available for file"), "NUMBA_CACHE_DIR"),
        (MemoryError("Unable to allocate 8 GiB"), "8 GiB.*--max-memory"),
        (OSError(errno.ENOMEM, "Cannot allocate memory"), "not enough memory"),
    ],
)
def test_what_is_missing_is_told_in_one_line(error, told, monkeypatch, capsys):
    def dispatch(name: str, command: object) -> None:
        raise error

    monkeypatch.setattr(cli, "_dispatch", dispatch)
    with pytest.raises(SystemExit) as ended:
        cli.main(["doctor"])
    line = capsys.readouterr().err.strip()
    assert ended.value.code == 1 and "\n" not in line and line.startswith("sc3d: ")
    assert re.search(told, line), line


def test_errors_of_our_own_keep_their_traceback(monkeypatch):
    for error in (AttributeError("no x"), RuntimeError("odd"), ImportError("cannot import name 'x'")):
        monkeypatch.setattr(cli, "_dispatch", lambda *_, error=error: (_ for _ in ()).throw(error))
        with pytest.raises(type(error)):
            cli.main(["doctor"])


def test_packages_that_are_too_old_are_named(monkeypatch):
    monkeypatch.setattr(requirements.metadata, "requires", lambda name: ["numpy>=1.26", "tyro>=1.0"])
    monkeypatch.setattr(requirements.metadata, "version", lambda name: {"numpy": "1.25.2", "tyro": "1"}[name])
    assert requirements.outdated() == ["numpy 1.25.2 is older than 1.26"]
    assert "numpy 1.25.2" in (requirements.explain(AttributeError("module has no 'trapezoid'")) or "")


def test_a_missing_library_is_no_missing_package(monkeypatch, tmp_path):
    (tmp_path / "odd_geo.py").write_text("raise ImportError('libexpat.so.1: cannot open shared object file')")
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(ImportError, match="libexpat"):
        load("odd_geo")


# ------------------------------------------------------------------------------------------------- disks and memory


@pytest.mark.parametrize("words", [None, "12 requested and 5 written", "database or disk is full"])
def test_the_folder_that_is_full_is_named(copying, site, temporary, monkeypatch, words):
    def run(scene: Scene, settings: Copying) -> dict:
        raise OSError(errno.ENOSPC, "No space left on device") if words is None else OSError(words)

    monkeypatch.setattr(sys.modules["sc3d.stages.copying"], "run", run)
    rooms = {str(temporary): 100, str(site): 10**9}
    monkeypatch.setattr(atomic, "_free_bytes", lambda folder: rooms.get(str(folder), 10**10))
    with pytest.raises(Sc3dError, match=f"no space left in {temporary}: .*TMPDIR"):
        execute("copying", Scene(site), Copying())
    rooms[str(temporary)] = 10**9
    rooms[str(site)] = 100
    with pytest.raises(Sc3dError, match=f"no space left in {site}: make room, and"):
        execute("copying", Scene(site), Copying())


def test_depth_maps_need_room_before_they_are_rendered(temporary, monkeypatch):
    monkeypatch.setattr(atomic, "_free_bytes", lambda folder: 1 << 18)
    with pytest.raises(OSError) as error:
        _require_room(five_views())
    assert atomic.full_folder(error.value, []) == temporary


def test_outputs_that_cannot_be_written_are_refused_before_the_work(copying, site, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot write to"):
        execute("copying", Scene(site), Copying(output=tmp_path / "file" / "copy.txt"))
    assert not copying


# ----------------------------------------------------------------------------------------------------- few photos


@pytest.mark.parametrize("count", [2, 3])
def test_two_and_three_photos_give_a_surface(count):
    whole = five_views()
    neighbors = [np.array([other for other in range(count) if other != row]) for row in range(count)]
    few = replace(whole, views=whole.views[:count], neighbors=neighbors)
    found = surface_of(flat_square(4.0, 0.5), few)
    points = found.cloud.point.positions.numpy()
    inner = np.abs(points[:, :2]).max(axis=1) < 3.5
    assert inner.sum() > 1000 and np.abs(points[inner, 2] - 0.5).max() < 0.1


def model_scene(tracks: list[list[int]]) -> SimpleNamespace:
    points = np.random.default_rng(0).uniform(-1, 1, (20, 3)) + builders.ORIGIN
    model = SparseModel(
        builders.views()[: len(tracks)],
        points,
        points.astype(np.uint8),
        [np.array(rows, int) for rows in tracks],
    )
    return SimpleNamespace(model=model, sparse=Path("sparse/0"))


@pytest.mark.parametrize(
    "tracks, told", [([[0, 1]], "has 1 photos .* at least 2"), ([[0, 1], [2, 3], []], "no two photos")]
)
def test_too_few_photos_are_refused_before_training(tracks, told):
    with pytest.raises(InputError, match=told):
        require_views(model_scene(tracks))


def test_photos_that_overlap_with_no_other_are_named(caplog):
    require_views(model_scene([[0, 1], [1, 2], [5]]))
    assert "1 of 3 photos share no sparse point" in caplog.text and "photo_2.jpg" in caplog.text
    caplog.clear()
    require_views(model_scene([[], []]))  # a model that does not tell what photos see
    assert not caplog.text


def test_depth_is_known_without_tracks_and_without_points():
    tracked = model_scene([[*range(20)], [*range(20)]]).model
    untracked = replace(tracked, tracks=[np.zeros(0, int)] * 2)
    bare = replace(untracked, points=np.zeros((0, 3)))
    ranges = [_depth_range(model, tracked.points) for model in (tracked, untracked, bare)]
    assert ranges[0] == ranges[1] == ranges[2] and 5 < ranges[0][0] < ranges[0][1] < 13
    with pytest.raises(InputError, match="do not belong together"):
        _depth_range(bare, np.zeros((4, 3)))


# ---------------------------------------------------------------------------------------------------- many classes


def renumbered_scene(path: Path, ids: dict[int, int]) -> Scene:
    """The bare scene with other class ids."""
    builders.write_bare_scene(path)
    cloud = read_cloud(path / "cloud.ply")
    cloud.point.normals = np.tile(np.float32([0, 0, 1]), (len(cloud.point.positions), 1))
    write_geometry(path / "cloud.ply", cloud)
    classes = [entry | {"id": ids[entry["id"]]} for entry in builders.CLASSES]
    (path / "classes.json").write_text(json.dumps(classes))
    for file in [*(path / "masks").iterdir(), *(path / "truth").iterdir()]:
        mask, table = np.array(Image.open(file)), np.zeros(256, np.uint8)
        table[list(ids)] = list(ids.values())
        Image.fromarray(table[mask]).save(file)
    return Scene(path)


def test_channels_follow_the_classes():
    plain, sparse = Channels.of_classes([3, 1, 2]), Channels.of_classes([255, 1])
    labels = np.array([0, 1, 2, 3], np.uint8)
    assert plain.from_ids(labels) is labels and plain.to_ids(labels) is labels
    assert sparse.count == 3 and sparse.from_ids(np.array([0, 255, 1], np.uint8)).tolist() == [0, 2, 1]
    assert sparse.to_ids(np.array([0, 2, 1], np.uint8)).tolist() == [0, 255, 1]
    for channels in (plain, sparse):
        with pytest.raises(InputError, match="votes_7"):
            channels.from_ids(np.array([7], np.uint8))
    assert vote_channels(["votes_0", "votes_9", "votes_x", "votes_1000"]).ids.tolist() == [0, 9]
    assert vote_channels(["votes_1"]) is None and vote_channels(["label"]) is None


@pytest.mark.parametrize("in_tiles", [False, True])
def test_ids_with_gaps_cost_and_give_what_dense_ids_do(tmp_path, monkeypatch, in_tiles):
    if in_tiles:
        monkeypatch.setattr(tiled_label, "fits", lambda *_: False)
        monkeypatch.setattr(tiled_propagate, "fits", lambda *_: False)
        monkeypatch.setattr(tiled_label, "max_points", lambda *_: 3000)
        monkeypatch.setattr(tiled_propagate, "max_points", lambda *_: 3000)
    found = []
    for ids in ({1: 1, 3: 2}, {1: 1, 3: 255}):
        scene = renumbered_scene(tmp_path / f"scene{ids[3]}", ids)
        execute("label", scene, Label(surface="surfels"))
        execute("propagate", scene, Propagate())
        seeds, labelled = read_cloud(scene.seeds), read_cloud(scene.labelled)
        votes = read_votes(seeds)
        assert votes is not None and votes.channels.ids.tolist() == [0, 1, ids[3]]
        with np.load(scene.votes) as field:
            assert field["value_000"].shape[-1] == 2 * 4  # nothing seen, two classes, none of them
            assert ("class_ids" in field) == (ids[3] == 255)
            if ids[3] == 255:
                assert field["class_ids"].tolist() == [0, 1, 255]
            counts = field["value_000"]
        back = np.zeros(256, np.uint8)
        back[[1, ids[3]]] = 1, 2
        labels = [back[cloud.point["label"].numpy().ravel()] for cloud in (seeds, labelled)]
        assert (labels[1] > 0).mean() > 0.9
        found.append((counts, votes.values, *labels, labelled.point["confidence"].numpy()))
        if in_tiles:
            continue
        execute("evaluate", scene, Evaluate())
        assert json.loads(scene.metrics.read_text())["labels"]["oa"] > 0.9
    assert all(np.array_equal(first, second) for first, second in zip(*found, strict=True))


def test_room_is_reckoned_by_classes(tmp_path):
    scene = Scene(builders.write_bare_scene(tmp_path / "scene"))
    few = tiled_label.bytes_per_point(scene)
    scene.classes.write_text(
        json.dumps(
            [{"id": label, "name": f"class {label}", "color": [0, 0, label]} for label in range(1, 151)]
        )
    )
    many = tiled_label.bytes_per_point(scene)
    assert few == tiled_label.LEAST_BYTES and many > 10 * few
    assert tiled_propagate.bytes_per_point(6) == tiled_propagate.LEAST_BYTES
    assert tiled_propagate.bytes_per_point(151) > 8 * tiled_propagate.bytes_per_point(6)


def test_a_field_of_many_classes_is_written_in_small_parts(tmp_path, monkeypatch):
    blocks = np.arange(40 * 6, dtype=np.int32).reshape(40, 1, 1, 1, 6)
    parts = {"keys": np.stack([np.arange(40)[::-1]] * 3, axis=1).astype(np.int32), "field": blocks}
    results = SimpleNamespace(read=lambda tile, name, mapped=False: parts[name])
    monkeypatch.setattr("sc3d.tiling.label_grid_file.HELD", 100)
    write_field(results, [0], {"voxel_size": np.ones(1)}, tmp_path / "votes.npz")
    with np.load(tmp_path / "votes.npz") as field:
        assert np.array_equal(field["value_000"], blocks[::-1])


# ------------------------------------------------------------------------------------------------------ left out


def test_photos_that_do_not_vote_are_told(tmp_path, caplog):
    caplog.set_level(logging.INFO)
    scene = Scene(builders.write_bare_scene(tmp_path / "scene"))
    (scene.masks / "photo_0.png").unlink()
    (scene.truth / "photo_1.png").unlink()
    scene.confidence.mkdir()
    Image.fromarray(np.full((120, 160), 255, np.uint8)).save(scene.confidence / "photo_1.png")
    execute("label", scene, Label(surface="surfels"))
    assert "1 of 5 photos have no mask and do not vote: photo_0.jpg" in caplog.text
    assert "3 of 5 photos have no confidence map" in caplog.text
    execute("propagate", scene, Propagate(method="knn"))
    execute("evaluate", scene, Evaluate())
    assert "1 of 5 photos have no truth and are not judged: photo_1.jpg" in caplog.text
    assert "1 of 4 photos with truth have no mask" in caplog.text
