"""The manual's pages of commands."""

from __future__ import annotations

import logging
from typing import get_args

from sc3d import settings
from sc3d.commands import COMMANDS, DESCRIPTIONS, STAGES
from tools.make_manual import Command, write_pages

logger = logging.getLogger(__name__)


def main(command: settings.Manual) -> None:
    pages = {name: _describe(record, name in STAGES) for name, record in sorted((STAGES | COMMANDS).items())}
    logger.info("wrote %d pages to %s", len(write_pages(command.folder, pages)), command.folder)


def _describe(record: object, scene: bool) -> Command:
    parts = get_args(record)  # a union of annotated records stands for several subcommands
    records = {part.__metadata__[0].name: part.__origin__ for part in parts} if parts else {"": record}
    return Command(" ".join((DESCRIPTIONS.get(record) or record.__doc__).split()), records, scene)
