"""By hand: `python tools/fuzz_readers.py FOLDER --cases 3000 [--readers ply-mesh laz]` damages valid files at
random and reads them.

Allowed is a result or an InputError. Anything else is a finding: another exception, more than 2 s of
processor time, more than 1 GiB above what the process takes without a file, the end of the process. A case is
made from the name of its reader and its number alone, so that `--only ply-mesh:1234` repeats it.
One line of JSON per finding and per finished part goes to FOLDER/findings.jsonl and FOLDER/parts.jsonl; parts
that are there are not repeated.

`--atheris READER` lets atheris (libFuzzer) choose the damage by the branches of sc3d's own code that it
reaches; pip install atheris.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import re
import shutil
import signal
import struct
import sys
import tempfile
import time
import traceback
from collections import Counter
from contextlib import redirect_stdout
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

PART = 500  # cases
SECONDS = 2.0
MEMORY = 1 << 30
SHARED = Path("/dev/shm") if sys.platform.startswith("linux") else None


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--cases", type=int, default=3000, help="per reader")
    parser.add_argument("--readers", nargs="*", default=[])
    parser.add_argument("--minutes", type=float, default=9, help="start no further part after this long")
    parser.add_argument("--only", help="READER:NUMBER, one case in this process, errors shown")
    parser.add_argument("--atheris", metavar="READER")
    arguments, rest = parser.parse_known_args()
    arguments.folder.mkdir(parents=True, exist_ok=True)
    if arguments.atheris:
        guided(arguments.atheris, rest)
        return
    from tests.robustness.readers import READERS

    if arguments.only:
        name, number = arguments.only.rsplit(":", 1)
        print(one_case(Fixture(name), int(number)))
        return
    if not sys.platform.startswith("linux"):
        sys.exit("needs Linux, for limits of time and memory; --only READER:NUMBER repeats a case elsewhere")
    started, parts = time.time(), arguments.folder / "parts.jsonl"
    done = (
        {(row["reader"], row["first"]) for row in map(json.loads, parts.read_text().splitlines())}
        if parts.exists()
        else set()
    )
    for first in range(0, arguments.cases, PART):
        for name in arguments.readers or READERS:
            if (name, first) not in done and time.time() - started < 60 * arguments.minutes:
                row = one_part(name, first, arguments.folder)
                with parts.open("a") as file:
                    file.write(json.dumps(row) + "\n")
                print(json.dumps(row), flush=True)


def one_part(name: str, first: int, folder: Path) -> dict:
    """Run PART cases in child processes, a new one after each that ended early."""
    progress, counts, start = tempfile.NamedTemporaryFile(dir="/dev/shm"), Counter(), first
    began = time.time()
    while start < first + PART:
        progress.truncate(0)
        child = os.fork()
        if not child:
            child_process(name, range(start, first + PART), progress.name, folder)
        _, status = os.waitpid(child, 0)
        lines = Path(progress.name).read_text().splitlines()
        counts.update(line.split()[1] for line in lines if len(line.split()) == 2)
        if os.waitstatus_to_exitcode(status) == 0:
            break
        for left in Path("/dev/shm").glob(f"sc3d-fuzz-{os.getpid()}-*"):
            shutil.rmtree(left, ignore_errors=True)
        number = int(lines[-1].split()[0]) if lines else start
        code = os.waitstatus_to_exitcode(status)
        kind = "hang" if code == -signal.SIGPROF else "crash"
        counts[kind] += 1
        report(folder, {"reader": name, "number": number, "kind": kind, "status": code})
        start = number + 1
    return {"reader": name, "first": first, "cases": PART, "wall": round(time.time() - began, 1), **counts}


def child_process(name: str, numbers: range, progress: str, folder: Path) -> None:
    import resource

    sink = os.open(os.devnull, os.O_WRONLY)
    os.dup2(sink, 1), os.dup2(sink, 2)  # native libraries say a lot
    sys.stdout, sys.stderr = open(os.devnull, "w"), open(os.devnull, "w")
    import logging

    logging.disable(logging.CRITICAL)
    signal.signal(signal.SIGPROF, signal.SIG_DFL)
    fixture = Fixture(name)
    fixture.reader.read(fixture.folder)  # loads and compiles what is needed
    size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (size + MEMORY, resource.RLIM_INFINITY))
    with open(progress, "a", buffering=1) as file:
        for number in numbers:
            file.write(f"{number}")
            file.flush()
            signal.setitimer(signal.ITIMER_PROF, SECONDS)
            result, told = one_case(fixture, number)
            signal.setitimer(signal.ITIMER_PROF, 0)
            file.write(f" {result}\n")
            if result == "foreign":
                report(folder, {"reader": name, "number": number, "kind": result, "error": told})
    shutil.rmtree(fixture.folder.parent, ignore_errors=True)
    os._exit(0)


class Fixture:
    """The valid files of a reader, in memory and in a folder."""

    def __init__(self, name: str) -> None:
        from tests.robustness.readers import READERS

        self.name, self.reader = name, READERS[name]
        self.folder = Path(tempfile.mkdtemp(prefix=f"sc3d-fuzz-{os.getppid()}-", dir=SHARED)) / "files"
        self.reader.build(self.folder)
        self.contents = {target: (self.folder / target).read_bytes() for target in self.reader.targets}

    def case(self, number: int) -> dict[str, bytes]:
        """Damaged contents of one file, or sometimes of two."""
        from tests.robustness.hostile_files import damage, damage_json
        from tests.robustness.readers import TEXT

        rng = random.Random(f"{self.name}:{number}")
        chosen = rng.sample(
            self.reader.targets, 2 if len(self.reader.targets) > 1 and rng.random() < 0.1 else 1
        )
        damaged = {}
        for target in chosen:
            content, is_json = self.contents[target], target.endswith(".json")
            damaged[target] = (
                damage_json(content, rng)
                if is_json and rng.random() < 0.7
                else damage(content, rng, Path(target).suffix in TEXT or b"ascii" in content[:20])
            )
        return damaged


def one_case(fixture: Fixture, number: int) -> tuple[str, str]:
    """ "read", "refused" or "foreign", and what was said."""
    return read_damaged(fixture, fixture.case(number))


def read_damaged(fixture: Fixture, damaged: dict[str, bytes]) -> tuple[str, str]:
    from sc3d.errors import InputError

    for target, content in damaged.items():
        (fixture.folder / target).write_bytes(content)
    try:
        with redirect_stdout(sys.stdout):
            fixture.reader.read(fixture.folder)
        return "read", ""
    except InputError as error:
        text = str(error)
        return ("refused", text) if 0 < len(text) < 5000 else ("foreign", f"message of {len(text)} letters")
    except BaseException as error:  # panics of lazrs are no Exception
        where = traceback.extract_tb(error.__traceback__)[-3:]
        return "foreign", f"{type(error).__name__}: {str(error)[:200]} | " + " < ".join(
            f"{Path(frame.filename).name}:{frame.lineno}" for frame in reversed(where)
        )
    finally:
        for target in damaged:
            (fixture.folder / target).write_bytes(fixture.contents[target])


def report(folder: Path, row: dict) -> None:
    with (folder / "findings.jsonl").open("a") as file:
        file.write(json.dumps(row) + "\n")


def guided(name: str, rest: list[str]) -> None:
    """libFuzzer chooses a target by the first byte and the content by the rest; its arguments, such as
    -runs=10000, are passed on.
    """
    import atheris

    compiled = [
        ".".join(file.relative_to(ROOT).with_suffix("").parts)
        for file in (ROOT / "sc3d").rglob("*.py")
        if re.search("@numba|@intrinsic", file.read_text())
    ]
    # numba cannot compile what atheris has changed
    with atheris.instrument_imports(include=["sc3d"], exclude=compiled):
        fixture = Fixture(name)
        fixture.reader.read(fixture.folder)  # loads the code under test
    corpus = fixture.folder.parent / "corpus"
    corpus.mkdir()
    for row, content in enumerate(fixture.contents.values()):
        (corpus / f"{row}").write_bytes(struct.pack("B", row) + content)

    def once(data: bytes) -> None:
        if not data:
            return
        target = fixture.reader.targets[data[0] % len(fixture.reader.targets)]
        result, told = read_damaged(fixture, {target: data[1:]})
        if result == "foreign":
            raise RuntimeError(told)

    atheris.Setup(
        [
            sys.argv[0],
            "-rss_limit_mb=3000",
            "-timeout=20",
            "-max_len=20000",
            "-len_control=0",
            "-reduce_inputs=0",
            *rest,
            str(corpus),
        ],
        once,
    )
    atheris.Fuzz()


if __name__ == "__main__":
    main()
