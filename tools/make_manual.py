"""Writes the manual's pages of commands, from the same records as `--help`, and those of the geometry utilities,
from their docstrings: `python tools/make_manual.py [FOLDER]`.
"""

from __future__ import annotations

import argparse
import ast
import inspect
import sys
import textwrap
from dataclasses import MISSING, dataclass, fields, is_dataclass, replace
from functools import cache
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from sc3d.commands import COMMANDS, STAGES
from sc3d.io.json_files import write_text
from sc3d.settings.common import Messages
from tools.docstring_pages import module_page, public, summary

ROOT = Path(__file__).resolve().parent.parent
GEOMETRY = ROOT / "sc3d" / "geometry"
NOTE_GEOMETRY = (
    "<!-- Written by `python tools/make_manual.py`; edit the docstrings of sc3d/geometry instead. -->"
)
GEOMETRY_ABOUT = """`sc3d.geometry` knows nothing of classes and of files of photos, and stands alone: numpy arrays and Open3D's tensors in and out.
[By example](../geometry-by-example.md) goes through it; here is every public function, from its docstring."""
NOTE = "<!-- Written by `python tools/make_manual.py`; edit sc3d/settings instead. -->"


@dataclass(frozen=True)
class Option:
    """One option of a command. flag: as typed; values: what it takes; default: as text, "" = required; help:
    one paragraph; group: what the options of a record within the record have in common, "" = none.
    """

    flag: str
    values: str
    default: str
    help: str
    group: str = ""


@dataclass(frozen=True)
class Command:
    """A command of the manual.

    about: one sentence; records: settings by subcommand, {"": record} if it has none; scene: it takes a scene
        folder and --overwrite beside its record
    """

    about: str
    records: dict[str, type]
    scene: bool


@cache
def helps(record: type) -> dict[str, str]:
    """The docstring below each field of a settings record."""
    found = {}
    for part in (kind for kind in reversed(record.__mro__) if is_dataclass(kind)):
        body = ast.parse(textwrap.dedent(inspect.getsource(part))).body[0].body
        found |= {
            before.target.id: after.value.value
            for before, after in zip(body, body[1:], strict=False)
            if isinstance(before, ast.AnnAssign)
            and isinstance(after, ast.Expr)
            and isinstance(after.value, ast.Constant)
        }
    return found


def options(record: type) -> list[Option]:
    """The options of a record, in order. A record inside it that is named like a command belongs to that one, to
    which one line points; any other is a group.
    """
    found = []
    for field in fields(record):
        kind = get_type_hints(record, include_extras=True)[field.name]
        notes = get_args(kind)[1:] if get_origin(kind) is Annotated else ()
        bare = get_args(kind)[0] if notes else kind
        if "Suppress" in repr(notes):
            continue
        name = next(
            (note.name for note in notes if getattr(note, "name", None) is not None), field.name
        ).replace("_", "-")
        if is_dataclass(bare):
            if name in STAGES | COMMANDS:
                found.append(Option(f"--{name}.OPTION", "", "", f"The options of `sc3d {name}`."))
            elif name:
                group = " ".join((bare.__doc__ or "").split())
                found += [replace(option, group=group) for option in options(bare)]
            else:
                found += options(bare)
            continue
        about = next((note.help for note in notes if getattr(note, "help", None)), None) or helps(record).get(
            field.name, ""
        )
        positional = "Positional" in repr(kind)
        default = None if field.default is MISSING else field.default
        flag = name.upper() if positional else f"--{name}, --no-{name}" if bare is bool else f"--{name}"
        found.append(
            Option(
                flag,
                "" if bare is bool else _values(bare),
                "" if positional else _shown(default),
                " ".join(about.split()),
            )
        )
    return found


def page(name: str, command: Command) -> str:
    """Markdown page of a command."""
    parts = [NOTE, f"# sc3d {name}", command.about]
    for subcommand, record in command.records.items():
        usage = " ".join(
            [
                "sc3d",
                name,
                *([subcommand] if subcommand else []),
                *(["SCENE"] if command.scene else []),
                *(option.flag for option in options(record) if not option.flag.startswith("-")),
                "[options]",
            ]
        )
        heading = [f"## {subcommand}", " ".join((record.__doc__ or "").split())] if subcommand else []
        parts += [*heading, f"```\n{usage}\n```", *_tables(options(record), command.scene)]
    return "\n\n".join(parts) + "\n"


def write_pages(folder: Path, commands: dict[str, Command]) -> list[Path]:
    """`<command>.md` for every command, and `README.md`, the list of them."""
    written = []
    for name, command in commands.items():
        written.append(folder / f"{name}.md")
        write_text(written[-1], page(name, command))
    lines = [f"| [{name}]({name}.md) | {command.about} |" for name, command in commands.items()]
    write_text(
        folder / "README.md",
        "\n".join([NOTE, "", "# Commands", "", "| command | |", "|---|---|", *lines]) + "\n",
    )
    return [*written, folder / "README.md"]


def write_geometry_pages(folder: Path) -> list[Path]:
    """`<module>.md` for every module of sc3d.geometry with something public in it, and `README.md`, the list of
    them.
    """
    written, rows = [], []
    for file in sorted(GEOMETRY.glob("*.py")):
        tree = ast.parse(file.read_text(encoding="utf-8"))
        if file.stem == "__init__" or "kernels" in file.stem or not public(tree.body):
            continue
        written.append(folder / f"{file.stem}.md")
        write_text(written[-1], module_page(file, f"sc3d.geometry.{file.stem}", NOTE_GEOMETRY))
        names = ", ".join(f"`{node.name}`" for node in public(tree.body))
        rows.append(f"| [{file.stem}]({file.stem}.md) | {summary(tree)} | {names} |")
    head = [
        NOTE_GEOMETRY,
        "",
        "# Geometry utilities",
        "",
        GEOMETRY_ABOUT,
        "",
        "| module | | |",
        "|---|---|---|",
    ]
    write_text(folder / "README.md", "\n".join([*head, *rows]) + "\n")
    return [*written, folder / "README.md"]


def _tables(found: list[Option], scene: bool) -> list[str]:
    """The everyday options, then every group under its sentence."""
    overwrite = Option("--overwrite", "", "False", "Run again even if the outputs are up to date.")
    messages = [replace(option, flag=option.flag.split(",")[0]) for option in options(Messages)]
    everyday = [option for option in found if not option.group] + ([overwrite] if scene else []) + messages
    parts = [_table(everyday)]
    for group in dict.fromkeys(option.group for option in found if option.group):
        parts += [group, _table([option for option in found if option.group == group])]
    return parts


def _table(found: list[Option]) -> str:
    cells = [
        "| "
        + " | ".join(map(_escaped, (f"`{option.flag}`", option.values, option.default, option.help)))
        + " |"
        for option in found
    ]
    return "\n".join(["| option | values | default | |", "|---|---|---|---|", *cells])


def _escaped(text: str) -> str:
    return text.replace("|", "\\|")


def _values(kind: Any) -> str:
    origin, arguments = get_origin(kind), get_args(kind)
    if origin is Annotated:
        return _values(arguments[0])
    if origin is Literal:
        return ", ".join(map(str, arguments))
    if origin in (Union, UnionType):
        return _values(next(argument for argument in arguments if argument is not NoneType))
    if origin is tuple:
        return (
            f"{_values(arguments[0])} ..."
            if arguments[-1] is Ellipsis
            else " ".join(_values(argument) for argument in arguments)
        )
    return {int: "whole number", float: "number", str: "text", Path: "path"}.get(
        kind, getattr(kind, "__name__", str(kind))
    )


def _shown(value: object) -> str:
    if value is None or value == ():
        return "none"
    return " ".join(map(str, value)) if isinstance(value, tuple) else str(value)


def remove_stale_pages(folder: Path, written: list[Path], note: str) -> None:
    """Remove pages that an earlier version wrote, told by their first line."""
    for file in set(folder.glob("*.md")) - set(written):
        if file.read_text(encoding="utf-8").startswith(note):
            file.unlink()


def main(arguments: list[str] | None = None) -> None:
    """Write all pages."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, nargs="?", default=ROOT / "data" / "manual")
    folder = parser.parse_args(arguments).folder
    commands = {
        name: _command(record, name in STAGES) for name, record in sorted((STAGES | COMMANDS).items())
    }
    written = write_pages(folder / "commands", commands) + write_geometry_pages(folder / "geometry")
    remove_stale_pages(folder / "commands", written, NOTE)
    remove_stale_pages(folder / "geometry", written, NOTE_GEOMETRY)
    sys.stdout.write(f"wrote {len(written)} pages to {folder}\n")


def _command(record: type, scene: bool) -> Command:
    return Command(" ".join((record.__doc__ or "").split()), {"": record}, scene)


if __name__ == "__main__":
    main()
