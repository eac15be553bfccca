"""Strokes, drawn on a page in the browser -> strokes/."""

from __future__ import annotations

import logging

from sc3d.io.atomic import require_writable
from sc3d.scene.scene import Scene
from sc3d.settings.labels import Annotate

logger = logging.getLogger(__name__)


def main(command: Annotate) -> None:
    from sc3d.annotate.server import AnnotationServer
    from sc3d.annotate.session import Session

    scene = Scene(command.scene)
    scene.require(hint="")
    require_writable(scene.path)
    with AnnotationServer(Session(scene, command.photo), command.port) as server:
        logger.info(
            "open %s in a browser on this machine; Ctrl + C ends it\nstrokes go to %s; `sc3d segment %s --backend strokes` makes the masks",
            server.url,
            scene.strokes,
            scene.path,
        )
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            logger.info("ended")
