"""Where a benchmark's figures go: the log, a JSON file, a Markdown page beside it."""

from __future__ import annotations

import logging
from pathlib import Path

from sc3d.errors import InputError
from sc3d.io.atomic import atomic_path, require_writable
from sc3d.io.json_files import write_json

logger = logging.getLogger(__name__)


def check_output(output: Path | None) -> None:
    """Raise InputError, before any work, unless figures can be written to `output`."""
    if output is None:
        return
    if output.suffix != ".json":
        raise InputError(f"{output}: the figures are written as JSON (and .md beside), so name it .json")
    require_writable(output.parent)


def publish(record: dict, page: str, output: Path | None) -> None:
    """Log the page; write the record as JSON and the page as Markdown beside it, each atomically."""
    logger.info("%s", page)
    if output is None:
        return
    write_json(output, record)
    with atomic_path(output.with_suffix(".md")) as temporary:
        temporary.write_text(page, encoding="utf-8")
    logger.info("wrote %s and %s", output, output.with_suffix(".md"))
