"""Other users of the machine, other pages of the browser, and scenes that somebody else has packed: nothing of
the user's is reached through them.
"""

from __future__ import annotations

import logging
import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import SimpleNamespace

import psutil
import pytest

from sc3d.errors import InputError, Sc3dError
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
        yield [
            child.pid for child in psutil.Process().children(recursive=True) if child.pid not in before
        ]


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
    with pytest.raises(InputError, match="no Dask scheduler answers"), caplog.at_level(logging.WARNING, "sc3d"):
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
    from sc3d.runner import execute
    from sc3d.scene.scene import Scene
    from sc3d.segmentation.segment import segment_photos  # noqa: F401  # its import takes long
    from sc3d.settings import labels, synthesize, train

    scene = Scene(tmp_path_factory.mktemp("packed") / "scene")
    execute("synthesize", scene, synthesize.Synthesize(seed=5, views=4, width=120, extent=60.0, altitude=40.0, num_points=3000))
    for name, target in (("cloud.ply", "truth.ply"), ("mesh.ply", "truth_mesh.ply")):
        shutil.copy(scene.path / target, scene.path / name)
    execute("train", scene, train.Train(iterations=2, max_gaussians=2000, checkpoint_every=0))
    execute("label", scene, labels.Label())
    execute("propagate", scene, labels.Propagate())
    return scene.path


def stage_runs() -> dict[str, tuple[str, object]]:
    """Stage and settings of every way to work that writes files of its own."""
    from sc3d.settings import labels, outputs, reconstruction, synthesize, train

    small = {"iterations": 2, "max_gaussians": 2000}
    every = tuple(name for name in ("masks", "laz", "clouds", "splats", "spz", "orthophoto", "objects", "transforms", "colmap-text"))
    return {
        "synthesize": ("synthesize", synthesize.Synthesize(views=2, width=64, num_points=500)),
        "reconstruct": ("reconstruct", reconstruction.Reconstruct()),
        "georeference": (
            "georeference",
            reconstruction.GeoreferenceOptions(epsg=32632, offset=(5e5, 5e6, 0.0)),
        ),
        "train": ("train", train.Train(**small, checkpoint_every=1)),
        "train blocks": ("train", train.Train(**small, blocks=2, checkpoint_every=1)),
        "segment": ("segment", labels.Segment(backend="strokes")),
        "refine": ("segment", labels.Segment(refine=True)),
        "label": ("label", labels.Label()),
        "label tiled": ("label", labels.Label(workers=1, max_memory="8G")),
        "propagate": ("propagate", labels.Propagate()),
        "propagate tiled": ("propagate", labels.Propagate(workers=1, max_memory="8G")),
        "evaluate": ("evaluate", labels.Evaluate()),
        "evaluate tiled": ("evaluate", labels.Evaluate(workers=1, max_memory="8G")),
        "report": ("report", outputs.Report()),
        "export": ("export", outputs.Export(format=every)),
    }


@pytest.fixture
def here(monkeypatch):
    """All work in this process; cameras and strokes without their time."""
    import numpy as np

    from sc3d.geometry import blocks
    from sc3d.segmentation.segment import Segmentation
    from sc3d.segmentation.strokes.backend import Strokes
    from sc3d.sfm import Reconstructed
    from sc3d.stages import reconstruct
    from sc3d.io.colmap import load_model, write_model
    from sc3d.tiling import evaluate, label, propagate
    from sc3d.tiling.executor import SerialExecutor

    @contextmanager
    def serial(_: object) -> Iterator[SerialExecutor]:
        yield SerialExecutor()

    for module in (label, propagate, evaluate):
        monkeypatch.setattr(module, "open_executor", serial)

    def cameras(images, names, sparse, settings, control_points):
        (sparse.parent / "work").mkdir(exist_ok=True)
        write_model(sparse, MODEL[0])
        return Reconstructed({}, None)

    def segment(image):
        return Segmentation(np.ones(image.shape[:2], np.uint8), np.ones(image.shape[:2], np.uint8))

    MODEL.append(None)
    monkeypatch.setattr(reconstruct, "reconstruct", cameras)
    monkeypatch.setattr(Strokes, "fit", lambda *_: SimpleNamespace(segment=segment))
    return load_model


MODEL: list = []
