"""Every option of every stage, once: the field is the option, its docstring the help. Imports nothing heavy.

`sc3d STAGE --help`, the sidecar files and the functions all read these records.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, Suppress, arg, subcommand

from sc3d.errors import InputError
from sc3d.settings.train import TrainSettings
from sc3d.settings.synthesize import SynthesizeSettings as Synthesize


@dataclass(frozen=True)
class Workers:
    """Where a stage may work; results do not depend on it."""

    workers: int = 0
    """Dask workers to start on this machine; without them all work is done in this process."""
    cluster: str = ""
    """Address of a Dask scheduler, such as tcp://10.0.0.1:8786, whose workers see the same files."""


@dataclass(frozen=True)
class Resources(Workers):
    """What a stage may use; results do not depend on it."""

    max_memory: str = ""
    """Memory to stay below, such as 6G; what does not fit is worked on tile by tile, from disk. Half of this machine's memory otherwise. Each worker of
    a --cluster may use as much."""


@dataclass(frozen=True)
class Reconstruct:
    """Photos to cameras and sparse points (pycolmap)."""

    matching: Literal["exhaustive", "sequential", "spatial"] = "exhaustive"
    """Which photo pairs to match: all, neighbours in name order, or neighbours by GPS (hundreds of photos and more)."""
    camera_model: str = "SIMPLE_RADIAL"
    """COLMAP camera model, shared by all photos of one size and EXIF camera."""
    focal: Literal["auto", "refine", "exif"] = "auto"
    """Estimate the focal length, or keep that of EXIF. auto: estimate, unless all photos look the same way from one height (straight down), where
    focal length and flight height cannot be told apart."""
    max_size: int = 1600
    """Longest photo side for feature extraction, px."""
    max_features: int = 8192
    """SIFT features per photo."""
    gps: bool = True
    """Use GPS positions (EXIF; RTK accuracies in DJI's XMP) for scale, orientation and position."""
    gcp: Path | None = None
    """Ground control points in ODM's gcp_list.txt format; they replace GPS as the frame."""
    epsg: int | None = None
    """Projected CRS of exports; the UTM zone (or the CRS of --gcp) otherwise. `sc3d georeference` changes it afterwards."""
    altitude_offset: float = 0.0
    """Added to all heights in exports, m: drones differ in what they measure altitude from."""
    seed: int = 0
    """Seed of RANSAC."""


@dataclass(frozen=True)
class Georeference:
    """Say where a scene lies on Earth (georeference.json), from the GPS of its photos or by hand; or choose another CRS for exports."""

    epsg: int | None = None
    """Projected CRS of exports; the present one, or else the UTM zone, otherwise."""
    altitude_offset: float = 0.0
    """Added to all heights in exports, m."""
    offset: tuple[float, float, float] | None = None
    """For scenes whose world is the CRS of --epsg minus this (easting, northing, height); 0 0 0 if it is the CRS itself."""
    from_gps: bool = False
    """Replace the present georeference by one from GPS."""


@dataclass(frozen=True)
class Train(Workers, TrainSettings):
    """Gaussian training. Times are fractions of the run, so that a short run goes through all phases of a long one."""

    blocks: int = 0
    """cut the ground into so many blocks, which are trained one by one, or side by side on --workers or --cluster, in the memory of a block, and
    merged; each takes its share of iterations and max_gaussians; 0 = train everything at once"""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.blocks < 0 or self.workers < 0:
            raise InputError("blocks and workers must not be negative")

    @property
    def training(self) -> TrainSettings:
        """What decides the result of one training."""
        return TrainSettings(**{field.name: getattr(self, field.name) for field in fields(TrainSettings)})


@dataclass(frozen=True)
class Extract:
    """Gaussians to mesh and cloud."""

    method: Annotated[Literal["tsdf", "centres"], arg(name="from")] = "tsdf"
    """Fuse rendered depth into a truncated signed distance field, or take the Gaussians' centres as the cloud."""
    max_size: int = 800
    """Longest side of the depth maps, px."""
    voxel_size: float = 0.0
    """TSDF voxel, world units; 0 = 1.5 times the median ground sampling distance, at least box / 2048."""
    min_views: int = 1
    """Neighbour views that must confirm a depth (within 1 px)."""
    coverage: float | None = None
    """Holes of the confirmed surface are filled with the depth of single views, the surer first, until this share of all pixels hits a surface: labels
    need one. 0 = leave holes; None = 1 where all photos look the same way (straight down), 0.97 otherwise, as oblique photos see the floaters that it costs."""
    min_opacity: float = 0.3
    """Smallest opacity of a Gaussian whose centre becomes a point (centres)."""


@dataclass(frozen=True)
class Segment:
    """2D masks for all photos."""

    backend: Literal["files", "strokes", "grounded-sam", "sam3"] = "files"
    """Where masks come from: files (--masks), a few strokes that you drew (--strokes, no model), or text prompts with Grounding DINO and SAM 2 or with SAM 3."""
    masks: Path | None = None
    """Masks made elsewhere: a folder of PNGs <photo stem>.png, a folder of LabelMe JSONs, a COCO JSON, or a CVAT XML (files)."""
    format: Literal["auto", "index", "color", "labelme", "coco", "cvat"] = "auto"
    """Format of --masks (files): index = PNG with one id per pixel, color = PNG in the colours of the class table; auto looks at the files."""
    mapping: Path | None = None
    """JSON object of the ids, names or colours in --masks and the classes that they stand for, such as {"wall": "building", "7": "road"} (files)."""
    confidence: Path | None = None
    """Folder of confidence maps <photo stem>.png (files); optional."""
    strokes: Path | None = None
    """Folder of strokes and polygons per class, LabelMe JSON or PNG in the colours of the class table; SCENE/strokes otherwise (strokes)."""
    prompts: tuple[str, ...] = ()
    """Texts per class, each as NAME=text,text (grounded-sam, sam3); they replace those of classes.json."""
    model_dir: Path | None = None
    """Folder with downloaded model weights; the hub's cache otherwise."""
    download: bool = False
    """Download weights that are not on this machine."""
    detector: str = "IDEA-Research/grounding-dino-tiny"
    """Grounding DINO model that finds boxes (grounded-sam)."""
    segmenter: str = "facebook/sam2.1-hiera-small"
    """SAM 2 or SAM 1 model that outlines them (grounded-sam)."""
    concept_model: str = "facebook/sam3"
    """SAM 3 model (sam3)."""
    box_threshold: float = 0.3
    """Smallest score of a detected box or concept."""
    text_threshold: float = 0.25
    """Smallest score of a phrase (grounded-sam)."""
    tile: int = 1600
    """Photos larger than this are also looked at in overlapping tiles of this size, px, so that small things are found; 0 = never (grounded-sam, sam3)."""
    overlap: float = 0.2
    """Share of a tile that it has in common with the next."""
    refine: bool = False
    """One more round on the masks that are in the scene (needs its cloud): what contradicts the fused labels loses confidence, if that brings the
    labels nearer to the masks of photos that were left out. Writes SCENE/confidence_refined, which label then takes instead of SCENE/confidence."""
    half: bool = False
    """Compute in half precision (bfloat16; float16 on older GPUs); needs CUDA (grounded-sam, sam3)."""
    device: str = "auto"
    """torch device: auto, cpu, cuda."""


@dataclass(frozen=True)
class Label(Resources):
    """Fuse masks into the voxel label field and the cloud."""

    method: Literal["direct", "majority", "conflict-lock", "paper"] = "conflict-lock"
    """direct: last photo wins; majority: most votes win; conflict-lock: disagreeing voxels are reset and locked; paper: the same with any
    disagreement and the paper's weights, whatever the other options say."""
    depth_filter: bool = True
    """Only the first surface along each ray is labelled; --no-depth-filter lets labels penetrate."""
    surface: Literal["auto", "surfels", "voxels"] = "auto"
    """What hides the points behind it. auto: mesh.ply if there is one, else as voxels; voxels: the grid of the cloud's own points, traversed coarse to fine;
    surfels: a square around every point (more memory), which clouds in tiles have instead of voxels."""
    consensus: float = 0.66
    """Share of the votes that the winning class needs, else the voxel is locked (conflict-lock)."""
    voxel_size: float = 0.0
    """Label voxel, world units; 0 = 2 times the median point spacing, at least 1.5 times the median mask pixel on the ground."""
    use_confidence: bool = True
    """Weigh mask pixels by the confidence maps, where there are any."""
    edge_width: float = 3.0
    """Mask pixels closer than this to a label boundary count less, px; 0 = off."""
    depth_excess: bool = True
    """Weigh votes less, the farther a point lies behind the first surface (within the tolerance)."""
    incidence: bool = False
    """Weigh votes by the cosine of the incidence angle."""
    range: bool = True
    """Weigh votes by the inverse distance, so that near photos count more."""
    verify: Literal["no", "lock", "weigh"] = "weigh"
    """Hold the fused labels against each view's masks, place by place. lock: labels that rest on views which contradict them nearby are locked;
    weigh: such views count less as well."""
    density: bool = False
    """Inside a voxel, weigh points by the density of the Gaussians around them (gaussians.ply), or by their distance to the points' mean without it."""
    reproject: bool = False
    """Vote once more on locked voxels with half the depth tolerance and without mask edges and grazing views."""
    cloud: Path | None = None
    """Cloud to label; SCENE/cloud.ply otherwise."""
    output: Path | None = None
    """Labelled cloud to write; SCENE/seeds.ply otherwise."""


@dataclass(frozen=True)
class Propagate(Resources):
    """Complete the labels along the geometry."""

    method: Literal["knn", "geometry", "map"] = "map"
    """knn: nearest labelled points vote; geometry: front along similar normals and curvature (the paper's); map: Potts energy over all points."""
    num_neighbors: int = 16
    """Neighbours per point in the graph."""
    fill: bool = False
    """Label also the points that no edge connects to a seed, from the nearest labelled point."""
    smoothness: float = 3.0
    """Weight of the pairwise term (map)."""
    color: bool = True
    """Edges between unlike colours weigh less (geometry, map); not in the paper."""
    appearance: bool = True
    """Learn colour and relief of the classes from agreed points, and let them vote too: the only cure for errors that all views share (map)."""
    rounds: int = 2
    """Times that is learned: first from agreed points, then from the result (map)."""
    verify_seeds: bool = True
    """Drop seeds that look like another class before the labels spread (knn, geometry); not in the paper."""
    seeds: Path | None = None
    """Cloud written by label; SCENE/seeds.ply otherwise."""
    output: Path | None = None
    """Labelled cloud to write; SCENE/labelled.ply otherwise."""


@dataclass(frozen=True)
class Evaluate(Resources):
    """OA, mIoU and IoU per class against truth masks, through the first surface."""

    truth: Path | None = None
    """Folder of truth masks; SCENE/truth otherwise."""
    labelled: Path | None = None
    """Labelled cloud; SCENE/labelled.ply otherwise."""
    band: float = 10.0
    """Half width of the band around depth edges that is also reported apart, px."""
    output: Path | None = None
    """Metrics file; SCENE/metrics.json otherwise."""


@dataclass(frozen=True)
class Export:
    """Results for other programs, in SCENE/export."""

    format: tuple[Literal["masks", "laz", "clouds", "splats", "spz", "orthophoto", "objects", "transforms", "colmap-text"], ...] = ("laz",)
    """What to write. masks: the fused labels as each photo sees them; laz: LAZ 1.4 with ASPRS classes; clouds: one PLY per class; splats, spz: Gaussians
    with labels; orthophoto: GeoTIFFs of colour, class and height; objects: footprints of buildings and crowns of trees as GeoJSON;
    transforms: cameras and sparse points as nerfstudio's transforms.json; colmap-text: the same as COLMAP's text files."""
    classes: tuple[str, ...] = ()
    """Names of the classes to write; all otherwise (laz, clouds, splats, spz)."""
    labelled: Path | None = None
    """Labelled cloud; SCENE/labelled.ply otherwise."""
    max_size: int = 0
    """Longest side of the masks, px; 0 = as the photo (masks)."""
    epsg: int = 0
    """EPSG code of a projected CRS for the coordinates (laz, clouds, orthophoto, objects); 0 = that of the scene. Without a georeference it says which
    CRS the scene's coordinates are in."""
    pixel_size: float = 0.0
    """Side of a pixel on the ground, m; 0 = the spacing of the points, twice that without a mesh, rounded to one digit (orthophoto)."""
    min_height: float = 2.0
    """Lower buildings and plants are left out, m (objects)."""
    min_area: float = 10.0
    """Smaller buildings are left out, m2 (objects)."""
    rectangular: bool = True
    """Draw buildings with right angles where that fits; --no-rectangular keeps the simplified outline (objects)."""


@dataclass(frozen=True)
class Report:
    """One self-contained HTML page with figures and pictures."""

    output: Path | None = None
    """Page to write; SCENE/report.html otherwise."""


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
    """Start from another program's project, cloud or mesh: nerfstudio, OpenSfM, ODM, Metashape, Pix4D, COLMAP; PLY, LAS, LAZ, PCD, XYZ, OBJ."""

    source: Annotated[Literal["auto", "nerfstudio", "opensfm", "odm", "metashape", "pix4d", "colmap", "cloud"], arg(name="from")] = "auto"
    """What PROJECT is; auto looks at it."""
    images: Path | None = None
    """Folder of the photos; where the project says otherwise. Needed for Metashape and Pix4D, which do not say."""
    cloud: tuple[Path, ...] = ()
    """Cloud (PLY, LAS, LAZ, PCD, XYZ) or mesh (PLY, OBJ) that belongs to it, or one of each; becomes cloud.ply and mesh.ply."""
    epsg: int | None = None
    """CRS of coordinates whose file does not state one."""
    tolerance: float = 0.01
    """Largest error, px, from lens parameters that no COLMAP model has; a project that needs more is refused."""
    project: Annotated[Path, Suppress] = Path()
    """Set by the command."""


@dataclass(frozen=True)
class ImportCommand:
    """Start from another program's project, cloud or mesh: nerfstudio, OpenSfM, ODM, Metashape, Pix4D, COLMAP; PLY, LAS, LAZ, PCD, XYZ, OBJ."""

    project: Annotated[Positional[Path], arg(help="Project folder or file, or a cloud or mesh alone; never modified.")]
    scene: Annotated[Positional[Path], arg(help="Scene folder to write.")]
    settings: Annotated[Import, arg(name="")] = Import()
    overwrite: bool = False
    """Run again even if the outputs are up to date."""


@dataclass(frozen=True)
class View:
    """Look at a scene: Open3D window, page in the browser, or a picture without a display."""

    scene: Annotated[Positional[Path], arg(help="Scene folder.")]
    by: Literal["photo", "label", "confidence", "state", "disagreement"] = "label"
    """What the colours show; disagreement: share of the votes that the winning class did not get."""
    classes: tuple[str, ...] = ()
    """Names of the classes to show; all otherwise."""
    file: Path | None = None
    """Cloud or mesh to show; the labelled cloud, or else cloud.ply, otherwise."""
    photo: str | None = None
    """Look through the camera of this photo."""
    splats: bool = False
    """Show the Gaussians instead of the cloud (with --web, --html, --screenshot); with --photo and --screenshot, beside the photo."""
    from_above: bool = False
    """Straight down instead of oblique (with --web, --html, --screenshot)."""
    cameras: bool = True
    """Draw the cameras."""
    web: bool = False
    """Serve a page for the browser instead of opening a window, until Ctrl + C; needs `pip install 'sc3d[web]'`."""
    host: str = "127.0.0.1"
    """Address to serve on; 0.0.0.0 = to everybody who can reach this machine, without a password (with --web)."""
    port: int = 8080
    """Port to serve on; the next free one if it is taken (with --web)."""
    html: Path | None = None
    """Write a page that opens from disk without a server."""
    points: int = 0
    """Points shown at the start, of which the page can show more (with --web), or at most (with --html); 0 = 1000000, and 300000 in a file."""
    screenshot: Path | None = None
    """Write a picture (PNG, JPEG) instead of opening a window."""
    flight: Path | None = None
    """Write a video (MP4) of the Gaussians along the flight instead of opening a window."""
    size: tuple[int, int] = (1600, 1000)
    """Width and height of the picture, px."""


@dataclass(frozen=True)
class Annotate:
    """Draw strokes and polygons per class on photos, on a page in the browser that only this machine can open, and try them out."""

    scene: Annotated[Positional[Path], arg(help="Scene folder with images/ and classes.json.")]
    port: int = 8000
    """Port to serve on; the next free one if it is taken."""
    photo: str | None = None
    """Name of the photo to show first."""


@dataclass(frozen=True)
class Doctor:
    """Report versions, missing system libraries, Vulkan, CUDA and models found."""

    model_dir: Path | None = None
    """Folder with downloaded model weights."""


@dataclass(frozen=True)
class Manual:
    """Write the manual's pages of commands, with all their options, as Markdown."""

    folder: Annotated[Positional[Path], arg(help="Folder to write.")]


@dataclass(frozen=True)
class BenchmarkSpeed:
    """Time training stage by stage: CPU and wall time, fragments per pixel, fraction of the arithmetic limit, memory; OpenSplat beside it."""

    scene: Path | None = None
    """COLMAP scene folder whose sparse points say where the ground is; a synthetic ground otherwise."""
    gaussians: tuple[int, ...] = (50_000, 200_000)
    """Numbers of Gaussians; each is combined with each size."""
    sizes: tuple[int, ...] = (496, 993)
    """Longest sides of the view, px."""
    repeats: int = 7
    """Times every measurement is repeated; medians are reported."""
    surface: bool = True
    """Also time whole training steps with and without the surface terms."""
    opensplat: Path | None = None
    """OpenSplat's program, to run on the same Gaussians and photos in turn with sc3d."""
    output: Path | None = None
    """JSON file for the figures; a Markdown table is written beside it."""


@dataclass(frozen=True)
class BenchmarkTables:
    """The paper's tables and an ablation: every method and switch on synthetic scenes and on scenes with truth, judged on the same pixels."""

    workdir: Annotated[Positional[Path], arg(help="Folder for the synthetic scenes and finished rows; the same command goes on where it stopped.")]
    scenes: tuple[Path, ...] = ()
    """Scene folders to add; each needs cloud.ply, masks/ and truth/."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Synthetic scenes, in WORKDIR/seed<n>."""
    noises: tuple[float, ...] = (0.5, 1.0, 1.5)
    """Strengths of the mask errors, for every seed."""
    views: int = 40
    """Photos of a synthetic scene."""
    points: int = 1_000_000
    """Points of a synthetic scene."""
    width: int = 800
    """Width of the synthetic photos, px."""
    every: int = 4
    """Judge every nth photo with truth, but not fewer than 8."""
    output: Path | None = None
    """Folder for tables.md and tables.json; WORKDIR otherwise."""


@dataclass(frozen=True)
class BenchmarkFusionSpeed:
    """Time label and propagate against bare ray casting, a numpy z-buffer voter, one nearest-neighbour pass and scikit-learn; growth and memory."""

    scene: Annotated[Positional[Path], arg(help="Scene folder with cloud.ply, mesh.ply and masks/, such as one that `benchmark tables` made.")]
    points: tuple[int, ...] = (1_000_000, 3_000_000, 10_000_000)
    """Numbers of points, drawn from cloud.ply, beyond its size copied along the surface; the rivals run at the first."""
    views: tuple[int, ...] = (20, 40, 80)
    """Numbers of views, at the first number of points; a scene with fewer repeats its views."""
    repeats: int = 3
    """Times the comparison with the rivals is repeated, in turn; medians are reported."""
    output: Path | None = None
    """JSON file for the figures; a Markdown table is written beside it."""


@dataclass(frozen=True)
class BenchmarkSurface:
    """Compare gaussians.ply and mesh.ply of a scene with the exact depth and surface of the synthetic scene that its photos come from."""

    scene: Annotated[Positional[Path], arg(help="Reconstructed scene folder, with the true cameras.")]
    truth: Annotated[Positional[Path], arg(help="Synthetic scene folder: depth/, truth/, truth.ply, truth_mesh.ply.")]
    voxel_size: float = 0.0
    """Voxel of the mesh, world units; 0 = as in mesh.ply.json."""
    output: Path | None = None
    """JSON file for the figures; a Markdown table is written beside it."""


@dataclass(frozen=True)
class BenchmarkCity:
    """Make a synthetic city to measure on: sites of the generator side by side, with cloud, mesh, cameras, masks and truth, but without photos."""

    scene: Annotated[Positional[Path], arg(help="Scene folder to write; it must not exist, or be empty.")]
    sites: tuple[int, int] = (6, 5)
    """Sites from west to east and from south to north, each of 120 m by 120 m."""
    points_per_site: int = 1_000_000
    """Points of the cloud on each site."""
    views: int = 200
    """Number of views over the whole city: 60 % look straight down, the others obliquely from the four sides."""
    width: int = 1600
    """Width of the masks, px; the height follows at 3:2."""
    seed: int = 0
    """Fixes the city, the flight and the mask errors."""


Benchmark = (
    Annotated[BenchmarkSpeed, subcommand("speed")] | Annotated[BenchmarkTables, subcommand("tables")]
    | Annotated[BenchmarkFusionSpeed, subcommand("fusion-speed")] | Annotated[BenchmarkSurface, subcommand("surface")]
    | Annotated[BenchmarkCity, subcommand("city")]
)


@dataclass(frozen=True)
class Run:
    """Photos to labelled cloud: all stages, skipping what is up to date."""

    photos: Annotated[Positional[Path], arg(help="Folder of photos; never modified.")]
    scene: Annotated[Positional[Path], arg(help="Scene folder to write.")]
    masks: Path | None = None
    """Masks made elsewhere; short for --segment.masks."""
    confidence: Path | None = None
    """Folder of confidence maps; short for --segment.confidence."""
    classes: Path | None = None
    """Class table, copied to SCENE/classes.json."""
    truth: Path | None = None
    """Folder of truth masks; evaluates at the end."""
    reconstruct: Reconstruct = Reconstruct()
    train: Train = Train()
    extract: Extract = Extract()
    segment: Segment = Segment()
    label: Label = Label()
    propagate: Propagate = Propagate()
    overwrite: bool = False
    """Run every stage again."""
