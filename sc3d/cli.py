"""The command line: `sc3d STAGE ...`; options come from `sc3d.settings`, heavy imports after parsing."""

from __future__ import annotations

import dataclasses
import importlib
import os
import re
import signal
import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Annotated, Any

import tyro
from tyro.conf import FlagCreatePairsOff, OmitArgPrefixes, Positional, PositionalMetavarFromFieldName

from sc3d.commands import COMMANDS, MODULES, STAGES
from sc3d.commands.renamed import MOVED, current
from sc3d.errors import InputError, Sc3dError
from sc3d.io.messages import printable, start_logging, write_to_log_file
from sc3d.io.requirements import explain
from sc3d.settings.common import Messages

# numba reads it in whatever folder a command is called, also in a scene of somebody else
NUMBA_FILE = ".numba_config.yaml"
FIRST = ("run", "check", "reconstruct", "import")  # in the list of commands
SHELLS = ("bash", "zsh", "tcsh", "fish")
GROUPED = "\n\nThe everyday options come first, then those of each stage under its name, in the order in which the stages run."
COMPLETION = ("--tyro-print-completion", "--tyro-write-completion")
WAYS = """From photos to a labelled cloud, the three usual ways (sc3d synthesize SITE makes photos and masks to try them on):

  photos alone (ground, vegetation and building, from the shape of the scene):
    sc3d run PHOTOS SCENE

  classes of your own, by masks made elsewhere (COCO, LabelMe, CVAT, PNG) or by a few strokes drawn in the browser:
    sc3d run PHOTOS SCENE --classes CLASSES.json --masks MASKS

    sc3d reconstruct PHOTOS SCENE
    sc3d annotate SCENE                      (needs SCENE/classes.json, the names of the classes)
    sc3d run PHOTOS SCENE --segment.backend strokes

  a cloud and cameras of another program (ODM, Metashape, Pix4D, COLMAP, nerfstudio), and masks:
    sc3d import PROJECT SCENE --cloud CLOUD
    sc3d segment SCENE --masks MASKS         (needs SCENE/classes.json, or --backend geometry instead of masks)
    sc3d label SCENE
    sc3d propagate SCENE

Then look at SCENE/report.html (sc3d report SCENE), or: sc3d view SCENE --web

"""


def main(arguments: list[str] | None = None) -> None:
    """Run one command and exit: 0 done, 1 failed, 2 bad input, 130 interrupted by Ctrl-C, 143 by SIGTERM."""
    open_closed_streams()
    arguments = expanded(sys.argv[1:] if arguments is None else arguments)
    if not arguments or arguments[0] in ("-h", "--help"):
        with ending_with_reader():
            sys.stdout.write(usage() if arguments else WAYS + usage())
        sys.exit(0 if arguments else 2)
    name = arguments[0]
    if name in COMPLETION:
        with ending_with_reader(), reporting_errors():
            print_completion(arguments)
    if name in MOVED:
        sys.exit(
            _fail(f"`sc3d {name}` is a tool of the checkout now: {MOVED[name]} {' '.join(arguments[1:])}")
        )
    if name not in STAGES and name not in COMMANDS:
        sys.exit(_fail(f"unknown command {name!r}: one of {', '.join(sorted(STAGES | COMMANDS))}"))
    if Path(NUMBA_FILE).exists():
        sys.exit(
            _fail(
                f"{Path(NUMBA_FILE).absolute()} would tell numba where to load code from: start sc3d in another folder"
            )
        )
    start_logging()
    with ending_with_reader(), reporting_errors():
        command, messages = parse(name, current(arguments[1:]))
    with reporting_errors():
        start_logging(messages.quiet, messages.verbose, messages.log)
        _dispatch(name, command)


def expanded(arguments: list[str]) -> list[str]:
    """Arguments with `~` at the start of a path as the home folder, which shells leave in `--masks=~/masks`."""
    found = [re.fullmatch(r"(--[\w.-]+=)?(~(?:/.*)?)", argument) for argument in arguments]
    return [
        (match[1] or "") + os.path.expanduser(match[2]) if match else argument
        for match, argument in zip(found, arguments, strict=True)
    ]


def open_closed_streams() -> None:
    """Lead input, output and errors that are closed, as by `>&-`, to nowhere. Else the next file that is opened
    gets their number, and what a native library prints goes into it.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            opened = os.open(os.devnull, os.O_RDWR)
            if opened != number:
                os.dup2(opened, number)
                os.close(opened)
    sys.stdout = sys.stdout or open(os.devnull, "w")
    sys.stderr = sys.stderr or open(os.devnull, "w")


@contextmanager
def ending_with_reader() -> Iterator[None]:
    """For what is printed: `sc3d --help | head` ends quietly. Not for more than that: a server whose visitor
    leaves, or a command whose worker dies, must not end.
    """
    if not hasattr(signal, "SIGPIPE"):  # Windows
        yield
        return
    before = signal.signal(signal.SIGPIPE, signal.SIG_DFL)
    try:
        yield
    finally:
        sys.stdout.flush()
        signal.signal(signal.SIGPIPE, before or signal.SIG_DFL)


@contextmanager
def reporting_errors() -> Iterator[None]:
    """What goes wrong in the block is told in one line and ends the process, see `main`."""
    try:
        yield
    except InputError as error:
        sys.exit(_fail(str(error)))
    except PermissionError as error:
        sys.exit(_fail(f"no permission for {error.filename}: check its permissions or choose another folder"))
    except Sc3dError as error:
        sys.exit(_fail(str(error), status=1))
    except (OSError, MemoryError) as error:
        sys.exit(_fail(explain(error) or str(error) or type(error).__name__, status=1))
    except (ImportError, AttributeError, RuntimeError) as error:
        reason = explain(error)
        if reason is None:
            write_to_log_file(traceback.format_exc())
            raise
        sys.exit(_fail(reason, status=1))
    except KeyboardInterrupt as error:
        told, number = (
            ("ended by SIGTERM", signal.SIGTERM)
            if isinstance(error, Terminated)
            else ("interrupted", signal.SIGINT)
        )
        sys.exit(
            _fail(f"{told}; finished work is kept, run the same command again to go on", status=128 + number)
        )


def usage() -> str:
    """The list of commands, each with the first sentence about it."""
    lines = ["usage: sc3d COMMAND ...   (sc3d COMMAND --help shows the options)", ""]
    records = {name: COMMANDS[name] for name in FIRST} | STAGES | COMMANDS
    width = max(map(len, records)) + 2
    for name, record in records.items():
        sentence = re.split(r"(?<=[.;]) ", " ".join(_describe(record).split()))[0]
        lines.append(f"  {name:{width}s}{sentence.rstrip('.;')}")
    return "\n".join(lines) + "\n"


def parse(name: str, arguments: list[str]) -> tuple[Any, Messages]:
    """Arguments to the settings record of a command, and what is told; exits with status 2 on a usage error."""
    command = with_messages(name)
    parsed: Any = tyro.cli(
        command,
        args=arguments,
        prog=f"sc3d {name}",
        description=_describe(command) + (GROUPED if name == "run" else ""),
        config=(PositionalMetavarFromFieldName,),
    )
    return parsed.command, parsed.messages


def print_completion(arguments: list[str]) -> None:
    """tyro's script for the completion of all commands: --tyro-print-completion SHELL, or
    --tyro-write-completion SHELL FILE; ends the process.
    """
    if len(arguments) != 2 + COMPLETION.index(arguments[0]) or arguments[1] not in SHELLS:
        sys.exit(
            _fail(
                f"{arguments[0]} takes a shell ({', '.join(SHELLS)}){' and a file' * (arguments[0] == COMPLETION[1])}"
            )
        )
    for file in arguments[2:]:
        Path(file).parent.mkdir(parents=True, exist_ok=True)
    commands: dict[str, Any] = {name: with_messages(name) for name in sorted(STAGES | COMMANDS)}
    tyro.extras.subcommand_cli_from_dict(commands, prog="sc3d", args=arguments)


def with_messages(name: str) -> type:
    """The record of a command, and beside it the options that all commands have."""
    record = COMMANDS.get(name) or scene_command(STAGES[name])
    command = dataclasses.make_dataclass(
        "WithMessages",
        [
            ("command", Annotated[record, tyro.conf.arg(name="")]),
            ("messages", Annotated[FlagCreatePairsOff[Messages], tyro.conf.arg(name="")], Messages()),
        ],
        frozen=True,
    )
    command.__doc__ = record.__doc__
    return command


def scene_command(record: type) -> type:
    """A record with the scene folder, the stage's own options without prefix, and --overwrite."""
    command = dataclasses.make_dataclass(
        "Command",
        [
            ("scene", Annotated[Positional[Path], tyro.conf.arg(help="Scene folder.")]),
            ("settings", OmitArgPrefixes[record], dataclasses.field(default_factory=record)),  # type: ignore[valid-type, misc]  # made at run time
            (
                "overwrite",
                Annotated[bool, tyro.conf.arg(help="Run again even if the outputs are up to date.")],
                False,
            ),
        ],
        frozen=True,
    )
    command.__doc__ = record.__doc__
    return command


def _describe(record: type) -> str:
    return (record.__doc__ or "").strip()


def _dispatch(name: str, command: Any) -> None:
    if name in COMMANDS:
        module = importlib.import_module(MODULES.get(name, f"sc3d.commands.{name}"))
        with ending_when_told():
            module.main(command)
        return
    from sc3d.runner import execute
    from sc3d.scene.scene import Scene

    with ending_when_told():
        execute(name, Scene(command.scene), command.settings, command.overwrite)


class Terminated(KeyboardInterrupt):
    """SIGTERM."""


@contextmanager
def ending_when_told() -> Iterator[None]:
    """SIGTERM ends the block like Ctrl-C, once the call into a library that is under way comes back. Without this
    it is for the handler that pycolmap brings when it is imported (so that is done here, before), which prints a
    stack trace and may wait for ever for a lock that the interrupted thread holds.
    """
    with suppress(ImportError):  # `sc3d doctor` tells what is missing
        import pycolmap  # noqa: F401

    def end(*_: object) -> None:
        raise Terminated

    before = signal.signal(signal.SIGTERM, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before or signal.SIG_DFL)


def _fail(message: str, status: int = 2) -> int:
    line = f"sc3d: {printable(' '.join(message.split()))}"
    write_to_log_file(line)
    with suppress(BrokenPipeError):
        sys.stderr.write(f"{line}\n")
    return status
