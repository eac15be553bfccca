"""`sc3d benchmark city`: a city large enough to measure memory and growth on, and what it took to make."""

from __future__ import annotations

import logging
import time

from sc3d.errors import InputError
from sc3d.io.atomic import remove_leftovers, require_writable
from sc3d.io.json_files import write_json
from sc3d.io.provenance import peak_memory_mb, versions
from sc3d.settings.synthesize import SynthesizeCity
from sc3d.synthetic.city import synthesize_city

logger = logging.getLogger(__name__)


def run_city(command: SynthesizeCity) -> None:
    """Make the city; its sizes, the time and the memory go to SCENE/city.json."""
    if min(*command.sites, command.points_per_site, command.views) < 1 or command.width < 32:
        raise InputError("sites, points and views must be at least 1, the width at least 32 px")
    remove_leftovers(command.scene)
    if command.scene.exists() and (not command.scene.is_dir() or any(command.scene.iterdir())):
        raise InputError(f"{command.scene} is there already: choose a new or empty folder")
    require_writable(command.scene)
    cpu, wall = time.process_time(), time.perf_counter()
    made = synthesize_city(command)
    took = {
        "cpu_seconds": round(time.process_time() - cpu, 1),
        "wall_seconds": round(time.perf_counter() - wall, 1),
        "peak_memory_mb": peak_memory_mb(),
    }
    files = [file for file in command.scene.rglob("*") if file.is_file() and not file.is_symlink()]
    record = (
        {
            "benchmark": "city",
            "sites": command.sites,
            "width": command.width,
            "seed": command.seed,
            "versions": versions(),
        }
        | made
        | took
    )
    record["bytes"] = sum(file.stat().st_size for file in files)
    write_json(command.scene / "city.json", record)
    logger.info("%s: %s", command.scene, record)
