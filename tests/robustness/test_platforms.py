"""What Windows and macOS lack or count otherwise, on a faked platform: this shows that nothing missing is
asked for, not that sc3d runs there.
"""

import ctypes
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from sc3d.io.folders import link_or_copy
from sc3d.io.provenance import process_peak_mb
from sc3d.settings.common import Resources
from sc3d.tiling import memory
from tests.builders import write_bare_scene

ROOT = Path(__file__).parents[2]
# without what the os module of Windows lacks; other libraries are loaded before
WINDOWS = """
import importlib, os, pkgutil, shutil, signal, sys, types
import cv2, laspy, numba, open3d, PIL.Image, pyproj, rasterio.features, rasterio.transform, shapely, sklearn.ensemble, scipy.ndimage, scipy.optimize, scipy.sparse, scipy.spatial, torch, tyro, tqdm
for name in ("resource", "fcntl", "pwd", "grp", "termios"):
    sys.modules[name] = None
sys.modules["msvcrt"] = types.ModuleType("msvcrt")
for name in ("statvfs", "sysconf", "geteuid", "getuid", "fork", "mkfifo", "getloadavg", "sched_getaffinity"):
    delattr(os, name)
del signal.SIGPIPE, signal.SIGKILL
shutil.disk_usage = lambda _: types.SimpleNamespace(free=1 << 40)
def refuse(*_, **__):
    raise OSError("a privilege is needed")
os.symlink = refuse
real, sys.platform = sys.platform, "win32"
sys.path.insert(0, ROOT)
import sc3d
for found in pkgutil.walk_packages(sc3d.__path__, "sc3d."):
    importlib.import_module(found.name)
sys.platform = real  # other libraries load parts late
import tests.robustness.readers, tools.fuzz_readers
"""
CHAIN = """
from sc3d.cli import main
from sc3d.tiling import memory
memory.system_memory = lambda: 8 << 30
os.chdir(sys.argv[1])
main(["label", "."])
main(["propagate", "."])
"""


def faked(code: str, *arguments: str) -> subprocess.CompletedProcess:
    environment = os.environ | {"NUMBA_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    words = [sys.executable, "-c", code.replace("ROOT", repr(str(ROOT))), *arguments]
    return subprocess.run(words, capture_output=True, text=True, check=False, env=environment, cwd=ROOT)


def test_every_module_is_imported_without_resource_and_labels_a_scene(tmp_path):
    scene = write_bare_scene(tmp_path / "scene")
    done = faked(WINDOWS + CHAIN, str(scene))
    assert done.returncode == 0, done.stderr[-3000:]
    assert (scene / "labelled.ply").is_file()


def test_a_relative_link_stays_relative_and_a_copy_replaces_it(tmp_path, monkeypatch):
    (tmp_path / "truth.ply").write_bytes(b"ply")
    link_or_copy(Path("truth.ply"), tmp_path / "cloud.ply")
    assert os.readlink(tmp_path / "cloud.ply") == "truth.ply"
    with pytest.raises(FileExistsError):
        link_or_copy(Path("truth.ply"), tmp_path / "cloud.ply")

    def refuse(*_, **__):
        raise OSError("a privilege is needed")

    monkeypatch.setattr(os, "symlink", refuse)
    link_or_copy(Path("truth.ply"), tmp_path / "copy.ply")
    assert not (tmp_path / "copy.ply").is_symlink() and (tmp_path / "copy.ply").read_bytes() == b"ply"


def test_memory_without_sysconf(monkeypatch):
    """The record that Windows fills has 64 bytes, the memory at the 8th."""

    def fill(pointer):
        record = ctypes.cast(pointer, ctypes.POINTER(ctypes.c_uint8 * 64)).contents
        assert int.from_bytes(record[:4], "little") == 64
        record[8:16] = (16 << 30).to_bytes(8, "little")
        return 1

    kernel = SimpleNamespace(GlobalMemoryStatusEx=fill)
    monkeypatch.setattr(ctypes, "windll", SimpleNamespace(kernel32=kernel), raising=False)
    assert memory.system_memory() == os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    monkeypatch.delattr(os, "sysconf")
    assert memory.memory_of(Resources()) == 8 << 30


def test_peak_memory_is_in_bytes_on_macos(monkeypatch):
    resource = pytest.importorskip("resource")
    monkeypatch.setattr(resource, "getrusage", lambda _: SimpleNamespace(ru_maxrss=300 << 20))
    for platform, peak in (("linux", 300 << 10), ("darwin", 300)):
        monkeypatch.setattr(sys, "platform", platform)
        assert process_peak_mb() == peak


@pytest.mark.parametrize(
    ("variables", "found"),
    [({}, True), ({"NUMBA_THREADING_LAYER": "omp"}, True), ({"NUMBA_THREADING_LAYER": "workqueue"}, False),
     ({"NUMBA_THREADING_LAYER_PRIORITY": "workqueue omp tbb"}, False)],
)  # fmt: skip
def test_layers_of_numba_that_bear_several_threads_are_known(variables, found):
    code = "import sc3d; from sc3d.labelling.threads import kernels_may_overlap; print(kernels_may_overlap())"
    words = [sys.executable, "-c", code]
    said = subprocess.check_output(words, text=True, env=os.environ | variables, cwd=ROOT)
    assert said.strip() == str(found)


def test_labels_are_the_same_where_kernels_may_not_overlap(tmp_path):
    """Numba's own pool ended the process while the next view was prepared."""
    code = "from sc3d.cli import main\nmain(['label', '.'])"
    results = []
    for layer in ("omp", "workqueue"):
        scene = write_bare_scene(tmp_path / layer)
        environment = os.environ | {
            "NUMBA_THREADING_LAYER": layer,
            "NUMBA_NUM_THREADS": "2",
            "PYTHONPATH": str(ROOT),
        }
        subprocess.run([sys.executable, "-c", code], check=True, cwd=scene, env=environment)
        results.append((scene / "seeds.ply").read_bytes())
    assert results[0] == results[1]
