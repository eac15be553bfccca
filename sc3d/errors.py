"""The errors a user can meet: one line each, saying what to do next."""

from collections.abc import Sequence


class Sc3dError(Exception):
    """Something went wrong that is not the input's fault; the command exits with status 1."""


class InputError(Sc3dError):
    """The input cannot be used as it is; the command exits with status 2 before anything is written."""


class MissingPackageError(Sc3dError):
    """An optional package is not installed; the message holds the pip line that installs it."""


def left_out(names: Sequence[object], total: int, what: str) -> str:
    """One line about what is left out: how many of how many, why, and the first few."""
    return f"{len(names)} of {total} {what}: {examples(names)}"


def examples(names: Sequence[object], most: int = 3) -> str:
    """The first few of some names, and how many more there are, for a line about what is left out."""
    rest = f" and {len(names) - most} more" if len(names) > most else ""
    first = [name if (name := str(each)).isprintable() else repr(name) for each in names[:most]]
    return ", ".join(first) + rest
