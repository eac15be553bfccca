"""By hand: `python tools/demo.py [FOLDER]` runs the whole chain on synthetic photos, with the Python it is called by; `bash tools/demo.sh`
sets that up first. The true cameras are not used.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path

TOOLS = Path(__file__).resolve().parent
LIMITS = "--train.iterations 1500 --depth.max-size 640 --train.max-size 640 --extract.max-size 640"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, nargs="?", default=TOOLS.parent / "demo")
    folder = parser.parse_args().folder
    for name, *arguments in commands(folder):
        status = subprocess.run([sys.executable, TOOLS / f"{name}.py", *arguments], check=False).returncode
        if status:
            sys.exit(status)
    print(f"report: {folder / 'scene' / 'report.html'}\npicture: {folder / 'labelled.png'}")


def commands(folder: Path) -> list[list[str]]:
    """The words behind `sc3d`, command by command."""
    site, scene = folder / "site", str(folder / "scene")
    given = {"masks": "masks", "confidence": "confidence", "classes": "classes.json", "truth": "truth"}
    inputs = [word for option, name in given.items() for word in (f"--{option}", str(site / name))]
    return [
        ["synthesize", str(site), *"--views 24 --width 640 --num-points 300000".split()],
        ["run", str(site / "images"), scene, *inputs, *LIMITS.split()],
        ["view", scene, "--screenshot", str(folder / "labelled.png")],
    ]


if __name__ == "__main__":
    main()
