"""By hand: `python tools/demo.py [FOLDER] [--full]` runs the whole chain on synthetic photos, with the Python it is called by; `bash
tools/demo.sh` sets that up first. The true cameras are not used.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from pathlib import Path

TOOLS = Path(__file__).resolve().parent
# a small site, and its surface from depth maps instead of trained Gaussians
SHORT_SITE = "--views 18 --width 480 --extent 60 --altitude 55 --num-points 100000"
SHORT = "--extract.from depth --depth.max-size 480 --depth.num-sources 4 --extract.max-size 480"
FULL_SITE = "--views 24 --width 640 --num-points 300000"
FULL = "--train.iterations 1500 --depth.max-size 640 --train.max-size 640 --extract.max-size 640"


def main() -> None:
    started = time.perf_counter()
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, nargs="?", help="default: demo, or demo-full")
    parser.add_argument(
        "--full", action="store_true", help="a larger site, with trained Gaussians: some eight minutes"
    )
    asked = parser.parse_args()
    folder = asked.folder or TOOLS.parent / ("demo-full" if asked.full else "demo")
    for name, *arguments in commands(folder, asked.full):
        status = subprocess.run([sys.executable, TOOLS / f"{name}.py", *arguments], check=False).returncode
        if status:
            sys.exit(status)
    print(ending(folder, time.perf_counter() - started))


def commands(folder: Path, full: bool = False) -> list[list[str]]:
    """The words behind `sc3d`, command by command."""
    site, scene = folder / "site", str(folder / "scene")
    given = {"masks": "masks", "confidence": "confidence", "classes": "classes.json", "truth": "truth"}
    inputs = [word for option, name in given.items() for word in (f"--{option}", str(site / name))]
    return [
        ["synthesize", str(site), *(FULL_SITE if full else SHORT_SITE).split()],
        ["run", str(site / "images"), scene, *inputs, *(FULL if full else SHORT).split()],
        ["view", scene, "--screenshot", str(folder / "labelled.png")],
    ]


def ending(folder: Path, seconds: float) -> str:
    """How good the labels are, and what there is to look at."""
    figures = json.loads((folder / "scene" / "metrics.json").read_text())
    masks, labels = (100 * figures[name]["miou"] for name in ("masks", "labels"))
    return "\n".join(
        [
            f"the demo took {seconds:.0f} s; mean IoU against the truth: {masks:.1f} % of the masks that went in, {labels:.1f} % of the labels",
            f"picture: {folder / 'labelled.png'}",
            f"report:  {folder / 'scene' / 'report.html'}",
            f"turn it: {Path(sys.executable).parent / 'sc3d'} view {folder / 'scene'} --web",
        ]
    )


if __name__ == "__main__":
    main()
