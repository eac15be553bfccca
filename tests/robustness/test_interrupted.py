"""Runs that are killed, interrupted or out of disk space: nothing half-written passes for finished, earlier
outputs stay, the next run gives the same bytes.
"""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from sc3d.cli import main
from sc3d.io import atomic as files
from sc3d.io.atomic import atomic_path, remove_leftovers, telling_of_full_disk, temporary_name
from tests.builders import write_bare_scene

OUTPUTS = ("seeds.ply", "votes.npz", "labelled.ply")
LABELS = (["label"], ["propagate", "--method", "knn"])


def contents(scene: Path) -> dict[str, str]:
    return {
        str(file.relative_to(scene)): hashlib.sha256(file.read_bytes()).hexdigest()
        for file in sorted(scene.rglob("*"))
        if file.is_file()
    }


def hidden(scene: Path) -> list[Path]:
    return list(scene.rglob(".*"))


def results(scene: Path) -> dict[str, str]:
    return {name: digest for name, digest in contents(scene).items() if name in OUTPUTS}


def label_and_propagate(scene: Path, kill_at: int = -1) -> None:
    """Both stages in this process, which kills itself at the write `kill_at`: even numbers before its
    renaming, odd ones behind it.
    """
    replace, count = files._replace, iter(range(0, 1000, 2))

    def deadly(temporary: Path, path: Path) -> None:
        number = next(count)
        if number == kill_at:
            os.kill(os.getpid(), signal.SIGKILL)
        replace(temporary, path)
        if number + 1 == kill_at:
            os.kill(os.getpid(), signal.SIGKILL)

    files._replace = deadly
    for stage, *options in LABELS:
        main([stage, str(scene), *options])


@pytest.fixture(scope="module")
def processes():
    """Children of a process that has loaded everything and computed nothing, so that they start quickly and
    may use threads.
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(
        ["tests.robustness.test_interrupted", "sc3d.stages.label", "sc3d.stages.propagate"]
    )

    def run(scene: Path, kill_at: int = -1, seconds: float | None = None) -> int:
        child = context.Process(target=label_and_propagate, args=(scene, kill_at))
        child.start()
        child.join(seconds)
        if child.is_alive():
            child.kill()
            child.join()
        return child.exitcode

    return run


@pytest.fixture(scope="module")
def bare(tmp_path_factory) -> Path:
    return write_bare_scene(tmp_path_factory.mktemp("bare") / "scene")


@pytest.fixture(scope="module")
def finished(bare, processes) -> Path:
    """A scene with labels, made without interruption."""
    scene = bare.with_name("finished")
    shutil.copytree(bare, scene)
    assert processes(scene) == 0
    return scene


SLOW = pytest.mark.slow


@pytest.mark.parametrize(
    "kill_at", [0, 1, 3, 6, 9, *(pytest.param(number, marks=SLOW) for number in (2, 4, 5, 7, 8, 10, 11))]
)
def test_killed_before_and_behind_every_write(bare, finished, processes, tmp_path, kill_at):
    scene = tmp_path / "scene"
    shutil.copytree(bare, scene)
    assert processes(scene, kill_at) == -signal.SIGKILL
    for output in OUTPUTS:  # what has a sidecar is whole
        if (scene / f"{output}.json").exists():
            assert results(scene)[output] == results(finished)[output]
    assert processes(scene) == 0
    assert results(scene) == results(finished) and len(results(finished)) == 3 and not hidden(scene)


@pytest.mark.parametrize("kill_at", [1, 3, *(pytest.param(number, marks=SLOW) for number in (0, 2, 5, 7, 9))])
def test_killed_while_finished_outputs_are_replaced(finished, processes, tmp_path, kill_at):
    """Other settings, killed, then the first settings again: the bytes of the first run."""
    scene = tmp_path / "scene"
    shutil.copytree(finished, scene)
    for name in ("seeds.ply.json", "votes.npz.json", "labelled.ply.json"):  # as after another version of sc3d
        record = json.loads((scene / name).read_text())
        (scene / name).write_text(json.dumps(record | {"settings": {}}))
    assert processes(scene, kill_at) == -signal.SIGKILL
    assert processes(scene) == 0
    assert results(scene) == results(finished) and not hidden(scene)


def test_killed_at_any_moment(bare, finished, processes, tmp_path):
    for row, seconds in enumerate((0.05, 0.4, 0.9)):
        scene = tmp_path / f"scene_{row}"
        shutil.copytree(bare, scene)
        assert processes(scene, seconds=seconds) in (-signal.SIGKILL, 0)
        assert processes(scene) == 0
        assert results(scene) == results(finished) and not hidden(scene)


@pytest.mark.slow
def test_fifty_kills_of_a_whole_run(tmp_path):
    """Half an hour on two cores: `kill_run.py` does the same by hand and goes on where it was stopped."""
    subprocess.run(
        [
            sys.executable,
            Path(__file__).parent / "kill_run.py",
            tmp_path,
            "--kills",
            "50",
            "--minutes",
            "600",
        ],
        check=True,
    )
    rows = [json.loads(line) for line in (tmp_path / "kills.jsonl").read_text().splitlines()]
    assert len(rows) == 50 and all(row["rerun"] == 0 and row["same"] and not row["hidden"] for row in rows)


# ---- Ctrl-C


@pytest.mark.parametrize(
    ("number", "status", "line"),
    [(signal.SIGINT, 130, "interrupted"), (signal.SIGTERM, 143, "ended by SIGTERM")],
)
def test_ctrl_c_and_sigterm_are_one_clear_line(finished, tmp_path, monkeypatch, capsys, number, status, line):
    scene = tmp_path / "scene"
    shutil.copytree(finished, scene)
    before = contents(scene)
    monkeypatch.setattr("sc3d.labelling.label.fuse", lambda *_: signal.raise_signal(number))
    # a shell starts background jobs deaf to Ctrl-C
    handler = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(SystemExit) as stopped:
            main(["label", str(scene), "--overwrite"])
    finally:
        signal.signal(signal.SIGINT, handler)
    told = capsys.readouterr().err
    assert stopped.value.code == status
    assert told.count("\n") == 1 and f"{line}; finished work is kept" in told
    assert contents(scene) == before and not hidden(scene)


# ---- full disk


@pytest.fixture
def small_disk(tmp_path):
    """A file system of 8 MiB of its own, and a function that leaves so many bytes of it free."""
    disk = tmp_path / "disk"
    disk.mkdir()
    if subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=8m", "tmpfs", disk], capture_output=True
    ).returncode:
        pytest.skip("mounting a file system needs root")

    def fill(free: int) -> None:
        found = os.statvfs(disk)
        (disk / "filler").write_bytes(bytes(max(found.f_bavail * found.f_frsize - free, 0)))

    yield disk, fill
    subprocess.run(["umount", "--lazy", disk], check=True)


@pytest.mark.parametrize("free", [0, 100_000])
@pytest.mark.parametrize(
    "arguments",
    [
        ["label", "SCENE", "--overwrite"],
        ["propagate", "SCENE", "--method", "knn", "--overwrite"],
        ["evaluate", "SCENE", "--truth", "SCENE/truth"],
        *(["export", "SCENE", "--format", form] for form in ("masks", "clouds", "colmap-text")),
    ],
    ids=" ".join,
)
def test_full_disk_is_said_and_earlier_outputs_stay(finished, small_disk, capsys, arguments, free):
    disk, fill = small_disk
    scene = disk / "scene"
    shutil.copytree(finished, scene)
    before = contents(scene)
    fill(free)
    try:
        main([argument.replace("SCENE", str(scene)) for argument in arguments])
    except SystemExit as stopped:
        told = [line for line in capsys.readouterr().err.splitlines() if line.startswith("sc3d:")]
        assert stopped.code == 1 and len(told) == 1 and "no space left in" in told[0]
        after = contents(scene)
        assert {name: after.get(name) for name in before} == before and not hidden(scene)
    else:
        assert free


def test_full_disk_in_other_words(small_disk):
    """pycolmap says "No registered database factory succeeded"."""
    disk, fill = small_disk
    with pytest.raises(RuntimeError, match="factory"), telling_of_full_disk(disk / "database.db"):
        raise RuntimeError("No registered database factory succeeded.")
    fill(0)
    with pytest.raises(OSError, match="No space left"), telling_of_full_disk(disk / "database.db"):
        raise RuntimeError("No registered database factory succeeded.")


# ---- atomic_path


def test_content_is_on_the_disk_before_it_gets_its_name(tmp_path, monkeypatch, fsync):
    done, replace = [], os.replace
    monkeypatch.setattr(
        os, "fsync", lambda handle: (done.append(os.readlink(f"/proc/self/fd/{handle}")), fsync(handle))
    )
    monkeypatch.setattr(
        os, "replace", lambda source, target: (done.append("replace"), replace(source, target))
    )
    with atomic_path(tmp_path / "a.txt") as temporary:
        temporary.write_text("a")
    assert done == [str(temporary), "replace", str(tmp_path)]
    done.clear()
    with atomic_path(tmp_path / "folder") as temporary:
        (temporary / "inner").mkdir(parents=True)
        (temporary / "inner" / "b.txt").write_text("b")
    assert {str(temporary / "inner" / "b.txt"), str(temporary / "inner"), str(temporary)} == set(
        done[:-2]
    ) and done[-2:] == ["replace", str(tmp_path)]


def test_leftovers_of_a_process_of_the_same_number(tmp_path):
    """In a container every run may have the number 1."""
    unfinished = tmp_path / temporary_name("masks")
    (unfinished / "old.png").parent.mkdir()
    (unfinished / "old.png").write_text("half")
    with atomic_path(tmp_path / "masks") as temporary:
        assert temporary == unfinished
        temporary.mkdir()
    assert not list((tmp_path / "masks").iterdir())
    (tmp_path / temporary_name("seeds")).write_text("of this process")
    old = tmp_path / temporary_name("cloud")
    old.write_text("of an earlier one")
    os.utime(old, (1e9, 1e9))
    remove_leftovers(tmp_path)
    assert [entry.name for entry in hidden(tmp_path)] == [temporary_name("seeds")]
