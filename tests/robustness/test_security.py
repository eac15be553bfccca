"""Other users of the machine, other pages of the browser, and scenes that somebody else has packed: nothing of
the user's is reached through them.
"""

from __future__ import annotations

import ctypes
import importlib
import json
import logging
import os
import shutil
import signal
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from email.message import Message
from http.client import HTTPConnection
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import psutil
import pytest

from sc3d.cli import main
from sc3d.errors import InputError, Sc3dError
from sc3d.io import atomic
from sc3d.io.atomic import claim, remove
from sc3d.io.local_page import LocalPage
from sc3d.io.messages import PlainText
from sc3d.settings.common import Workers
from sc3d.tiling import worker_pool
from sc3d.tiling.executor import open_executor

ROOT = Path(__file__).parents[2]
NOBODY = 65534
linux = pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")
ENVIRONMENT = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}


# ---- workers


def process_of(_: int) -> int:
    time.sleep(0.2)  # so that both have something to do
    return os.getpid()


def killed_once(item: tuple[Path, int]) -> int:
    """The first worker that gets the second task dies at it."""
    folder, number = item
    if number == 1:
        with suppress(FileExistsError):
            (folder / "killed").mkdir()
            os.kill(os.getpid(), signal.SIGKILL)
    return number * number


def always_killed(_: int) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def wrong(number: int) -> int:
    if number == 1:
        raise InputError("the mask is missing")
    return {2: "b"}[number]


def hang(folder: Path) -> None:
    (folder / str(os.getpid())).touch()
    time.sleep(600)


def listening(processes: list[int]) -> list[str]:
    """Addresses at which processes wait for others: ports, and sockets with a name."""
    found = []
    for number in processes:
        for connection in psutil.Process(number).net_connections("all"):
            if connection.status == psutil.CONN_LISTEN:
                found.append(f"{connection.laddr.ip}:{connection.laddr.port}")
            elif connection.family == socket.AF_UNIX and connection.laddr:
                found.append(str(connection.laddr))
    return found


@pytest.fixture(scope="module")
def workers() -> Iterator[list[int]]:
    """Numbers of two processes that wait for work, and of all that were started for them."""
    before = {child.pid for child in psutil.Process().children(recursive=True)}
    with open_executor(Workers(workers=2)) as executor:
        assert len(set(executor.run("who", process_of, range(6)))) == 2
        yield [child.pid for child in psutil.Process().children(recursive=True) if child.pid not in before]


@linux
def test_local_workers_wait_at_no_port_and_no_named_socket(workers):
    assert len(workers) >= 2 and not listening([os.getpid(), *workers])


@linux
@pytest.mark.skipif(os.name == "nt" or os.geteuid() != 0, reason="needs root, to become another user")
def test_another_user_reaches_no_worker(workers):
    def as_nobody(command: str) -> int:
        return subprocess.run(
            ["/bin/bash", "-c", command],
            user=NOBODY, group=NOBODY, extra_groups=[], cwd="/", stderr=subprocess.DEVNULL, timeout=20,
        ).returncode  # fmt: skip

    server = socket.create_server(("127.0.0.1", 0))
    assert as_nobody(f"exec 3<>/dev/tcp/127.0.0.1/{server.getsockname()[1]}") == 0  # the way there is open
    server.close()
    reached = [
        address
        for address in listening([os.getpid(), *workers])
        if as_nobody(f"exec 3<>/dev/tcp/{address.replace(':', '/')}") == 0
    ]
    reached += [str(number) for number in workers if as_nobody(f"ls /proc/{number}/fd/") == 0]
    assert not reached


def test_a_killed_worker_costs_time_only(tmp_path, monkeypatch):
    with open_executor(Workers(workers=2)) as executor:
        assert executor.run("squares", killed_once, [(tmp_path, number) for number in range(8)]) == [
            number * number for number in range(8)
        ]
        assert (tmp_path / "killed").is_dir()
        assert executor.run("more", abs, [-3]) == [3]
        monkeypatch.setattr(worker_pool, "RETRIES", 1)
        with pytest.raises(Sc3dError, match="ended 2 workers"):
            executor.run("deadly", always_killed, [0])


def test_what_a_worker_raises_is_told():
    with open_executor(Workers(workers=1)) as executor:
        with pytest.raises(InputError, match="the mask is missing"):
            executor.run("wrong", wrong, [1])
        with pytest.raises(RuntimeError, match=r"(?s)in wrong.*KeyError: 3"):
            executor.run("wrong", wrong, [2, 3])
        assert executor.run("right", wrong, [2]) == ["b"]


def told_to_end(folder: Path) -> None:
    signal.signal(signal.SIGTERM, lambda *_: (folder / "trace").touch())  # as a native library prints one
    hang(folder)


@linux
def test_busy_workers_end_without_a_word(tmp_path):
    pool = worker_pool.WorkerPool(1)
    worker = worker_pool._Worker(1)
    pool._workers.append(worker)
    worker.give(told_to_end, 0, tmp_path)
    wait_until(lambda: list(tmp_path.iterdir()))
    started = time.monotonic()
    pool.close()
    assert time.monotonic() - started < worker_pool.SECONDS and not (tmp_path / "trace").exists()


@linux
def test_workers_end_with_a_killed_command(tmp_path):
    program = (
        "from pathlib import Path\nfrom sc3d.settings.common import Workers\n"
        "from sc3d.tiling.executor import open_executor\nfrom tests.robustness.test_security import hang\n"
        f"with open_executor(Workers(workers=1)) as executor:\n    executor.run('hang', hang, [Path({str(tmp_path)!r})])\n"
    )
    command = subprocess.Popen([sys.executable, "-c", program], env=ENVIRONMENT, cwd=ROOT)
    wait_until(lambda: list(tmp_path.iterdir()))
    command.kill()
    command.wait()
    worker = int(next(tmp_path.iterdir()).name)
    wait_until(lambda: not psutil.pid_exists(worker) or psutil.Process(worker).status() == "zombie")


def test_a_cluster_without_encryption_is_warned_of(caplog, monkeypatch):
    distributed = pytest.importorskip("distributed")
    monkeypatch.setattr(distributed, "Client", lambda *_, **__: socket.create_connection(("127.0.0.1", 1)))
    with (
        pytest.raises(InputError, match="no Dask scheduler answers"),
        caplog.at_level(logging.WARNING, "sc3d"),
    ):
        with open_executor(Workers(cluster="tcp://256.0.0.1:1")):
            pass
    assert "tls://" in caplog.text
    with pytest.raises(InputError, match="certificate"), open_executor(Workers(cluster="tls://127.0.0.1:1")):
        pass


def wait_until(true: Callable[[], object], seconds: float = 30) -> None:
    until = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < until
        time.sleep(0.05)


# ---- scenes that somebody else has packed


class Watch:
    """Collects what this process writes in a folder: paths relative to it, of which those of folders end in /."""

    def __init__(self) -> None:
        self.folder: Path | None = None
        self.names: set[str] = set()
        sys.addaudithook(self._note)

    @contextmanager
    def on(self, folder: Path) -> Iterator[set[str]]:
        self.folder, self.names = folder, set()
        try:
            yield self.names
        finally:
            self.folder = None

    def _note(self, event: str, values: tuple) -> None:
        if self.folder is None or event not in ("open", "os.mkdir", "os.rename", "os.symlink"):
            return
        if event == "open" and not (isinstance(values[1], str) and set(values[1]) & set("wax+")):
            return
        target = values[1] if event in ("os.rename", "os.symlink") else values[0]
        if isinstance(target, str | Path) and Path(target).is_relative_to(self.folder):
            name = str(Path(target).relative_to(self.folder))
            is_folder = event == "os.mkdir" or (event == "os.rename" and Path(values[0]).is_dir())
            if ".tmp" not in name and name != ".":
                self.names.add(name + "/" * is_folder)


WATCH = Watch()


@pytest.fixture(scope="module")
def packed(tmp_path_factory) -> Path:
    """A small scene with everything in it."""
    import numpy as np
    import open3d as o3d

    from sc3d.importers.model import guess_observations
    from sc3d.io.clouds import write_geometry
    from sc3d.io.colmap import build_model, write_model
    from sc3d.runner import execute
    from sc3d.settings import labels, train
    from tests.builders import ORIGIN, ground, labelled_scene, views

    scene = labelled_scene(tmp_path_factory.mktemp("packed") / "scene")
    points = ground(0.4)
    colors = np.full(points.shape, 99, np.uint8)
    write_model(scene.sparse, build_model(views(), points, colors, guess_observations(views(), points)))
    corners = ORIGIN + np.array([[-4, -4, 0], [4, -4, 0], [4, 4, 0], [-4, 4, 0]])
    mesh = o3d.t.geometry.TriangleMesh(corners, np.array([[0, 1, 2], [0, 2, 3]], np.int32))
    write_geometry(scene.mesh, mesh)
    table = json.loads(scene.classes.read_text())
    scene.classes.write_text(json.dumps([entry | {"asprs": 6 if entry["id"] == 1 else 3} for entry in table]))
    scene.strokes.mkdir()
    (scene.strokes / "photo_0.json").write_text('{"shapes": []}')
    shutil.copytree(scene.sparse, scene.mapped)
    execute("train", scene, train.Train(iterations=2, max_gaussians=500, checkpoint_every=0))
    execute("label", scene, labels.Label())
    execute("propagate", scene, labels.Propagate())
    return scene.path


STAGES = [
    "synthesize", "map photos", "reconstruct", "georeference", "depth", "train", "train blocks", "extract", "segment", "refine", "label",
    "label tiled", "propagate", "propagate tiled", "evaluate", "evaluate tiled", "report", "export",
]  # fmt: skip


def stage_runs() -> dict[str, tuple[str, object]]:
    """Stage and settings of every way to work that writes files of its own."""
    from sc3d.settings import labels, outputs, reconstruction, synthesize, train
    from sc3d.stages.export import MODULES

    small = {"iterations": 2, "max_gaussians": 500, "checkpoint_every": 1}
    tiled = {"workers": 1, "max_memory": "8G"}
    place = {"epsg": 32632, "offset": (5e5, 5e6, 0.0)}
    return {
        "synthesize": ("synthesize", synthesize.Synthesize(views=2, width=64, num_points=500)),
        "map photos": ("map_photos", reconstruction.Mapping()),
        "reconstruct": ("reconstruct", reconstruction.Reconstruct()),
        "georeference": ("georeference", reconstruction.GeoreferenceOptions(**place)),
        "depth": ("depth", reconstruction.Depth(max_size=32)),
        "train": ("train", train.Train(**small)),
        "train blocks": ("train", train.Train(**small, blocks=2)),
        "extract": ("extract", reconstruction.Extract(method="centers", min_opacity=0.0)),
        "segment": ("segment", labels.Segment(backend="strokes")),
        "refine": ("segment", labels.Segment(refine=True)),
        "label": ("label", labels.Label()),
        "label tiled": ("label", labels.Label(**tiled)),
        "propagate": ("propagate", labels.Propagate()),
        "propagate tiled": ("propagate", labels.Propagate(**tiled)),
        "evaluate": ("evaluate", labels.Evaluate()),
        "evaluate tiled": ("evaluate", labels.Evaluate(**tiled)),
        "report": ("report", outputs.Report()),
        "export": ("export", outputs.Export(format=tuple(MODULES))),
    }


@pytest.fixture
def here(packed, monkeypatch):
    """All work in this process; cameras, strokes and the page of figures without what takes long."""
    import numpy as np

    from sc3d import report
    from sc3d.io.colmap import load_model, write_model
    from sc3d.segmentation.mask_refinement import Refinement
    from sc3d.segmentation.segment import Segmentation
    from sc3d.segmentation.strokes.backend import Strokes
    from sc3d.stages import map_photos
    from sc3d.tiling import evaluate, label, propagate
    from sc3d.tiling.executor import SerialExecutor

    @contextmanager
    def serial(_: object) -> Iterator[SerialExecutor]:
        yield SerialExecutor()

    for module in (label, propagate, evaluate):
        monkeypatch.setattr(module, "open_executor", serial)
    model = load_model(packed / "sparse" / "0")

    def cameras(images, names, output, settings):
        write_model(output, model)
        return {}

    def segment(image):
        ones = np.ones(image.shape[:2], np.uint8)
        return Segmentation(ones, ones, ())

    monkeypatch.setattr(map_photos, "map_photos", cameras)
    monkeypatch.setattr(Strokes, "fit", lambda *_: SimpleNamespace(segment=segment))
    monkeypatch.setattr(Refinement, "helps", True)
    monkeypatch.setattr(report, "sections", lambda *_: [], raising=False)


class Attack:
    """A scene at one place, unpacked anew for every run, and what lies beside it."""

    def __init__(self, packed: Path, folder: Path) -> None:
        self.packed, self.scene, self.outside = packed, folder / "scene", folder / "outside"
        (self.outside / "folder").mkdir(parents=True)
        for name in ("file", *(f"folder/{entry.name}" for entry in packed.glob("*/*"))):
            (self.outside / name).write_text("my thesis")

    def unpack(self, stage: str) -> None:
        shutil.rmtree(self.scene, ignore_errors=True)
        if stage == "synthesize":
            self.scene.mkdir()
        else:
            shutil.copytree(self.packed, self.scene)

    def plant(self, names: list[str]) -> None:
        for name in names:
            place = self.scene / name
            for parent in reversed(place.relative_to(self.scene).parents[:-1]):
                if not (self.scene / parent).exists():
                    (self.scene / parent).mkdir()
                    if parent.name.endswith(".parts"):  # as if its maker had guessed it
                        (self.scene / parent / "made-here").write_text(
                            str((self.scene / parent).stat().st_ino)
                        )
            remove(place)
            place.symlink_to(self.outside / ("folder" if name.endswith("/") else "file"))

    def run(self, stage: str, settings: object) -> None:
        from sc3d.runner import execute
        from sc3d.scene.scene import Scene

        before = self._content()
        with suppress(InputError):
            execute(stage, Scene(self.scene), settings, overwrite=True)
        assert self._content() == before

    def _content(self) -> dict[Path, str]:
        return {file: file.read_text() for file in self.outside.rglob("*") if file.is_file()}


def attacks(names: set[str]) -> Iterator[list[str]]:
    """What to make links: each folder alone, all files together, all that lies in folders of unfinished work."""
    work = {name for name in names if ".parts/" in name or ".blocks/" in name}
    inside = {name for name in work if name.count("/") > 1 or not name.endswith("/")}
    yield from ([name] for name in sorted(names - inside) if name.endswith("/"))
    yield sorted(name for name in names - work if not name.endswith("/"))
    if inside:  # links to folders, and in one folder links to files
        folders = sorted(name for name in inside if name.endswith("/"))
        real = tuple(folders[:1]) or min(inside)[: min(inside).index("/") + 1]
        files = [name for name in inside if name.startswith(real) and not name.endswith("/")]
        yield [*folders[1:], *sorted(files)]


@pytest.mark.parametrize("name", STAGES)
def test_no_stage_writes_through_a_link(packed, here, tmp_path, name):
    """Every name under which a stage writes is found by watching it, then made a link to elsewhere."""
    stage, settings = stage_runs()[name]
    attack = Attack(packed, tmp_path)
    if stage == "synthesize":
        names = {
            f"{folder}/" for folder in ("images", "masks", "confidence", "truth", "truth_depth", "sparse")
        }
    else:
        attack.unpack(stage)
        with WATCH.on(attack.scene) as names:
            attack.run(stage, settings)
        assert names
    for planted in filter(None, attacks(names)):
        attack.unpack(stage)
        attack.plant(planted)
        attack.run(stage, settings)


class Opened:
    """Files below a folder that are opened in the block, by whatever library; relative to the folder."""

    OPEN, FOLDER = 0x20, 0x40000000  # of inotify

    def __init__(self, folder: Path) -> None:
        system = ctypes.CDLL(None, use_errno=True)
        self.folder, self.handle = folder, system.inotify_init1(os.O_NONBLOCK)
        self.places = {
            system.inotify_add_watch(self.handle, os.fsencode(place), self.OPEN): place
            for place in [folder, *filter(Path.is_dir, folder.rglob("*"))]
        }

    def names(self) -> set[str]:
        found, data = set(), b""
        with suppress(BlockingIOError):
            while True:
                data += os.read(self.handle, 1 << 16)
        os.close(self.handle)
        while data:
            place, mask, _, length = struct.unpack_from("iIII", data)
            name = data[16 : 16 + length].rstrip(b"\0").decode()
            if name and not mask & self.FOLDER:
                found.add((self.places[place] / name).relative_to(self.folder).as_posix())
            data = data[16 + length :]
        return found


def reading_runs(scene: Path) -> dict[str, tuple[str, object]]:
    """`stage_runs`, and ways to read what those do not."""
    from sc3d.settings import labels, outputs, reconstruction
    from sc3d.stages.export import MODULES

    own = {"source": "cloud", "project": scene / "seeds.ply", "cloud": (scene / "seeds.ply",)}
    return stage_runs() | {
        "georeference gps": ("georeference", reconstruction.GeoreferenceOptions(from_gps=True)),
        "georeference again": ("georeference", reconstruction.GeoreferenceOptions(epsg=32632)),
        "depth masks": ("depth", reconstruction.Depth()),
        "depth sky": ("depth", reconstruction.Depth(sky_masks=scene / "truth")),
        "extract depth": ("extract", reconstruction.Extract(method="depth")),
        "segment masks": ("segment", labels.Segment(masks=scene / "truth")),
        "segment in place": ("segment", labels.Segment()),
        "segment geometry": ("segment", labels.Segment(backend="geometry")),
        "label cloud": ("label", labels.Label(cloud=scene / "seeds.ply")),
        "label prior": ("label", labels.Label(prior=scene / "seeds.ply")),
        "propagate save": ("propagate", labels.Propagate(save_model=scene / "site.npz")),
        "label density": ("label", labels.Label(mechanisms=labels.PaperMechanisms(density=True))),
        "import cloud": ("import_project", reconstruction.Import(**own)),
        "export": ("export", outputs.Export(format=tuple(set(MODULES) - {"objects"}))),
    }


READS = [
    *STAGES[1:], "georeference gps", "georeference again", "depth masks", "depth sky", "extract depth", "segment masks", "segment in place", "segment geometry", "label cloud", "label density",
    "label prior", "propagate save", "import cloud",
]  # fmt: skip


@linux
@pytest.mark.parametrize("name", READS)
def test_every_file_that_a_stage_reads_is_an_input(packed, here, tmp_path, monkeypatch, name):
    """Else a change of it gives yesterday's result without a word."""
    from sc3d.io import images
    from sc3d.io.provenance import PhotoFrames
    from sc3d.scene.scene import Scene

    attack = Attack(packed, tmp_path)
    stage, settings = reading_runs(attack.scene)[name]
    attack.unpack(stage)
    scene, module = Scene(attack.scene), importlib.import_module(f"sc3d.stages.{stage}")
    (scene.path / "georeference.json").write_text('{"epsg": 32615, "offset": [0, 0, 0]}')
    if name == "depth masks":
        table = json.loads(scene.classes.read_text())
        scene.classes.write_text(json.dumps([table[0], *(entry | {"surface": False} for entry in table[1:])]))
    if name == "extract depth":
        write_flat_depth(scene)  # the photos are noise: stereo confirms nothing
    inputs, outputs = module.inputs(scene, settings), module.outputs(scene, settings)
    decoded: set[Path] = set()
    read_stored = images.read_stored
    monkeypatch.setattr(images, "read_stored", lambda path: (decoded.add(path), read_stored(path))[1])
    opened = Opened(scene.path)
    with suppress(Sc3dError):  # photos without GPS, or without depth: what was read until then counts
        module.run(scene, settings)
    whole = [path for path in inputs if isinstance(path, Path)]
    frames = [item.folder for item in inputs if isinstance(item, PhotoFrames)]

    def covered(file: Path, by: list[Path]) -> bool:
        return any(file == path or path in file.parents for path in by)

    # photos without a camera, not more; whether a class has no surface: if one has, the table is an input
    warned_of = {"segment masks": [scene.sparse], "depth": [scene.classes]}.get(name, [])
    made = [*outputs, *warned_of, *(module.besides(scene, settings) if hasattr(module, "besides") else [])]
    names = {name for name in opened.names() if ".tmp" not in name and ".parts/" not in name}
    read = {name for name in names if not (scene.path / name).name.startswith(".seeds.ply.cloud")}
    assert not [name for name in read if not covered(scene.path / name, [*whole, *frames, *made])]
    assert not [file for file in decoded if not covered(file, whole)]


def write_flat_depth(scene) -> None:
    """Depth maps of a plane before every camera, confirmed by two views."""
    from sc3d.geometry.cameras import undistorted
    from sc3d.scene.depth_map import DepthMap, depth_file, write_depth_map

    for view in scene.model.views:
        small = undistorted(view, 64)
        nothing = DepthMap.nothing((small.height, small.width))
        depth = np.full_like(nothing.depth, abs(view.center[2]))
        write_depth_map(
            depth_file(scene.depth, view.name),
            DepthMap(depth, nothing.normals, np.full_like(nothing.num_views, 2), nothing.sky),
        )


def wrong_kinds(scene: Path, names: set[str]) -> Iterator[tuple[Path, Callable[[Path], object]]]:
    """Places where a stage writes, each with what makes something there that cannot be replaced."""
    for name in sorted(name for name in names if not name.startswith(".")):
        place = scene / name
        if not name.endswith("/"):
            yield place, Path.mkdir
            continue
        yield place, Path.touch
        yield place, os.mkfifo
        yield place, lambda path: path.symlink_to(path.parent / "nowhere")
        yield place, lambda path: path.symlink_to(path)


@linux
@pytest.mark.parametrize("name", [name for name in STAGES if "tiled" not in name and name != "synthesize"])
def test_what_cannot_be_replaced_is_refused_before_the_work(packed, here, tmp_path, monkeypatch, name):
    """A folder where a file is to be written, and the other way round, also under the names of sidecars."""
    from sc3d.runner import execute, sidecar
    from sc3d.scene.scene import Scene

    attack = Attack(packed, tmp_path)
    stage, settings = reading_runs(attack.scene)[name]
    module = importlib.import_module(f"sc3d.stages.{stage}")
    scene, place_of_scene = Scene(attack.scene), '{"epsg": 32615, "offset": [0, 0, 0]}'

    def unpack() -> None:
        attack.unpack(stage)
        (scene.path / "georeference.json").write_text(place_of_scene)

    unpack()
    with WATCH.on(attack.scene) as names:
        attack.run(stage, settings)
    outputs = module.outputs(scene, settings)
    made = [*outputs, *(module.besides(scene, settings) if hasattr(module, "besides") else [])]
    kept = {path.relative_to(attack.scene).as_posix() for path in made}
    work = {name for name in names if ".parts/" in name or ".blocks/" in name or ".checkpoint" in name}
    work |= {name for name in names if ".before" in name}  # set aside in the work itself
    inside = {name for name in names if any(name.startswith(f"{folder}/") for folder in kept)}
    top = {name for name in names - work - inside if name.rstrip("/") != "segment.unfinished.json"}
    top |= {f"{name}/" for name in kept if not Path(name).suffix}
    outputs = module.outputs(scene, settings)
    top |= {sidecar(path).relative_to(attack.scene).as_posix() for path in outputs}
    worked = []
    monkeypatch.setattr(module, "run", lambda *_: worked.append(1) or {})
    for place, make in wrong_kinds(attack.scene, top):
        unpack()
        place.parent.mkdir(parents=True, exist_ok=True)
        remove(place)
        make(place)
        with suppress(InputError):
            execute(stage, Scene(attack.scene), settings, overwrite=True)
        assert not worked, place


def test_work_that_is_a_link_is_done_anew(packed, here, tmp_path, caplog):
    stage, settings = stage_runs()["label tiled"]
    attack = Attack(packed, tmp_path)
    attack.unpack(stage)
    with WATCH.on(attack.scene) as names:
        attack.run(stage, settings)
    expected = (attack.scene / "seeds.ply").read_bytes()
    work = next(name for name in names if name.endswith(".parts/"))
    for planted in ([work], [f"{work}tiles/"]):
        attack.unpack(stage)
        attack.plant(planted)
        caplog.clear()
        attack.run(stage, settings)
        assert "is not from sc3d" in caplog.text and (attack.scene / "seeds.ply").read_bytes() == expected
        assert not list(attack.scene.glob(".*"))
    attack.unpack(stage)  # a folder without links, unpacked with the rest: its arrays could be anything
    (attack.scene / work / "results").mkdir(parents=True)
    (attack.scene / work / "made-here").write_text("1")
    (attack.scene / work / "results" / "label.0.npy").write_bytes(b"wrong")
    attack.run(stage, settings)
    assert "copied or unpacked" in caplog.text and (attack.scene / "seeds.ply").read_bytes() == expected


def test_work_of_another_user_or_with_other_names_is_not_gone_on_with(tmp_path, caplog):
    work, mine = tmp_path / "train.1.blocks", tmp_path / "thesis.tex"
    work.mkdir()
    mine.write_text("my thesis")
    (work / "0.json").write_text("{}")
    assert claim(work) == work and (work / "0.json").exists() and not caplog.text
    (work / "1.ply").hardlink_to(mine)
    claim(work)
    assert not work.exists() and mine.read_text() == "my thesis" and "1.ply leads elsewhere" in caplog.text
    work.mkdir()
    os.mkfifo(work / "0.json")
    assert not claim(work).exists()
    if os.geteuid() == 0:
        (work / "a").mkdir(parents=True)
        os.chown(work / "a", NOBODY, NOBODY)
        with pytest.raises(InputError, match="another user"):
            claim(work)


def test_masks_are_not_gone_on_with_through_a_link(packed, here, tmp_path):
    """An interrupted run says that its masks are gone on with; the confidence maps lead elsewhere."""
    from sc3d.io.json_files import write_json
    from sc3d.runner import execute
    from sc3d.scene.scene import Scene
    from sc3d.segmentation.segment import _state

    stage, settings = stage_runs()["segment"]
    attack = Attack(packed, tmp_path)
    for name in ("confidence/", "instances/"):
        attack.unpack(stage)
        shutil.rmtree(attack.scene / "masks")
        scene = Scene(attack.scene)
        write_json(scene.path / "segment.unfinished.json", _state(scene, settings, scene.class_table()))
        attack.plant([name])
        with pytest.raises(InputError, match="remove the link"):
            execute(stage, scene, settings)
        attack.run(stage, settings)


def test_a_page_writes_no_strokes_through_a_link(packed, tmp_path):
    from sc3d.annotate.session import Session
    from sc3d.scene.scene import Scene

    attack = Attack(packed, tmp_path)
    attack.unpack("annotate")
    attack.plant(["strokes/"])
    with pytest.raises(InputError, match="remove the link"):
        Session(Scene(attack.scene))


def test_strokes_that_become_a_link_are_not_written(packed, tmp_path):
    """While the page is open."""
    from sc3d.annotate.session import Session
    from sc3d.scene.scene import Scene

    attack = Attack(packed, tmp_path)
    attack.unpack("annotate")
    session = Session(Scene(attack.scene))
    attack.plant(["strokes/"])
    drawn = {"label": "road", "shape_type": "point", "points": [[1, 1]]}
    for shapes in ([drawn], []):
        with pytest.raises(InputError, match="remove the link"):
            session.save("photo_0", {"shapes": shapes})
    with pytest.raises(InputError, match="remove the link"):
        session.try_out("photo_0")
    assert all(text == "my thesis" for text in attack._content().values())


def test_a_length_of_absurd_length_is_too_large():
    """Python refuses to read such a number."""
    from sc3d.annotate.server import Handler, Refusal

    asked = SimpleNamespace(headers={"Content-Type": "application/json", "Content-Length": "9" * 5000})
    with pytest.raises(Refusal) as refusal:
        Handler._body(asked)
    assert refusal.value.status == 413


def test_links_that_a_user_makes_are_followed(packed, here, tmp_path):
    """The photos' folder, and the scene's own."""
    from sc3d.runner import execute
    from sc3d.scene.scene import Scene

    shutil.copytree(packed, tmp_path / "disk")
    (tmp_path / "disk" / "images").rename(tmp_path / "photos")
    (tmp_path / "disk" / "images").symlink_to(tmp_path / "photos")
    (tmp_path / "scene").symlink_to(tmp_path / "disk")
    for name in ("train blocks", "segment", "label tiled"):
        stage, settings = stage_runs()[name]
        execute(stage, Scene(tmp_path / "scene"), settings, overwrite=True)


def test_what_others_leave_where_all_may_write_stops_nobody(tmp_path, monkeypatch):
    (tmp_path / f".x.{atomic.HOST}-999999999.tmp").write_text("")

    def forbidden(_: Path) -> None:
        raise PermissionError

    monkeypatch.setattr(atomic, "remove", forbidden)
    atomic.remove_leftovers(tmp_path)


# ---- pages


GOOD = {"Host": "127.0.0.1:8080"}


@pytest.mark.parametrize(
    ("headers", "host", "fine"),
    [
        (GOOD, "127.0.0.1", True),
        ({"Host": "localhost:9000"}, "127.0.0.1", True),  # a tunnel from another port
        ({"Host": "[::1]:8080"}, "127.0.0.1", True),
        (GOOD | {"Origin": "http://127.0.0.1:8080"}, "127.0.0.1", True),
        (GOOD | {"Sec-Fetch-Site": "same-origin"}, "127.0.0.1", True),
        (
            GOOD
            | {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "navigate", "Sec-Fetch-Dest": "document"},
            "127.0.0.1",
            True,  # somebody follows a link
        ),
        (
            GOOD | {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "navigate", "Sec-Fetch-Dest": "iframe"},
            "127.0.0.1",
            False,
        ),
        (GOOD | {"Sec-Fetch-Site": "same-site"}, "127.0.0.1", False),
        (GOOD | {"Origin": "http://127.0.0.1:9911"}, "127.0.0.1", False),
        (GOOD | {"Origin": "http://evil.example"}, "127.0.0.1", False),
        (GOOD | {"Origin": "null"}, "127.0.0.1", False),
        ({"Host": "evil.example:8080"}, "127.0.0.1", False),
        ({"Host": "127.0.0.1.evil.example"}, "127.0.0.1", False),
        ({"Host": "evil.example", "Origin": "http://evil.example"}, "127.0.0.1", False),
        ({"Host": "127.0.0.1@evil.example"}, "127.0.0.1", False),
        ({"Host": "evil.example@127.0.0.1"}, "127.0.0.1", False),
        ({"Host": "127.0.0.1:x"}, "127.0.0.1", False),
        ({"Host": "[::1"}, "127.0.0.1", False),
        ({"Host": ""}, "127.0.0.1", False),
        ({}, "127.0.0.1", False),
        ({"Host": "10.1.2.3:8080"}, "127.0.0.1", False),
        ({"Host": "10.1.2.3:8080"}, "0.0.0.0", True),
        ({"Host": "evil.example:8080"}, "0.0.0.0", False),
        ({"Host": "mine.example:8080"}, "mine.example", True),
    ],
)
def test_who_may_talk_to_a_page(headers, host, fine):
    given = Message()
    for name, value in headers.items():
        given[name] = value
    assert (LocalPage.at(host).refusal(given) is None) == fine


def test_headers_that_are_there_twice_are_refused():
    given = Message()
    given["Host"], given["Host"] = "127.0.0.1:1", "evil.example"
    assert LocalPage().refusal(given)


@pytest.fixture(scope="module")
def viewer(packed) -> Iterator[str]:
    """host:port of the viewer of a scene."""
    pytest.importorskip("viser", reason="the viewer in the browser needs viser: pip install 'sc3d[web]'")
    from sc3d.scene.scene import Scene
    from sc3d.view.web.page import WebView, serving
    from tests.builders import inspector_of

    scene = Scene(packed)
    with serving(WebView(scene, inspector_of(scene))) as address:
        yield address.removeprefix("http://")


def stolen(address: str, host: str, origin: str | None) -> int:
    """Bytes that the viewer sends to a client that calls it `host` and says to be a page of `origin`."""
    import viser
    from websockets.exceptions import InvalidStatus
    from websockets.sync.client import connect

    with socket.create_connection(address.split(":")) as line:
        try:
            with connect(
                f"ws://{host}", sock=line, origin=origin, subprotocols=[f"viser-v{viser.__version__}"],
                compression=None, max_size=None,
            ) as client:  # fmt: skip
                return len(client.recv(timeout=20))
        except InvalidStatus as refused:
            assert refused.response.status_code == 403
            return 0


def test_other_pages_and_names_do_not_open_the_viewers_socket(viewer):
    port = viewer.rpartition(":")[2]
    assert stolen(viewer, viewer, f"http://{viewer}") and stolen(viewer, viewer, None)
    assert stolen(viewer, f"localhost:{port}", f"http://localhost:{port}")
    assert not stolen(viewer, viewer, "http://evil.example")
    assert not stolen(viewer, viewer, "http://127.0.0.1:1")
    assert not stolen(viewer, viewer, "null")
    assert not stolen(viewer, f"evil.example:{port}", f"http://evil.example:{port}")
    assert not stolen(viewer, f"evil.example:{port}", None)


def test_the_viewers_page_has_one_name(viewer):
    for host, expected in ((viewer, 200), ("evil.example", 403), (f"evil.example:{viewer[10:]}", 403)):
        connection = HTTPConnection(*viewer.split(":"), timeout=20)
        connection.putrequest("GET", "/", skip_host=True)
        connection.putheader("Host", host)
        connection.endheaders()
        assert connection.getresponse().status == expected
        connection.close()


def test_a_viewer_that_cannot_be_guarded_is_not_started():
    pytest.importorskip("websockets")
    from sc3d.view.web.guard import guarding

    with pytest.raises(Sc3dError, match="viser"), guarding(LocalPage()):
        pass


EVIL = """<!doctype html><title>waiting</title><script>
const socket = new WebSocket("ws://ADDRESS", ["viser-vVERSION"]);
socket.onmessage = () => document.title = "stolen";
socket.onclose = () => { if (document.title != "stolen") document.title = "refused"; };
</script>"""


def test_a_page_of_another_site_gets_nothing_in_a_browser(viewer):
    api = pytest.importorskip("playwright.sync_api", reason="needs playwright: pip install playwright")
    program = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if program is None:
        pytest.skip("needs Chromium: apt install chromium")
    import viser

    names = "MAP evil.example 127.0.0.1, MAP rebound.example 127.0.0.1"
    options = ["--no-sandbox", f"--host-resolver-rules={names}"]
    page_of_evil = EVIL.replace("ADDRESS", viewer).replace("VERSION", viser.__version__)
    with api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=options)
        page = browser.new_page()
        page.route(
            "http://evil.example/", lambda route: route.fulfill(body=page_of_evil, content_type="text/html")
        )
        page.goto("http://evil.example/")
        page.wait_for_function("document.title != 'waiting'", timeout=60_000)
        assert page.title() == "refused"
        assert page.goto(f"http://rebound.example:{viewer.rpartition(':')[2]}/").status == 403
        with page.expect_websocket(timeout=60_000) as socket_of_page:
            assert page.goto(f"http://{viewer}/").status == 200
        socket_of_page.value.wait_for_event("framereceived", timeout=60_000)
        browser.close()


# ---- visitors that leave


@pytest.fixture
def command() -> Iterator[Callable[..., tuple[subprocess.Popen, int]]]:
    """Starts a command that serves a page; returns it and its port."""
    started = []

    def start(*arguments: str) -> tuple[subprocess.Popen, int]:
        process = subprocess.Popen(
            [sys.executable, "-c", "from sc3d.cli import main; main()", *arguments],
            env=ENVIRONMENT, stderr=subprocess.PIPE, stdin=subprocess.DEVNULL, text=True,
        )  # fmt: skip
        started.append(process)
        assert process.stderr is not None
        address = next(word for line in process.stderr for word in line.split() if word.startswith("http://"))
        return process, int(address.strip("/").rpartition(":")[2])

    yield start
    for process in started:
        process.terminate()
        process.communicate(timeout=60)


def leave(port: int, request: str) -> None:
    """Ask, and be gone before the answer."""
    line = socket.create_connection(("127.0.0.1", port))
    line.sendall(request.replace("PORT", str(port)).replace("\n", "\r\n").encode())
    line.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    line.close()


UPGRADE = (
    "GET / HTTP/1.1\nHost: 127.0.0.1:PORT\nUpgrade: websocket\nConnection: Upgrade\nSec-WebSocket-Version: 13\n"
    "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\nSec-WebSocket-Protocol: viser-v1.1.1\n\n"
)


@pytest.mark.parametrize(
    ("arguments", "request_text"),
    [
        (["annotate", "SCENE"], "GET /photo/photo_0 HTTP/1.1\nHost: 127.0.0.1:PORT\n\n" * 3),
        (["view", "SCENE", "--web"], UPGRADE),
    ],
)
def test_a_server_survives_visitors_that_leave(packed, command, arguments, request_text):
    if "--web" in arguments:
        pytest.importorskip("viser", reason="the viewer in the browser needs viser: pip install 'sc3d[web]'")
    process, port = command(*(word.replace("SCENE", str(packed)) for word in arguments), "--port", "0")
    for number in range(12):
        leave(port, request_text)
        time.sleep(0.02 * (number % 4))
    connection = HTTPConnection("127.0.0.1", port, timeout=20)
    connection.request("GET", "/")
    assert connection.getresponse().status == 200 and process.poll() is None


def test_only_what_prints_ends_with_its_reader(monkeypatch, capsys):
    if not hasattr(signal, "SIGPIPE"):
        pytest.skip("there are no such signals here")
    seen = []
    monkeypatch.setattr("sc3d.cli._dispatch", lambda *_: seen.append(signal.getsignal(signal.SIGPIPE)))
    before = signal.getsignal(signal.SIGPIPE)
    main(["label", "scene"])
    assert seen == [before] and signal.getsignal(signal.SIGPIPE) == before != signal.SIG_DFL


@pytest.mark.parametrize("arguments", [["--help"], ["label", "--help"]])
@linux
def test_help_into_a_closed_pipe_ends_quietly(arguments):
    end, start = os.pipe()
    os.close(end)
    process = subprocess.run(
        [sys.executable, "-c", "from sc3d.cli import main; main()", *arguments],
        stdout=start, stderr=subprocess.PIPE, env=ENVIRONMENT,
    )  # fmt: skip
    os.close(start)
    assert process.returncode == -signal.SIGPIPE and not process.stderr


# ---- commands that are called in somebody else's scene


@pytest.fixture
def trap(tmp_path, monkeypatch) -> Path:
    """The current folder, full of modules that leave a mark when they are loaded."""
    folder = tmp_path / "scene"
    folder.mkdir()
    for name in ("multiprocessing", "numpy", "open3d", "signal", "sc3d"):
        (folder / f"{name}.py").write_text(f"open({str(tmp_path / 'loaded')!r}, 'w')\nraise ImportError")
    monkeypatch.chdir(folder)
    return folder


@pytest.mark.skipif(sys.version_info < (3, 11), reason="Python 3.10 cannot be told")
def test_workers_load_no_modules_from_the_current_folder(trap):
    with open_executor(Workers(workers=1)) as executor:
        assert executor.run("here", abs, [-3]) == [3]
    assert not (trap.parent / "loaded").exists()


def test_probes_load_no_modules_from_the_current_folder(trap):
    from sc3d.io.python_process import run_python

    assert run_python("import numpy; print(numpy.__version__)", 60).returncode == 0
    assert not (trap.parent / "loaded").exists()


def test_numba_is_not_told_by_a_file_of_the_scene(tmp_path, monkeypatch, capsys):
    (tmp_path / ".numba_config.yaml").write_text("cache_dir: cache\n")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as stopped:
        main(["label", "."])
    assert stopped.value.code == 2 and "in another folder" in capsys.readouterr().err


def test_names_give_the_terminal_no_commands(tmp_path, capsys):
    with pytest.raises(SystemExit):
        main(["label", str(tmp_path / "a\x1b]0;owned\x07b\x9b2J")])
    said = capsys.readouterr().err
    assert "a?]0;owned?b?2J" in said and not set(said) & set("\x1b\x07\x9b")
    record = logging.LogRecord("sc3d", logging.WARNING, "", 1, "%s\nleft out", ("\x1b[2Ja.jpg",), None)
    assert PlainText("%(message)s").format(record) == "?[2Ja.jpg\nleft out"
