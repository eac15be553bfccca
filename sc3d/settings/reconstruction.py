"""Options of what makes cameras and surfaces: reconstruct, import, georeference, extract."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, Suppress, arg

from sc3d.errors import InputError
from sc3d.settings.common import DepthMode, Memory, Workers

Matching = Literal["auto", "exhaustive", "sequential", "spatial", "vocabulary"]
Mapper = Literal["auto", "incremental", "global"]
Fill = Literal["nothing", "continued", "occluders"]


@dataclass(frozen=True)
class Mapping:
    """Photos to cameras and sparse points, before these are brought to their place (pycolmap)."""

    matching: Matching = "exhaustive"
    """Which photo pairs to match. exhaustive: all, which takes four times as long for twice the photos; sequential:
    neighbors in name order, for videos; spatial: the 50 nearest by GPS; vocabulary: the 30 most alike and 10
    neighbors in name order, without GPS (visual words are made of the photos, nothing is fetched); auto:
    exhaustive up to 100 photos, beyond that spatial if every photo has GPS, else vocabulary.
    """
    camera_model: str = "SIMPLE_RADIAL"
    """COLMAP camera model, shared by all photos of one size and EXIF camera."""
    max_size: int = 1600
    """Longest photo side for feature extraction, px."""
    max_features: int = 8192
    """SIFT features per photo."""
    mapper: Mapper = "incremental"
    """How cameras are found. incremental: photo after photo; global: all at once (GLOMAP), a fraction of the time with
    hundreds of photos; auto: incremental up to 100 photos, beyond that global.
    """
    gps: bool = True
    """Use GPS positions (EXIF, or XMP where it says more; RTK accuracies) for scale, orientation and
    position.
    """
    seed: int = 0
    """Seed of RANSAC."""


@dataclass(frozen=True)
class Reconstruct(Mapping):
    """Photos to cameras and sparse points (pycolmap)."""

    matching: Matching = "auto"
    mapper: Mapper = "auto"
    focal: Literal["auto", "refine", "exif"] = "auto"
    """Estimate the focal length, or keep that of EXIF. auto: estimate, unless all photos look the same way
    from one height (straight down), where focal length and flight height cannot be told apart.
    """
    gcp: Path | None = None
    """Ground control points in ODM's gcp_list.txt format; they replace GPS as the frame."""
    gcp_accuracy: tuple[float, float] | None = None
    """Standard deviations of the ground control points, m: horizontal, vertical. None = estimated from how
    they fit.
    """
    epsg: int | None = None
    """Projected CRS of exports; the UTM zone (or the CRS of --gcp) otherwise. `sc3d georeference` changes it
    afterwards.
    """
    altitude_offset: float = 0.0
    """Added to all heights in exports, m: drones differ in what they measure altitude from."""


@dataclass(frozen=True)
class GeoreferenceOptions:
    """Say where a scene lies on Earth (georeference.json), from the GPS of its photos or by hand; or choose
    another CRS for exports.
    """

    epsg: int | None = None
    """Projected CRS of exports; the present one, or else the UTM zone, otherwise."""
    altitude_offset: float = 0.0
    """Added to all heights in exports, m."""
    offset: tuple[float, float, float] | None = None
    """For scenes whose world is the CRS of --epsg minus this (easting, northing, height); 0 0 0 if it is the
    CRS itself.
    """
    from_gps: bool = False
    """Replace the present georeference by one from GPS."""
    gcp: Path | None = None
    """Replace it by one from ground control points, in ODM's gcp_list.txt format; cameras and all that was
    made from them stay as they are.
    """
    gcp_accuracy: tuple[float, float] | None = None
    """Standard deviations of the ground control points, m: horizontal, vertical. None = estimated from how
    they fit.
    """


@dataclass(frozen=True)
class Depth(Memory, Workers):
    """Photos and cameras to a depth map per photo (PatchMatch stereo)."""

    max_size: int = 800
    """Longest side of the depth maps, px."""
    num_sources: int = 6
    """Other photos that each is compared with."""
    sky_masks: Path | None = None
    """Masks that show the sky, in any format of `sc3d segment --masks`: binary (255 or 1 is sky, 0 is not), or of
    classes, of which those without surface are sky. SCENE/masks otherwise, where there are masks and classes.json
    has such a class.
    """
    ignore_masks: bool = False
    """Do not look at SCENE/masks: find sky by its look and place alone."""

    def __post_init__(self) -> None:
        if self.max_size < 32 or self.num_sources < 1:
            raise InputError("max_size must be at least 32, num_sources at least 1")


@dataclass(frozen=True)
class Extract(Memory):
    """Gaussians or depth maps to mesh and cloud."""

    method: Annotated[Literal["tsdf", "depth", "centers"], arg(name="from")] = "tsdf"
    """Fuse depth into a truncated signed distance field: that which the Gaussians render, or that of `sc3d
    depth`, which needs no training (`sc3d run` leaves it out then). Or take the Gaussians' centers as the cloud.
    """
    depth_mode: DepthMode = "median"
    """Depth that the Gaussians render: of the alpha-blended planes, or where half of the light is gone
    (median): it does not mix surfaces that lie behind one another; any trained model will do (tsdf).
    """
    max_size: int = 800
    """Longest side of the depth maps, px."""
    voxel_size: float = 0.0
    """TSDF voxel, world units; 0 = 1.5 times the median ground sampling distance, at least box / 2048."""
    min_views: int = 1
    """Neighbor views that must confirm a depth (within 1 px)."""
    fill: Fill = "occluders"
    """What is added to the confirmed surface, which labels need: nothing; continued: what only one photo
    shows, where it continues confirmed surface; occluders: also what stands before it, or before the sky of
    others, seen by one photo (leaves before the camera), at the farthest depth that no other photo looks
    through.
    """
    crop: int = 0
    """Leave out the surface that fewer photos than this see, such as 3 against the frayed border of a flight; 0 =
    keep all.
    """
    min_opacity: float = 0.3
    """Smallest opacity of a Gaussian whose center becomes a point (centers)."""

    def __post_init__(self) -> None:
        if self.crop < 0:
            raise InputError("crop must be a number of photos, or 0 = off")
        if self.crop and self.method == "centers":
            raise InputError("--crop needs a surface that hides what lies behind it: --from tsdf or depth")


@dataclass(frozen=True)
class ReconstructCommand:
    """Photos to cameras and sparse points (pycolmap); metric and georeferenced where the photos have GPS."""

    photos: Annotated[Positional[Path], arg(help="Folder of photos; never modified.")]
    scene: Annotated[Positional[Path], arg(help="Scene folder to write.")]
    reconstruct: Annotated[Reconstruct, arg(name="")] = Reconstruct()
    overwrite: bool = False
    """Run again even if the outputs are up to date."""


@dataclass(frozen=True)
class Import:
    """Start from another program's project, cloud or mesh: nerfstudio, OpenSfM, ODM, Metashape, Pix4D,
    OPF, COLMAP; PLY, LAS, LAZ, E57, PCD, XYZ, OBJ.
    """

    source: Annotated[
        Literal["auto", "nerfstudio", "opensfm", "odm", "metashape", "pix4d", "opf", "colmap", "cloud"],
        arg(name="from"),
    ] = "auto"
    """What PROJECT is; auto looks at it."""
    images: Path | None = None
    """Folder of the photos; where the project says otherwise. Needed for Metashape and Pix4D, which do not
    say.
    """
    cloud: tuple[Path, ...] = ()
    """Cloud (PLY, LAS, LAZ, E57, PCD, XYZ) or mesh (PLY, OBJ) that belongs to it, or one of each; becomes
    cloud.ply and mesh.ply.
    """
    epsg: int | None = None
    """CRS of coordinates whose file does not state one."""
    tolerance: float = 1.0
    """Largest error, px, from lens parameters that no COLMAP model has (skew, Metashape's additional
    corrections, high radial terms); below it they are left out with a warning, a project that needs more is
    refused.
    """
    project: Annotated[Path, Suppress] = Path()
    """Set by the command."""


@dataclass(frozen=True)
class ImportCommand:
    """Start from another program's project, cloud or mesh: nerfstudio, OpenSfM, ODM, Metashape, Pix4D,
    OPF, COLMAP; PLY, LAS, LAZ, E57, PCD, XYZ, OBJ.
    """

    project: Annotated[
        Positional[Path], arg(help="Project folder or file, or a cloud or mesh alone; never modified.")
    ]
    scene: Annotated[Positional[Path], arg(help="Scene folder to write.")]
    settings: Annotated[Import, arg(name="")] = Import()
    overwrite: bool = False
    """Run again even if the outputs are up to date."""
