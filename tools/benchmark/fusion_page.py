"""The figures of `fusion_speed` as a Markdown page."""

from __future__ import annotations

RIVALS = {
    "label": ("rays only", "numpy z-buffer voter"),
    "propagate map": ("16 nearest neighbors", "scikit-learn KNN"),
}
NOTE = (
    "CPU s: all threads of the process; wall s counts waiting for busy cores (load at the start was {load:.2f}). Medians; contenders take turns. Rays only: "
    "`cast_rays` on prepared rays, one per mask pixel of every view. z-buffer voter: project, `np.minimum.at`, compare, `np.add.at`. Nearest neighbors: one "
    "batched pass, tree included. scikit-learn: KNeighborsClassifier fitted on the seeds, asked for the points without label."
)
MEMORY = "Allowed: 1 GB + 200 bytes per point + 60 bytes per voxel. Memory is that of the process, which also holds mesh, masks and cloud of the benchmark."


def markdown(record: dict) -> str:
    """Contenders with ratios, growth over points and over views. record: as `run_fusion_speed` makes it."""
    title = f"# Speed of label and propagate: {record['scene']}"
    head = f"{record['points']:,} points, {record['views']} views, {record['rays']:,} rays, {record['triangles']:,} triangles."
    parts = [
        title,
        head,
        _contenders(record["contenders"]),
        NOTE.format(load=record["load"]),
        "## Growth with points",
        _growth(record["growth_points"], "points"),
        "## Growth with views",
        _growth(record["growth_views"], "views"),
        MEMORY,
    ]
    return "\n\n".join(parts) + "\n"


def _contenders(contenders: dict[str, dict[str, float]]) -> str:
    lines = ["| | CPU s | wall s | ratio, CPU | ratio, wall |", "| --- | ---: | ---: | ---: | ---: |"]
    for ours, others in RIVALS.items():
        for name in (ours, *(other for other in others if other in contenders)):
            clocks = () if name == ours else ("cpu_seconds", "wall_seconds")
            ratios = [
                f"{contenders[ours][clock] / max(contenders[name][clock], 1e-9):.2f}" for clock in clocks
            ] or ["", ""]
            cells = [
                f"{contenders[name]['cpu_seconds']:.2f}",
                f"{contenders[name]['wall_seconds']:.2f}",
                *ratios,
            ]
            lines.append(f"| {name if name == ours else f'{ours} / {name}'} | {' | '.join(cells)} |")
    return "\n".join(lines)


def _growth(runs: list[dict], what: str) -> str:
    """Seconds by size; beside it how far they are from growing in proportion to the size since the first one."""
    lines = [
        f"| {what} | label, CPU s | of linear | propagate, CPU s | of linear | peak MB, label | peak MB, propagate | allowed MB |",
        "| ---: " * 8 + "|",
    ]
    first = runs[0]
    for run in runs:
        factor = run[what] / first[what]
        label, propagate = run["label_cpu_seconds"], run["propagate_cpu_seconds"]
        linear = [
            f"{label / (factor * first['label_cpu_seconds']):.2f}",
            f"{propagate / (factor * first['propagate_cpu_seconds']):.2f}" if what == "points" else "–",
        ]
        allowed = 1000 + (200 * run["points"] + 60 * run["voxels"]) / 1e6
        cells = [f"{run[what]:,}", f"{label:.1f}", linear[0], f"{propagate:.1f}", linear[1]]
        cells += [f"{run['label_peak_memory_mb']}", f"{run['propagate_peak_memory_mb']}", f"{allowed:.0f}"]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)
