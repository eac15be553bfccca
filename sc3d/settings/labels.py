"""Options of what makes and judges labels: annotate, segment, label, propagate, evaluate."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from sc3d.errors import InputError
from sc3d.settings.common import Resources


@dataclass(frozen=True)
class Segment:
    """2D masks for all photos."""

    backend: Literal["files", "geometry", "strokes", "grounded-sam", "sam3"] = "files"
    """Where masks come from: files (--masks), the scene's own surface (geometry: ground, low and high
    vegetation, building by height above the ground, shape and color; no model, nothing to draw), a few
    strokes that you drew (--strokes, no model), or text prompts with Grounding DINO and SAM 2 or with SAM 3.
    """
    masks: Path | None = None
    """Masks made elsewhere: a folder of PNGs named like the photos, a folder of LabelMe JSONs, a COCO JSON,
    or a CVAT XML (files).
    """
    name_pattern: str | None = None
    """How --masks are named where that is not clear: {photo} stands for the name of the photo and * for
    anything, such as '{photo}_gtFine_labelIds.png' or '*-{photo}'; files that do not fit are left out
    (files).
    """
    format: Literal["auto", "index", "color", "labelme", "coco", "cvat"] = "auto"
    """Format of --masks (files): index = PNG with one id per pixel, color = PNG in the colors of the class
    table; auto looks at the files.
    """
    mapping: Path | None = None
    """JSON object of the ids, names or colors in --masks and the classes that they stand for, such as
    {"wall": "building", "7": "road"} (files).
    """
    confidence: Path | None = None
    """Folder of confidence maps, PNGs named like the photos (files); optional."""
    strokes: Path | None = None
    """Folder of strokes and polygons per class, LabelMe JSON or PNG in the colors of the class table;
    SCENE/strokes otherwise (strokes).
    """
    model: Path | None = None
    """What another site's strokes taught, a file of `sc3d propagate --save-model`: no strokes are needed here
    (strokes).
    """
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
    """Photos larger than this are also looked at in overlapping tiles of this size, px, so that small things
    are found; 0 = never (grounded-sam, sam3).
    """
    overlap: float = 0.2
    """Share of a tile that it has in common with the next."""
    refine: bool = False
    """One more round on the masks that are in the scene (needs its cloud): what contradicts the fused labels
    loses confidence, if that brings the labels nearer to the masks of photos that were left out. Writes
    SCENE/confidence_refined, which label then takes instead of SCENE/confidence.
    """
    half: bool = False
    """Compute in half precision (bfloat16; float16 on older GPUs); needs CUDA (grounded-sam, sam3)."""
    device: str = "auto"
    """torch device: auto, cpu, cuda."""

    def __post_init__(self) -> None:
        if self.model is not None and (self.backend != "strokes" or self.strokes is not None):
            raise InputError(
                "--model takes the place of strokes: it needs --backend strokes without --strokes"
            )


@dataclass(frozen=True)
class PaperMechanisms:
    """Mechanisms of the paper, one by one. `--method paper` switches all on; elsewhere they change next to
    nothing.
    """

    depth_excess: bool = True
    """Weigh votes less, the farther a point lies behind the first surface (within the tolerance)."""
    incidence: bool = False
    """Weigh votes by the cosine of the incidence angle."""
    range: bool = True
    """Weigh votes by the inverse distance, so that near photos count more."""
    density: bool = False
    """Inside a voxel, weigh points by the density of the Gaussians around them (gaussians.ply), or by their
    distance to the points' mean without it.
    """
    reproject: bool = False
    """Vote once more on locked voxels with half the depth tolerance and without mask edges and grazing views.
    """


@dataclass(frozen=True)
class Label(Resources):
    """Fuse masks into the voxel label field and the cloud."""

    method: Literal["direct", "majority", "conflict-lock", "paper"] = "conflict-lock"
    """direct: last photo wins; majority: most votes win; conflict-lock: disagreeing voxels are reset and
    locked; paper:
    the same with any disagreement, and every mechanism and weight of the paper, whatever the other options
    say.
    """
    depth_filter: bool = True
    """Only the first surface along each ray is labelled; --no-depth-filter lets labels penetrate."""
    surface: Literal["auto", "surfels", "voxels"] = "auto"
    """What hides the points behind it. auto: mesh.ply if there is one, else as voxels; voxels: a grid of the
    cloud's own points, traversed coarse to fine; surfels: a square around every point (more memory).
    """
    consensus: float = 0.66
    """Share of the votes that the winning class needs, else the voxel is locked (conflict-lock)."""
    voxel_size: float = 0.0
    """Label voxel, world units; 0 = 2 times the median point spacing, at least 1.5 times the median mask
    pixel on the ground.
    """
    use_confidence: bool = True
    """Weigh mask pixels by the confidence maps, where there are any."""
    edge_width: float = 3.0
    """Mask pixels closer than this to a label boundary count less, px; 0 = off."""
    unlabelled: Literal["evidence", "ignore"] = "evidence"
    """What a pixel without a class says. evidence: "none of the classes", so that a surface on which most
    masks say nothing stays unlabelled (conflict-lock); ignore: nothing, so that it gets a class of its
    neighbors.
    """
    verify: Literal["no", "lock", "weigh"] = "weigh"
    """Hold the fused labels against each view's masks, place by place. lock: labels that rest on views which
    contradict them nearby are locked; weigh: such views count less as well.
    """
    cloud: Path | None = None
    """Cloud to label, also of another program, as `sc3d import` reads it; SCENE/cloud.ply otherwise."""
    prior: Path | None = None
    """Cloud that another program has classified (LAZ, LAS, PLY): its points vote for the nearest ones within a
    label voxel, by the ASPRS codes of classes.json or by a column `label` with class ids. Masks are not needed
    then.
    """
    prior_weight: float = 1.0
    """How many photos that agree a vote of --prior is worth, up to 15."""
    output: Path | None = None
    """Labelled cloud to write; SCENE/seeds.ply otherwise."""
    mechanisms: PaperMechanisms = PaperMechanisms()

    def __post_init__(self) -> None:
        if not 0 < self.prior_weight <= 15:
            raise InputError("prior_weight must be above 0 and at most 15")
        if self.prior is not None and self.method == "direct":
            raise InputError(
                "--prior has no place among photos of which the last one wins: choose another --method"
            )

    @property
    def resolved(self) -> Label:
        """What counts: the paper's own choices where `method` is paper."""
        if self.method != "paper":
            return self if self.method == "conflict-lock" else replace(self, unlabelled="ignore")
        every = PaperMechanisms(*(True for _ in fields(PaperMechanisms)))
        return replace(
            self, consensus=1.0, edge_width=3.0, verify="lock", unlabelled="ignore", mechanisms=every
        )


@dataclass(frozen=True)
class Propagate(Resources):
    """Complete the labels along the geometry, and tell buildings, trees and other countable objects apart."""

    method: Literal["knn", "geometry", "map"] = "map"
    """knn: nearest labelled points vote; geometry: front along similar normals and curvature (the paper's);
    map: Potts energy over all points.
    """
    num_neighbors: int = 16
    """Neighbors per point in the graph."""
    fill: bool = False
    """Label also the points that no edge connects to a seed, from the nearest labelled point."""
    smoothness: float = 3.0
    """Weight of the pairwise term (map)."""
    color: bool = True
    """Edges between unlike colors weigh less (geometry, map); not in the paper."""
    appearance: bool = True
    """Learn color and relief of the classes from agreed points, and let them vote too: the only cure for
    errors that all views share (map).
    """
    rounds: int = 2
    """Times that is learned: first from agreed points, then from the result (map)."""
    verify_seeds: bool = True
    """Drop seeds that look like another class before the labels spread (knn, geometry); not in the paper."""
    seeds: Path | None = None
    """Cloud written by label; SCENE/seeds.ply otherwise."""
    model: Path | None = None
    """Start from what another site taught, a file of --save-model (map): where masks voted it weighs as much
    as they do at most; without seeds.ply, the cloud of the scene is labelled by it alone.
    """
    save_model: Path | None = None
    """Keep what color and relief the classes have here, and what was learned from SCENE/strokes if there are
    any, in this file, for --model on other sites (map).
    """
    output: Path | None = None
    """Labelled cloud to write; SCENE/labelled.ply otherwise."""

    def __post_init__(self) -> None:
        if (self.model or self.save_model) and (self.method != "map" or not self.appearance):
            raise InputError(
                "--model and --save-model are of color and relief: they need --method map with appearance"
            )


@dataclass(frozen=True)
class Evaluate(Resources):
    """OA, mIoU, IoU, precision and recall per class against truth masks, through the first surface; panoptic
    quality where truth.ply tells objects apart.
    """

    truth: Path | None = None
    """Folder of truth masks; SCENE/truth otherwise. Their values are ids of classes, 254 = other: looked at,
    and none of the classes, 255 = not judged.
    """
    truth_zero: Literal["ignore", "other"] = "ignore"
    """What 0 in truth masks stands for: ignore = not judged; other = somebody looked, and found none of the
    classes.
    """
    margin: float = 10.0
    """With --truth-zero other: 0 nearer to a class than this is not judged, as outlines are not sure, px."""
    labelled: Path | None = None
    """Labelled cloud; SCENE/labelled.ply otherwise."""
    band: float = 10.0
    """Half width of the band around depth edges that is also reported apart, px."""
    output: Path | None = None
    """Metrics file; SCENE/metrics.json otherwise."""

    def __post_init__(self) -> None:
        if not self.margin >= 0:
            raise InputError("margin must not be negative")

    @property
    def zero_margin(self) -> float | None:
        """Distance from classes at which 0 in truth masks is other, px; None = it is not judged."""
        return self.margin if self.truth_zero == "other" else None


@dataclass(frozen=True)
class Annotate:
    """Draw strokes and polygons per class on photos, on a page in the browser that only this machine can
    open, and try them out; or (`--suggest`) answer what the places are of which the labels are least sure.
    """

    scene: Annotated[Positional[Path], arg(help="Scene folder with images/ and classes.json.")]
    port: int = 8000
    """Port to serve on; the next free one if it is taken."""
    photo: str | None = None
    """Name of the photo to show first."""
    suggest: bool = False
    """Ask about places of the labelled cloud, those first where an answer changes most, each outlined in the
    photo that sees it best; answers are corrections (corrections.json), which propagate takes.
    """

    def __post_init__(self) -> None:
        if self.suggest and self.photo is not None:
            raise InputError("--suggest chooses the photos itself: leave --photo out")
