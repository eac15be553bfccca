"""The report of a scene: one HTML page that needs nothing else."""

from __future__ import annotations

import html
import logging
import string
from importlib import resources
from pathlib import Path

from sc3d.io.atomic import atomic_path
from sc3d.io.folders import resolved
from sc3d.report.data import load_report_data
from sc3d.report.sections import headline, sections, summary_line
from sc3d.scene.scene import Scene
from sc3d.settings.common import Memory

__all__ = ["write_report"]

logger = logging.getLogger(__name__)


def write_report(scene: Scene, path: Path, settings: Memory = Memory()) -> None:
    """Write one self-contained HTML page about a scene: figures, pictures, comparison in photos, settings.

    Every part is made from files of the scene; parts whose files are missing are left out.
    path: the page to write, replaced only when it is complete; settings: what fits into memory
    Raises InputError if the scene folder does not exist or a file in it is broken.
    """
    scene.require(hint="")
    data = load_report_data(scene, settings)
    parts = [(anchor, title, body) for anchor, title, body in sections(data) if body]
    template = string.Template(_resource("page.html"))
    page = template.substitute(
        title=html.escape(resolved(scene.path).name),
        summary=summary_line(data),
        headline=headline(data),
        navigation="".join(f'<a href="#{anchor}">{html.escape(title)}</a>' for anchor, title, _ in parts),
        body="\n".join(
            f'<section id="{anchor}"><h2>{html.escape(title)}</h2>\n{body}</section>'
            for anchor, title, body in parts
        ),
        style=_resource("style.css"),
    )
    with atomic_path(path) as temporary:
        temporary.write_text(page, encoding="utf-8", errors="backslashreplace")  # names that are no text
    logger.info("report: %d sections, %.1f MB", len(parts), len(page) / 1e6)


def _resource(name: str) -> str:
    return resources.files("sc3d.report").joinpath(name).read_text(encoding="utf-8")
