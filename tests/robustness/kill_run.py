"""By hand: `python tests/robustness/kill_run.py FOLDER --kills 50` kills `sc3d run` on a small synthetic site at random
moments and runs it again.

Each time the second run must complete, leave no hidden files, and write the bytes of an uninterrupted run. A
moment is a share of the processor time of that run, so that a busy machine does not shift it. One line of
JSON per kill goes to FOLDER/kills.jsonl; what is there already is not repeated.
`--signal INT` presses Ctrl-C instead: then the first run must also end with status 130 and one clear line.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

COMMAND = [sys.executable, "-c", "import sys; from sc3d.cli import main; main(sys.argv[1:])"]
SITE = ["--width", "240", "--extent", "50", "--altitude", "35", "--num-points", "20000"]
OPTIONS = [
    "--train.iterations",
    "30",
    "--train.max-size",
    "240",
    "--train.max-gaussians",
    "5000",
    "--train.checkpoint-every",
    "10",
    "--extract.max-size",
    "240",
]
COMPARED = ("labelled.ply", "seeds.ply", "mesh.ply", "cloud.ply", "gaussians.ply", "sparse/0/points3D.bin")
TICK = os.sysconf("SC_CLK_TCK")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--photos", type=int, default=6, help="of the site, when it is made")
    parser.add_argument("--signal", choices=("KILL", "INT"), default="KILL")
    parser.add_argument("--minutes", type=float, default=9, help="start no further kill after this long")
    arguments = parser.parse_args()
    started, folder = time.time(), arguments.folder.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    if not (folder / "site" / "truth.ply.json").exists():
        views = ["--views", str(arguments.photos)]
        subprocess.run([*COMMAND, "synthesize", str(folder / "site"), *SITE, *views], check=True)
    reference = reference_run(folder)
    results = folder / "kills.jsonl"
    done = (
        {(row["signal"], row["number"]) for row in map(json.loads, results.read_text().splitlines())}
        if results.exists()
        else set()
    )
    for number in range(arguments.kills):
        if (arguments.signal, number) not in done and time.time() - started < 60 * arguments.minutes:
            row = one_kill(folder, number, arguments.signal, reference)
            with results.open("a") as file:
                file.write(json.dumps(row) + "\n")
            print(json.dumps(row), flush=True)


def run(folder: Path, scene: Path, log: Path) -> subprocess.Popen:
    site = folder / "site"
    given = [
        "--masks",
        site / "masks",
        "--confidence",
        site / "confidence",
        "--classes",
        site / "classes.json",
    ]
    with log.open("wb") as file:
        return subprocess.Popen(
            [*COMMAND, "run", *map(str, (site / "images", scene, *given)), *OPTIONS],
            stderr=file,
            stdout=file,
            start_new_session=True,
        )


def reference_run(folder: Path) -> dict:
    """Digests and processor time of an uninterrupted run; kept in FOLDER/reference.json. Two runs: the first
    compiles, and both must write the same.
    """
    record, scene, found = folder / "reference.json", folder / "reference", []
    if not record.exists():
        for _ in range(2):
            shutil.rmtree(scene, ignore_errors=True)
            process = run(folder, scene, folder / "reference.log")
            _, status, used = os.wait4(process.pid, 0)
            assert status == 0, (folder / "reference.log").read_text()
            found.append({"seconds": used.ru_utime + used.ru_stime, "digests": digests(scene)})
        assert found[0]["digests"] == found[1]["digests"], found
        record.write_text(json.dumps(found[1]))
    return json.loads(record.read_text())


def one_kill(folder: Path, number: int, name: str, reference: dict) -> dict:
    scene, log = folder / f"killed-{name}-{number}", folder / f"killed-{name}-{number}.log"
    shutil.rmtree(scene, ignore_errors=True)
    moment = random.Random(f"{name} {number}").uniform(0.02, 1)
    process = run(folder, scene, log)
    while process.poll() is None and cpu_seconds(process.pid) < moment * reference["seconds"]:
        time.sleep(0.01)
    reached = (
        sorted(str(path.relative_to(scene)) for path in scene.glob("**/*.json")) if scene.exists() else []
    )
    alive = process.poll() is None
    if alive:
        process.send_signal(getattr(signal, f"SIG{name}"))
    status, told = process.wait(), log.read_text(errors="replace").splitlines()
    row = {
        "signal": name,
        "number": number,
        "moment": round(moment, 3),
        "alive": alive,
        "status": status,
        "finished": len(reached),
        "left": hidden(scene),
        "last": told[-1][:160] if told else "",
    }
    if name == "INT" and alive:
        row["clear"] = (
            status == 130
            and sum(line.startswith("sc3d:") for line in told) == 1
            and "Traceback" not in "\n".join(told)
        )
    again = run(folder, scene, log)
    row |= {"rerun": again.wait(), "same": digests(scene) == reference["digests"], "hidden": hidden(scene)}
    if row["rerun"] == 0 and row["same"] and not row["hidden"] and row.get("clear", True):
        shutil.rmtree(scene)
        log.unlink()
    return row


def cpu_seconds(process: int) -> float:
    try:
        words = Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()
    except OSError:
        return 0.0
    return (int(words[11]) + int(words[12])) / TICK


def digests(scene: Path) -> dict[str, str]:
    return {
        name: hashlib.sha256((scene / name).read_bytes()).hexdigest() if (scene / name).exists() else ""
        for name in COMPARED
    }


def hidden(scene: Path) -> list[str]:
    def names() -> Iterator[str]:
        for path in scene.rglob(".*") if scene.exists() else ():
            yield str(path.relative_to(scene))

    return sorted(names())


if __name__ == "__main__":
    main()
