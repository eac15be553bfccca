"""Settings of the synthetic scene; light to import, so that --help is quick."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from sc3d.errors import InputError


@dataclass(frozen=True)
class Synthesize:
    """A synthetic scene with photos, cameras, masks and truth, to try things on."""

    kind: Literal["aerial", "street"] = "aerial"
    """What is photographed: aerial = houses in gardens, as from a drone; street = rows of facades, from eye
    height and from 5 to 8 m, with sky, parked cars, grass at grazing angles and near leaves.
    """
    seed: int = 0
    """Fixes the world, the cameras and the mask errors."""
    views: int | None = None
    """Number of photos. Aerial: 40 by default, a nadir grid (60 %) and two oblique rings; street: 24, three
    of four from the pavement.
    """
    width: int = 800
    """Width of the photos, px; the height follows at 3:2."""
    mask_noise: float = 1.0
    """Strength of the mask errors: 0 = perfect masks, 1 = about 77 % of the pixels right."""
    extent: float | None = None
    """Side of the square site, m; what lies outside of it is truth 0, other objects and sky 254. Aerial: 120
    by default; street: 60.
    """
    altitude: float = 60.0
    """Height of the nadir photos above the ground, m; aerial only."""
    num_points: int = 1_000_000
    """Points in truth.ply."""
    gps_noise: float = 0.0
    """Standard deviation of the GPS position in the photos' EXIF, m per axis."""
    gps: bool = True
    """Write GPS positions into the photos' EXIF."""

    def __post_init__(self) -> None:
        if self.num_views < 1 or self.width < 32 or self.num_points < 1:
            raise InputError("views and num_points must be at least 1, width at least 32")
        if self.side < 40 or self.altitude < 20:
            raise InputError("extent must be at least 40 m and altitude at least 20 m")
        if self.kind == "street" and self.altitude != 60:
            raise InputError("altitude is that of an aerial site: leave it out for a street")
        if self.mask_noise < 0 or self.gps_noise < 0:
            raise InputError("mask_noise and gps_noise must not be negative")

    @property
    def num_views(self) -> int:
        """Number of photos."""
        return self.views if self.views is not None else {"aerial": 40, "street": 24}[self.kind]

    @property
    def side(self) -> float:
        """Side of the site, m."""
        return self.extent if self.extent is not None else {"aerial": 120.0, "street": 60.0}[self.kind]

    @property
    def height(self) -> int:
        """Height of the photos, px."""
        return round(self.width * 534 / 800)


@dataclass(frozen=True)
class SynthesizeCity:
    """Make a synthetic city to measure on: sites of the generator side by side, with cloud, mesh, cameras,
    masks and truth, but without photos.
    """

    scene: Annotated[Positional[Path], arg(help="Scene folder to write; it must not exist, or be empty.")]
    sites: tuple[int, int] = (6, 5)
    """Sites from west to east and from south to north, each of 120 m by 120 m."""
    points_per_site: int = 1_000_000
    """Points of the cloud on each site."""
    views: int = 200
    """Number of views over the whole city: 60 % look straight down, the others obliquely from the four sides.
    """
    width: int = 1600
    """Width of the masks, px; the height follows at 3:2."""
    seed: int = 0
    """Fixes the city, the flight and the mask errors."""
