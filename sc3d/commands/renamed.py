"""Commands and options of the version before, accepted for one version with a warning."""

from __future__ import annotations

import logging
import re
from dataclasses import fields

from sc3d.settings.labels import PaperMechanisms

logger = logging.getLogger(__name__)

MOVED = {  # commands that are tools of a checkout now
    "benchmark": "python -m tools.benchmark",
    "manual": "python tools/make_manual.py",
}
MECHANISMS = [field.name.replace("_", "-") for field in fields(PaperMechanisms)]
OPTIONS = {
    "--num-neighbours": "--num-neighbors",
    "--train.num-neighbours": "--train.num-neighbors",
    "--no-exposure": "--exposure=none",
    "--train.no-exposure": "--train.exposure=none",
    **{f"--label.{name}": f"--label.mechanisms.{name}" for name in MECHANISMS},
    **{f"--label.no-{name}": f"--label.mechanisms.no-{name}" for name in MECHANISMS},
}
COVERAGE = {"--coverage": "--fill", "--extract.coverage": "--extract.fill"}
VALUES = {("--from", "centres"): "centers", ("--extract.from", "centres"): "centers"}


def current(arguments: list[str]) -> list[str]:
    """The arguments of a command as they are spelled now; underscores in options are hyphens, as everywhere."""
    result: list[str] = []
    for argument in _filled(arguments):
        option, equals, value = argument.partition("=")
        option = option.replace("_", "-") if option.startswith("--") else option
        previous = result[-1].replace("_", "-") if result else ""
        if equals:
            new = f"{OPTIONS.get(option, option)}={VALUES.get((option, value), value)}"
            changed = option in OPTIONS or (option, value) in VALUES
        else:
            new = OPTIONS.get(option, VALUES.get((previous, argument), argument))
            changed = option in OPTIONS or (previous, argument) in VALUES
        if changed:
            logger.warning("%s is spelled %s now: the old spelling goes with the next version", argument, new)
        result.append(new if changed else argument)
    return result


def _filled(arguments: list[str]) -> list[str]:
    """`--coverage SHARE` of `extract` as `--fill`, which says what is added, not how much."""
    result, rest = [], iter(arguments)
    for argument in rest:
        option, equals, share = argument.partition("=")
        if option not in COVERAGE:
            result.append(argument)
            continue
        share = share if equals else next(rest, "")
        new = [
            COVERAGE[option],
            "nothing" if re.fullmatch(r"\+?0*\.?0*", share) and "0" in share else "occluders",
        ]
        logger.warning(
            "%s %s is %s now (nothing, continued or occluders), as surface is no longer added up to a share of the pixels: the old option goes with the next version",
            option,
            share,
            " ".join(new),
        )
        result += new
    return result
