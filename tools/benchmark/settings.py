"""Options of the benchmarks."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg, subcommand

from sc3d.errors import InputError
from sc3d.settings.common import DepthMode
from sc3d.settings.synthesize import SynthesizeCity as SynthesizeCity


@dataclass(frozen=True)
class BenchmarkSpeed:
    """Time training stage by stage: CPU and wall time, fragments per pixel, fraction of the arithmetic limit,
    memory; OpenSplat beside it.
    """

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
class BenchmarkGpu:
    """Hold the GPU path against the CPU's: image, gradients, lifted labels, a training to the end, time and memory of
    a step. Ends with status 2 if a line does not pass.
    """

    workdir: Annotated[Positional[Path], arg(help="Folder for the table, gpu.md, and for what is trained.")]
    device: str = "cuda"
    """cuda, or cpu to try this command without a GPU."""
    gaussians: tuple[int, ...] = (200_000, 1_000_000, 5_000_000)
    """Numbers of Gaussians of which a step is timed."""
    size: int = 1600
    """Longest side of the view of a step, px."""
    steps: int = 20
    """Steps that are timed, after three that are not."""
    scenes: tuple[Path, ...] = ()
    """Scene folders with cameras and photos to train too, such as Brighton Beach."""
    views: int = 24
    """Photos of the synthetic site."""
    width: int = 800
    """Their width, px."""
    iterations: int = 0
    """Steps of a training; 0 = as `sc3d train` has it on the CPU."""
    against_cpu: bool = True
    """Train on the CPU too, which takes minutes, and compare the scores."""


@dataclass(frozen=True)
class BenchmarkTables:
    """The paper's tables and an ablation: every method and switch on synthetic scenes and on scenes with
    truth, judged on the same pixels.
    """

    workdir: Annotated[
        Positional[Path],
        arg(
            help="Folder for the synthetic scenes and finished rows; the same command goes on where it stopped."
        ),
    ]
    scenes: tuple[Path, ...] = ()
    """Scene folders to add; each needs cloud.ply, masks/ and truth/."""
    kinds: tuple[Literal["aerial", "street"], ...] = ("aerial", "street")
    """Kinds of synthetic scenes, each with every seed: WORKDIR/seed<n> and WORKDIR/street<n>."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds of the synthetic scenes."""
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
    """Time label and propagate against bare ray casting, a numpy z-buffer voter, one nearest-neighbor pass
    and scikit-learn; growth and memory.
    """

    scene: Annotated[
        Positional[Path],
        arg(
            help="Scene folder with cloud.ply, mesh.ply and masks/, such as one that `benchmark tables` made."
        ),
    ]
    points: tuple[int, ...] = (1_000_000, 3_000_000, 10_000_000)
    """Numbers of points, drawn from cloud.ply, beyond its size copied along the surface; the rivals run at
    the first.
    """
    views: tuple[int, ...] = (20, 40, 80)
    """Numbers of views, at the first number of points; a scene with fewer repeats its views."""
    repeats: int = 3
    """Times the comparison with the rivals is repeated, in turn; medians are reported."""
    output: Path | None = None
    """JSON file for the figures; a Markdown table is written beside it."""


@dataclass(frozen=True)
class BenchmarkSurface:
    """Compare gaussians.ply (without it depth/) and mesh.ply of a scene with the exact depth and surface of
    the synthetic scene, of either kind, that its photos come from.
    """

    scene: Annotated[Positional[Path], arg(help="Reconstructed scene folder, with the true cameras.")]
    truth: Annotated[
        Positional[Path], arg(help="Synthetic scene folder: truth_depth/, truth/, truth.ply, truth_mesh.ply.")
    ]
    voxel_size: float = 0.0
    """Voxel of the mesh, world units; 0 = as in mesh.ply.json."""
    depth_mode: DepthMode = "blended"
    """Depth of the Gaussians to compare, as for extract."""
    output: Path | None = None
    """JSON file for the figures; a Markdown table is written beside it."""


@dataclass(frozen=True)
class BenchmarkQuestions:
    """Measure what answers to `sc3d annotate --suggest` are worth, beside random places and the least confident ones,
    with a simulated person, on synthetic scenes whose truth.ply is also cloud.ply, after `sc3d label`.
    """

    scenes: Annotated[Positional[tuple[Path, ...]], arg(help="Synthetic scene folders.")]
    answers: tuple[int, ...] = (0, 5, 10, 20)
    """Numbers of answers, rising."""
    seed: int = 0
    """Of the random places."""
    output: Path | None = None
    """JSON file for the figures; a Markdown table is written beside it."""


@dataclass(frozen=True)
class BenchmarkFewLabels:
    """Measure what a few photos labelled by hand are worth (their truth masks are the only masks), on other
    photos, beside the given masks of all photos; of scenes with sparse/0, cloud.ply, mesh.ply and truth
    masks.
    """

    scenes: Annotated[Positional[tuple[Path, ...]], arg(help="Scene folders.")]
    truth: Path | None = None
    """Folder of truth masks; SCENE/truth otherwise."""
    labelled: int = 3
    """Photos that are labelled, spread evenly over those with truth."""
    judged: int = 7
    """Other photos that are judged."""
    folds: int = 1
    """Times that this is done, with other photos to judge each time; pixels are counted together."""
    output: Path | None = None
    """JSON file for the figures; a Markdown table is written beside it."""

    def __post_init__(self) -> None:
        if min(self.labelled, self.judged, self.folds) < 1:
            raise InputError("labelled, judged and folds must be at least 1")


Benchmark = (
    Annotated[BenchmarkSpeed, subcommand("speed")]
    | Annotated[BenchmarkGpu, subcommand("gpu")]
    | Annotated[BenchmarkTables, subcommand("tables")]
    | Annotated[BenchmarkFusionSpeed, subcommand("fusion-speed")]
    | Annotated[BenchmarkSurface, subcommand("surface")]
    | Annotated[BenchmarkQuestions, subcommand("questions")]
    | Annotated[BenchmarkFewLabels, subcommand("few-labels")]
    | Annotated[SynthesizeCity, subcommand("city")]
)
