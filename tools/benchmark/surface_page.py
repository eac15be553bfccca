"""`sc3d benchmark surface`: the figures of `surface` as JSON and Markdown."""

from __future__ import annotations

from dataclasses import asdict

from sc3d.errors import InputError
from sc3d.io.json_files import read_json
from sc3d.io.provenance import versions
from sc3d.runner import sidecar
from sc3d.scene.scene import Scene
from tools.benchmark.publish import check_output, publish
from tools.benchmark.settings import BenchmarkSurface
from tools.benchmark.surface import FAR, WITHIN, SurfaceFigures, surface_figures


def run_surface(command: BenchmarkSurface) -> None:
    """Measure, show the table, write it if wanted."""
    check_output(command.output)
    scene, truth = Scene(command.scene), Scene(command.truth)
    scene.require(scene.mesh, hint="run `sc3d extract` first")
    if not scene.gaussians.exists():
        scene.require(scene.depth, hint="run `sc3d train` or `sc3d depth` first")
    exact = (
        truth.path / "truth_depth",
        truth.truth,
        truth.path / "truth.ply",
        truth.path / "truth_mesh.ply",
        truth.classes,
    )
    truth.require(*exact, hint="the exact surface comes from `sc3d synthesize`")
    voxel_size = command.voxel_size or voxel_size_of(scene)
    figures = surface_figures(scene, truth, voxel_size, command.depth_mode)
    record = {
        "benchmark": "surface",
        "scene": scene.path.resolve().name,
        "truth": truth.path.resolve().name,
        "depth_mode": command.depth_mode,
        "versions": versions(),
        "figures": asdict(figures),
    }
    publish(record, page(record["scene"], figures), command.output)


def voxel_size_of(scene: Scene) -> float:
    """The voxel size that `extract` noted beside the mesh, world units. Raises InputError if it did not."""
    record = read_json(sidecar(scene.mesh)) if sidecar(scene.mesh).exists() else {}
    size = record.get("summary", {}).get("voxel_size")
    if not isinstance(size, int | float) or size <= 0:
        raise InputError(f"{sidecar(scene.mesh)} does not tell the voxel size of the mesh: pass --voxel-size")
    return float(size)


def page(name: str, figures: SurfaceFigures) -> str:
    """One row per figure."""
    rows = [
        ("relative depth error, median, outside sky and trees", f"{100 * figures.depth_median:.3f} %"),
        ("relative depth error, 90th percentile, outside sky and trees", f"{100 * figures.depth_p90:.3f} %"),
        ("relative depth error, median, trees", f"{100 * figures.tree_median:.3f} %"),
        ("pixels whose depth counts", f"{figures.opaque:.1%}"),
        ("pixels that see the mesh", f"{figures.hit:.1%}"),
        ("pixels of trees that see the mesh", f"{figures.tree_hit:.1%}"),
        *(
            [("pixels of sky that see the mesh", f"{figures.sky_hit:.2%}")]
            if figures.sky_hit is not None
            else []
        ),
        (f"area of the mesh within {WITHIN:g} voxels of the truth", f"{figures.accuracy:.1%}"),
        (f"area of the mesh farther than {FAR:g} voxels from the truth", f"{figures.spikes:.1%}"),
        (f"true surface within {WITHIN:g} voxels of the mesh", f"{figures.complete:.1%}"),
        *(
            (f"true surface within {WITHIN:g} voxels of the mesh, {label}", f"{share:.1%}")
            for label, share in figures.completeness.items()
        ),
        ("voxel", f"{figures.voxel_size:g}"),
    ]
    return (
        "\n".join(
            [
                f"# Surface: {name}\n",
                "| | |",
                "| --- | ---: |",
                *(f"| {title} | {value} |" for title, value in rows),
            ]
        )
        + "\n"
    )
