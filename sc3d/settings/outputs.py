"""Options of what shows and hands on results, and of the whole run."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from sc3d.settings.common import Memory
from sc3d.settings.labels import Label, Propagate, Segment
from sc3d.settings.reconstruction import Depth, Extract, Reconstruct
from sc3d.settings.train import Train


@dataclass(frozen=True)
class Export(Memory):
    """Results for other programs, in SCENE/export."""

    format: tuple[
        Literal[
            "masks",
            "laz",
            "copc",
            "3dtiles",
            "clouds",
            "splats",
            "spz",
            "orthophoto",
            "dtm",
            "dsm",
            "ndsm",
            "contours",
            "objects",
            "object-clouds",
            "transforms",
            "colmap-text",
            "kml",
            "csv",
        ],
        ...,
    ] = ("laz",)
    """What to write. masks: the fused labels as each photo sees them; laz: LAZ 1.4 with ASPRS classes;
    copc: the same as COPC, which programs read bit by bit, over the network too; 3dtiles: the cloud for globes
    in the browser; clouds: one PLY per class; splats, spz: Gaussians with labels; orthophoto: GeoTIFFs of
    color, class and height; dtm, dsm, ndsm: GeoTIFFs of the height of the bare ground (holes interpolated, and marked in a file
    beside it), of the surface, and of the surface above the ground; contours: lines of equal height of the
    ground as GeoPackage; objects: footprints of buildings, crowns of trees and all countable objects as
    GeoJSON; object-clouds: one PLY per object; transforms: cameras and sparse points as nerfstudio's
    transforms.json; colmap-text: the same as COLMAP's text files; kml, csv: positions and viewing directions
    of the cameras.
    """
    classes: tuple[str, ...] = ()
    """Names of the classes to write; all otherwise (laz, copc, 3dtiles, clouds, splats, spz)."""
    labelled: Path | None = None
    """Labelled cloud; SCENE/labelled.ply otherwise."""
    unconfirmed: bool = False
    """Write points too that one photo only shows (`extract --fill`); in LAZ and COPC they are flagged synthetic
    (laz, copc, 3dtiles, clouds, maps, objects).
    """
    max_size: int = 0
    """Longest side of the masks, px; 0 = as the photo (masks)."""
    follow_edges: bool = True
    """Let the borders of masks follow the edges of the photos (guided filter), as surfaces are ragged there
    (masks).
    """
    epsg: int = 0
    """EPSG code of a projected CRS for the coordinates (laz, copc, clouds, maps, objects, csv); 0 = that of the
    scene. Without a georeference it says which CRS the scene's coordinates are in.
    """
    pixel_size: float = 0.0
    """Side of a pixel on the ground, m; 0 = the spacing of the points, twice that without a mesh, rounded to
    one digit (orthophoto); four times the spacing (dtm, dsm, ndsm, contours).
    """
    contour_interval: float = 0.0
    """Height between contour lines, units of the CRS; 0 = one that gives up to 25 levels (contours)."""
    ground_as_2: bool = False
    """Write all ground-like classes (ASPRS codes 2, 9, 10, 11, and 3 beside trees) as ASPRS class 2, ground,
    which terrain programs look for (laz, copc, 3dtiles).
    """
    min_height: float = 2.0
    """Lower buildings and plants are left out, m (objects); below 2 objects are told apart anew."""
    min_area: float = 10.0
    """Smaller buildings are left out, m2 (objects); below 10 objects are told apart anew."""
    rectangular: bool = True
    """Draw buildings with right angles where that fits; --no-rectangular keeps the simplified outline
    (objects).
    """


@dataclass(frozen=True)
class Check:
    """Before hours of work: blurred and badly exposed photos, wrong GPS, photos that will not register, overlap,
    weak classes, and how long each stage will take; what to do about it. Exit status 0 = ready, 1 = not.
    """

    path: Annotated[
        Positional[Path], arg(help="Folder of photos, or scene folder; only its check.json is written.")
    ]
    json: Path | None = None
    """File for scripts to write: ready, findings, figures of every photo, coverage, classes, seconds per stage.
    SCENE/check.json otherwise, which the report shows; none for a folder of photos.
    """
    reconstruct: Reconstruct = Reconstruct()
    depth: Depth = Depth()
    train: Train = Train()
    extract: Extract = Extract()


@dataclass(frozen=True)
class Compare:
    """What changed between two dates: heights and classes on a common grid, and a picture."""

    before: Annotated[Positional[Path], arg(help="Scene folder of the earlier date.")]
    after: Annotated[Positional[Path], arg(help="Scene folder of the later date.")]
    output: Path | None = None
    """Folder to write; AFTER/export/compare otherwise."""
    min_height: float = 0.5
    """Smaller differences of height are no change, m."""
    min_area: float = 5.0
    """Smaller regions are no change, m2."""
    pixel_size: float = 0.0
    """Side of a cell on the ground, m; 0 = four times the spacing of the points of the sparser cloud."""
    epsg: int = 0
    """EPSG code of a projected CRS for the results; 0 = that of the earlier scene."""


@dataclass(frozen=True)
class Report(Memory):
    """One self-contained HTML page with figures and pictures."""

    output: Path | None = None
    """Page to write; SCENE/report.html otherwise."""


@dataclass(frozen=True)
class ViewCommand:
    """Look at a scene: Open3D window, page in the browser, or a picture without a display."""

    scene: Annotated[Positional[Path], arg(help="Scene folder.")]
    by: Literal["photo", "label", "confidence", "state", "disagreement"] = "label"
    """What the colors show; disagreement: share of the votes that the winning class did not get."""
    classes: tuple[str, ...] = ()
    """Names of the classes to show; all otherwise."""
    file: Path | None = None
    """Cloud or mesh to show; the labelled cloud, or else cloud.ply, otherwise."""
    unconfirmed: bool = False
    """Show points too that one photo only shows (`extract --fill`); --file shows all that it holds."""
    photo: str | None = None
    """Look through the camera of this photo; its suffix and folders may be missing where that is clear."""
    splats: bool = False
    """Show the Gaussians instead of the cloud (with --web, --html, --screenshot); with --photo and
    --screenshot, beside the photo.
    """
    from_above: bool = False
    """Straight down instead of oblique (with --web, --html, --screenshot)."""
    cameras: bool = True
    """Draw the cameras."""
    web: bool = False
    """Serve a page for the browser instead of opening a window, until Ctrl + C; needs `pip install
    'sc3d[web]'`.
    """
    host: str = "127.0.0.1"
    """Address to serve on; 0.0.0.0 = to everybody who can reach this machine, without a password (with
    --web).
    """
    port: int = 8080
    """Port to serve on; the next free one if it is taken (with --web)."""
    html: Path | None = None
    """Write a page that opens from disk without a server."""
    points: int = 0
    """Points shown at the start, of which the page can show more (with --web), or at most (with --html); 0 =
    1000000, and 300000 in a file.
    """
    screenshot: Path | None = None
    """Write a picture (PNG, JPEG) instead of opening a window."""
    flight: Path | None = None
    """Write a video (MP4) of the Gaussians along the flight instead of opening a window."""
    size: tuple[int, int] = (1600, 1000)
    """Width and height of the picture, px."""
    memory: Annotated[Memory, arg(name="")] = Memory()


@dataclass(frozen=True)
class Doctor:
    """Report versions, missing system libraries, Vulkan, CUDA and models found."""

    model_dir: Path | None = None
    """Folder with downloaded model weights."""


@dataclass(frozen=True)
class Run:
    """Photos to labelled cloud: all stages, skipping what is up to date."""

    photos: Annotated[Positional[Path], arg(help="Folder of photos; never modified.")]
    scene: Annotated[Positional[Path], arg(help="Scene folder to write.")]
    masks: Path | None = None
    """Masks made elsewhere; short for --segment.masks. Without any, and without --segment.backend, they are made
    from the shape of the scene (geometry).
    """
    confidence: Path | None = None
    """Folder of confidence maps; short for --segment.confidence."""
    classes: Path | None = None
    """Class table, copied to SCENE/classes.json."""
    truth: Path | None = None
    """Folder of truth masks; evaluates at the end."""
    reconstruct: Reconstruct = Reconstruct()
    depth: Depth = Depth()
    train: Train = Train()
    extract: Extract = Extract()
    segment: Segment = Segment()
    label: Label = Label()
    propagate: Propagate = Propagate()
    overwrite: bool = False
    """Run every stage again."""
