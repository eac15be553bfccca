"""Where a stage may work and what it may use."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

DepthMode = Literal["blended", "median"]
"""what Gaussians along a pixel's ray say of its depth: that of their planes' alpha-blended one, or where half
of the light is gone
"""


@dataclass(frozen=True)
class Messages:
    """What is told during the work; every command has these options."""

    quiet: bool = False
    """Only warnings and errors, no bars."""
    verbose: bool = False
    """Also what helps to find a fault."""
    log: Path | None = None
    """File to which all messages are added, with the time, whatever the terminal shows."""


@dataclass(frozen=True)
class Workers:
    """Where a stage may work; results do not depend on it."""

    workers: int = 0
    """Processes to start on this machine for the work; without them all of it is done in this one."""
    cluster: str = ""
    """Address of a Dask scheduler, such as tls://10.0.0.1:8786, whose workers see the same files."""


@dataclass(frozen=True)
class Memory:
    """What a stage may use; results do not depend on it, but for pictures of clouds that do not fit."""

    max_memory: str = ""
    """Memory to stay below, such as 6G; what does not fit is worked on part by part, from disk, or refused. A
    stage that passes it all the same ends with one line. Half of this machine's memory otherwise, for plans only.
    Each worker of a --cluster may use as much.
    """


@dataclass(frozen=True)
class Resources(Memory, Workers):
    """What a stage may use; results do not depend on it."""
