"""Packages of the extra `geo`, which are large and needed for maps only."""

from __future__ import annotations

import importlib
from types import ModuleType

from sc3d.errors import MissingPackageError


def load(name: str) -> ModuleType:
    """Import a module of the extra; MissingPackageError says how to install it."""
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError:
        raise MissingPackageError(
            f"this format needs {name.split('.')[0]}: pip install 'sc3d[geo]'"
        ) from None
