"""The figures of `training` as a Markdown table: one column per configuration."""

from __future__ import annotations

from collections.abc import Callable

from tools.benchmark.opensplat import REFERENCE_CPU_SECONDS, REFERENCE_GFLOPS

NOTE = (
    "Times are medians. CPU ms are those of the one thread that works, wall ms with all threads (true only on an idle machine: load at the start "
    "was {load:.2f}). Iteration: project, bin, 7 channels forward, L1 + 0.2 SSIM, backward, Adam; SH degree 0. Arithmetic limit: 54 + 82 operations "
    "per slot evaluated, forward + backward, at the rate of a float32 multiply-add loop measured in turn with them."
)
REFERENCE_NOTE = (
    f"OpenSplat did not run here. Its figures (0.82-0.95, 1.64, 6.43, 8.4-8.7 CPU s) are from the reference machine of PERFORMANCE.md "
    f"({REFERENCE_GFLOPS:g} GFLOP/s per core): ratios marked * compare two machines; those marked ** are scaled by both machines' multiply-add rates, an estimate."
)


def markdown(record: dict) -> str:
    """A page with the table and what its figures mean. record: as `sc3d benchmark speed --output` writes it."""
    columns = record["configurations"]
    rows = [("", [column["name"] for column in columns]), ("---", ["---:"] * len(columns))]
    stages = list(columns[0]["cpu_seconds"])
    rows += [
        (f"{stage}, CPU ms", [f"{1e3 * column['cpu_seconds'][stage]:.1f}" for column in columns])
        for stage in stages
    ]
    rows += [
        (
            f"{stage}, wall ms, {column_threads(columns)} threads",
            [f"{1e3 * column['wall_seconds'][stage]:.1f}" for column in columns],
        )
        for stage in stages
    ]
    rows += [
        (title, [_cell(value, column) for column in columns])
        for title, value in _ROWS
        if any(_cell(value, column) for column in columns)
    ]
    table = "\n".join(f"| {title} | {' | '.join(cells)} |" for title, cells in rows)
    notes = [NOTE.format(load=record["load"])] + (
        [] if any("opensplat_ratio" in column for column in columns) else [REFERENCE_NOTE]
    )
    return f"# Training speed: {record['scene']}\n\n{table}\n\n" + "\n\n".join(notes) + "\n"


def column_threads(columns: list[dict]) -> int:
    """Threads of the wall times."""
    return columns[0]["threads"]


def reference_ratio(column: dict, scaled: bool) -> float | None:
    """OpenSplat's CPU time on the reference machine / ours here; None for configurations that were not
    measured there.
    """
    seconds = REFERENCE_CPU_SECONDS.get((column["gaussians"], max(column["width"], column["height"])))
    if seconds is None:
        return None
    return (
        seconds
        / column["cpu_seconds"]["total"]
        * (REFERENCE_GFLOPS / column["ceiling_gflops"] if scaled else 1.0)
    )


def _cell(value: Callable[[dict], str | None], column: dict) -> str:
    try:
        return value(column) or ""
    except KeyError:
        return ""


def _ratio(column: dict, scaled: bool) -> str | None:
    ratio = None if "opensplat_ratio" in column else reference_ratio(column, scaled)
    return None if ratio is None else f"{ratio:.1f} {'**' if scaled else '*'}"


_ROWS: tuple[tuple[str, Callable[[dict], str | None]], ...] = (
    ("speed-up of wall time, all threads / one", lambda column: f"{column['wall_speed_up']:.2f}"),
    (
        "the same if no thread waited for a core, from CPU times of threads",
        lambda column: f"{column['idle_speed_up']:.2f}",
    ),
    ("share of the Gaussians in view, %", lambda column: f"{100 * column['visible_share']:.1f}"),
    ("contributing fragments per pixel", lambda column: f"{column['fragments_per_pixel']:.1f}"),
    ("slots evaluated per pixel", lambda column: f"{column['slots_per_pixel']:.1f}"),
    ("forward + backward, GFLOP/s", lambda column: f"{column['gflops']:.1f}"),
    ("multiply-add loop, GFLOP/s, one thread", lambda column: f"{column['ceiling_gflops']:.1f}"),
    ("multiply-add loop, GFLOP/s, all threads", lambda column: f"{column['ceiling_gflops_all_threads']:.1f}"),
    ("fraction of the arithmetic limit", lambda column: f"{column['arithmetic_fraction']:.3f}"),
    ("peak memory, iteration, MB", lambda column: f"{column['peak_memory_mb']}"),
    ("plain training step, CPU ms", lambda column: f"{1e3 * column['plain_step_cpu_seconds']:.1f}"),
    (
        "step with surface terms (two views), CPU ms",
        lambda column: f"{1e3 * column['surface_step_cpu_seconds']:.1f}",
    ),
    ("with surface terms / plain", lambda column: f"{column['surface_step_ratio']:.2f}"),
    ("peak memory, both kinds of step, MB", lambda column: f"{column['steps_peak_memory_mb']}"),
    ("OpenSplat, CPU ms", lambda column: f"{1e3 * column['opensplat_cpu_seconds']:.1f}"),
    ("OpenSplat / sc3d", lambda column: f"{column['opensplat_ratio']:.1f}"),
    ("OpenSplat on the reference machine / sc3d here", lambda column: _ratio(column, scaled=False)),
    ("the same, scaled by multiply-add rates", lambda column: _ratio(column, scaled=True)),
)
