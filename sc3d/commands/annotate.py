"""Strokes, drawn on a page in the browser -> strokes/; or answers about places -> corrections.json."""

from __future__ import annotations

import logging

from sc3d.io.atomic import require_writable
from sc3d.scene.scene import Scene
from sc3d.settings.labels import Annotate

DRAWN = "strokes go to {strokes}; `sc3d segment {scene} --backend strokes` makes the masks"
SUGGESTED = "answers go to {corrections}; `sc3d propagate {scene}` makes labels of them"

logger = logging.getLogger(__name__)


def main(command: Annotate) -> None:
    from sc3d.annotate.server import AnnotationServer, Handler, SuggestHandler
    from sc3d.annotate.session import Session
    from sc3d.annotate.suggestions import Suggestions

    scene = Scene(command.scene)
    scene.require(hint="")
    require_writable(scene.path)
    session = Suggestions(scene) if command.suggest else Session(scene, command.photo)
    told = SUGGESTED if command.suggest else DRAWN
    with AnnotationServer(session, command.port, SuggestHandler if command.suggest else Handler) as server:
        logger.info("open %s in a browser on this machine; Ctrl + C ends it", server.url)
        logger.info(told.format(scene=scene.path, strokes=scene.strokes, corrections=scene.corrections))
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            logger.info("ended")
