"""By hand and in CI: `python tools/check_wheel.py` builds the wheel, installs it into a bare environment, and works with it in an empty
folder: `sc3d synthesize`, `run`, `view --html` and `view --web`. Without --packages pip fetches all dependencies (1 GB and more).
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
import urllib.request
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
SOURCES = ("sc3d", "setup.cfg", "pyproject.toml", "README.md", "LICENSE")
PATIENCE = 120  # s until `view --web` answers


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--packages",
        type=Path,
        help="site-packages of another environment that has the dependencies, instead of fetching them",
    )
    packages = parser.parse_args().packages
    with tempfile.TemporaryDirectory(prefix="sc3d-wheel-") as folder:
        work = Path(folder).resolve()
        wheel = build(work)
        require_complete(wheel)
        use(environment(work, wheel, packages), work / "elsewhere")
    print(f"{wheel.name} works")


def build(work: Path) -> Path:
    """The wheel, of a copy: what earlier builds have left in the checkout would go into it."""
    source = work / "source"
    source.mkdir()
    for name in SOURCES:
        path, to = ROOT / name, source / name
        if path.is_dir():
            shutil.copytree(path, to, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copyfile(path, to)
    run([sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", work, source], work)
    (wheel,) = work.glob("sc3d-*.whl")
    return wheel


def require_complete(wheel: Path) -> None:
    """Every file of the package is in the wheel."""
    with zipfile.ZipFile(wheel) as archive:
        packed = set(archive.namelist())
    package = {
        path.relative_to(ROOT).as_posix()
        for path in (ROOT / "sc3d").rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    if missing := sorted(package - packed):
        sys.exit(f"{wheel.name} lacks {', '.join(missing)}: add them to package_data in setup.cfg")


def environment(work: Path, wheel: Path, packages: Path | None) -> Path:
    """The folder of the programs of an environment in which the wheel is installed."""
    venv = work / "venv"
    run([sys.executable, "-m", "venv", venv], work)
    programs = venv / ("Scripts" if os.name == "nt" else "bin")
    pip = [programs / "python", "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    if packages is None:
        run([*pip, "-c", ROOT / "tools" / "constraints.txt", f"{wheel}[web]"], work)
    else:
        run([*pip, "--no-deps", wheel], work)
        (site,) = venv.rglob("site-packages")
        (site / "borrowed.pth").write_text(f"{packages.resolve()}\n")
    return programs


def use(programs: Path, folder: Path) -> None:
    """Work with the wheel in `folder`, which is made."""
    folder.mkdir()
    sc3d = programs / "sc3d"
    found = run([programs / "python", "-c", "import sc3d; print(sc3d.__file__)"], folder).strip()
    if not Path(found).is_relative_to(programs.parent):
        sys.exit(f"not the wheel was tried, but {found}")
    run([sc3d, "--help"], folder)
    run([sc3d, "synthesize", "site", *"--views 8 --width 240 --extent 50 --num-points 20000".split()], folder)
    given = "--masks site/masks --classes site/classes.json --truth site/truth"
    surface = "--extract.from depth --depth.max-size 240 --extract.max-size 240"
    run([sc3d, "run", "site/images", "scene", *given.split(), *surface.split()], folder)
    run([sc3d, "view", "scene", "--html", "view.html"], folder)
    for name in ("scene/labelled.ply", "scene/report.html", "view.html"):
        if not (folder / name).stat().st_size:
            sys.exit(f"{name} is empty")
    look_at_web(sc3d, folder)


def look_at_web(sc3d: Path, folder: Path) -> None:
    """Open the page of `sc3d view --web`; ends the process if there is none."""
    port = 8765
    log = folder / "web.log"
    with log.open("w") as out:
        server = subprocess.Popen(
            [sc3d, "view", "scene", "--web", "--port", str(port)],
            cwd=folder,
            env=bare(),
            stdout=out,
            stderr=out,
        )
    try:
        until = time.monotonic() + PATIENCE
        while "http" not in log.read_text():
            if server.poll() is not None or time.monotonic() > until:
                sys.exit(f"sc3d view --web does not answer:\n{log.read_text()}")
            time.sleep(0.5)
        address = next(word for word in log.read_text().split() if word.startswith("http"))
        with urllib.request.urlopen(address.rstrip(",;."), timeout=20) as page:
            if b"<html" not in page.read().lower():
                sys.exit(f"{address} is no page")
    finally:
        server.terminate()
        server.wait()


def run(words: list[object], folder: Path) -> str:
    """What a command prints; ends the process with its messages if it fails."""
    print("+", *(getattr(word, "name", word) for word in words), flush=True)
    done = subprocess.run(
        [str(word) for word in words], cwd=folder, env=bare(), check=False, capture_output=True, text=True
    )
    if done.returncode:
        sys.exit(f"{done.stdout}{done.stderr}")
    return done.stdout


def bare() -> dict[str, str]:
    """The environment variables without those that lead Python to other packages."""
    return {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "VIRTUAL_ENV")}


if __name__ == "__main__":
    main()
