"""Before hours of work: what is wrong with photos, positions and masks, and how long the stages will take."""

from __future__ import annotations

import logging
import sys
from pathlib import Path

import numpy as np

from sc3d.commands.plan import Stage, expected_seconds, plan, warn_of_slow
from sc3d.commands.run import list_stages
from sc3d.errors import InputError
from sc3d.io.atomic import require_writable
from sc3d.io.json_files import write_json
from sc3d.io.progress import under_way
from sc3d.preflight.check import CheckResult, check_folder
from sc3d.runner import files
from sc3d.scene.scene import Scene
from sc3d.settings.outputs import Check, Run

logger = logging.getLogger(__name__)


def main(command: Check) -> None:
    """Tell what was found, write JSON, and exit with status 1 if there is a problem."""
    scene = scene_at(command.path)
    output = command.json or (scene.check if scene else None)
    if output is not None:
        require_writable(output.parent)
    with under_way("check"):
        result = check_folder(scene.images if scene else command.path, scene)
    stages, runs = _stages(command, scene)
    _tell(result, plan(stages, runs, result.sizes, finished="done"))
    warn_of_slow(stages, runs, result.sizes)
    problems = sum(finding.problem for finding in result.findings)
    logger.info("check: %s", "ready" if result.ready else f"not ready, {problems} problems")
    if output is not None:
        seconds = zip(stages, expected_seconds(stages, runs, result.sizes), strict=True)
        write_json(output, result.as_json() | {"seconds": {name: told for (name, _), told in seconds}})
        logger.info("wrote %s", output)
    if not result.ready:
        sys.exit(1)


def scene_at(path: Path) -> Scene | None:
    """The scene in a folder; None for a folder of photos. InputError if there is neither."""
    if not path.is_dir():
        raise InputError(f"{path} is not a folder: give the folder of photos, or a scene folder")
    scene = Scene(path)
    if not scene.images.exists() and not scene.sparse.is_dir():
        return None
    scene.require(scene.images, hint="link the folder of photos there")
    return scene


def _stages(command: Check, scene: Scene | None) -> tuple[list[Stage], list[bool]]:
    """The stages of `sc3d run`, and which are still to do."""
    where = scene or Scene(command.path)
    run = Run(
        where.images,
        where.path,
        reconstruct=command.reconstruct,
        depth=command.depth,
        train=command.train,
        extract=command.extract,
    )
    stages = list_stages(run, where, run.segment)
    outputs = [files(name, where, settings)[1] for name, settings in stages]
    return stages, [scene is None or not all(path.exists() for path in paths) for paths in outputs]


def _tell(result: CheckResult, expected: str) -> None:
    figures = list(result.photos.values())
    overlaps, covered = ([getattr(each, name) for each in figures] for name in ("overlap", "covered"))
    logger.info(
        "%d photos: the best other shows %.0f %% of each on the median, two others %.0f %%",
        len(figures),
        100 * np.median(overlaps),
        100 * np.median(covered),
    )
    coverage = result.coverage
    if coverage is not None:
        side = f"{coverage.cell:.3g} m" if coverage.metric else "units of their own"
        logger.info(
            "photos that show each place, from above, north up (a cell is %s wide; . = none, + = ten or more); %.0f %% of it is shown by three or more\n%s",
            side,
            100 * coverage.enough,
            coverage.text(),
        )
    for finding in result.findings:
        logger.log(logging.WARNING if finding.problem else logging.INFO, finding.line())
    logger.info(expected)
