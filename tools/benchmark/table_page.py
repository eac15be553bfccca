"""The record of `tables` as a Markdown page: mean and spread over seeds, differences beside the paper's."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from tools.benchmark.table_rows import DEFAULT, OURS

MASKS, BOUND = "the masks themselves", "upper bound: true labels of the points"
# what is compared, the paper's difference on BeDOI-GB in OA and mIoU (its Tables 1 to 3), our rows
DIFFERENCES = [
    ("ours - direct overlay", (19.90, 27.10), OURS, "direct overlay, no filter"),
    ("ours - majority voting", (12.39, 17.03), OURS, "majority voting, no filter"),
    ("ours - majority voting with the filter", None, OURS, "majority voting"),
    ("geometry - KNN", (1.13, 1.65), OURS, "conflict-lock + KNN"),
    (
        "geometry - KNN, seeds not verified",
        (1.13, 1.65),
        "conflict-lock + geometry, seeds not verified",
        "conflict-lock + KNN, seeds not verified",
    ),
    ("filter - none", (24.99, 31.50), OURS, "conflict-lock + geometry, no filter"),
    ("default - conflict-lock + geometry", None, DEFAULT, OURS),
    ("default - majority voting with the filter", None, DEFAULT, "majority voting"),
]
NOTE = (
    "Per cent, over the pixels with truth of every {every}th photo: first surface, nearest cloud point, no label "
    "counts as wrong. Edges: within 10 px of a depth edge; elsewhere some classes are rare (trees are all edges), "
    "so look at OA there. All judged pixels: with what the truth marks as other. "
    "Points: mIoU over the points of the cloud, where their labels are known. "
    "ECE: expected calibration error of the confidence, 10 bins. ± is the standard deviation over {seeds}. CPU s: label and propagate, all "
    "threads, without reading cloud and mesh. MB: peak memory of the process, the loaded scene included. Code {code}."
)


def markdown(record: dict) -> str:
    """A page with all tables, per group of scenes, and the ablation over all of them."""
    groups: dict[str, list[dict]] = {}
    for result in record["results"]:
        groups.setdefault(result["group"], []).append(result)
    seeds = max(len(results) for results in groups.values())
    notes = NOTE.format(
        every=record["settings"]["every"],
        seeds=f"{seeds} seeds" if seeds > 1 else "seeds (there is one)",
        code=record["code"],
    )
    layout = {title: rows for title, rows in record["layout"].items() if title != "Ablation"}
    parts = [
        "# Tables",
        notes,
        "## Differences",
        _differences(record["layout"], groups),
        _class_differences(record["layout"], groups),
    ]
    parts += ["## Ablation", _ablation(record["layout"]["Ablation"], groups)]
    for group, results in groups.items():
        parts.append(f"## {group[0].upper()}{group[1:]}: {', '.join(result['scene'] for result in results)}")
        for title, rows in layout.items():
            parts += [f"### {title}", _table(rows, results)]
        if any(np.isfinite(_given(result["rows"]["masks"]["all"])) for result in results):
            parts += ["### All judged pixels", _open_table(layout, results)]
    return "\n\n".join(parts) + "\n"


def spread(values: list[float], digits: int = 1, sign: str = "") -> str:
    """Mean and standard deviation over seeds."""
    values = [value for value in values if np.isfinite(value)]
    if not values:
        return "–"
    return f"{np.mean(values):{sign}.{digits}f}" + (
        f" ± {np.std(values, ddof=1):.{digits}f}" if len(values) > 1 else ""
    )


def _table(rows: list[dict], results: list[dict]) -> str:
    classes = [
        name
        for name in results[0]["classes"]
        if any(name in result["rows"]["masks"]["all"]["iou"] for result in results)
    ]
    heads = [
        "OA",
        "mIoU",
        *classes,
        "OA edges",
        "mIoU edges",
        "OA elsewhere",
        "mIoU elsewhere",
        "coverage",
        "points",
        "ECE",
        "CPU s",
        "MB",
    ]
    lines = []
    for name, found in _figures(rows, results):
        cells = [
            _percent(found, lambda figures: figures["all"]["oa"]),
            _percent(found, lambda figures: figures["all"]["miou"]),
        ]
        cells += [
            _percent(found, lambda figures, label=label: figures["all"]["iou"].get(label, np.nan))
            for label in classes
        ]
        for area, figure in (
            ("near_edges", "oa"),
            ("near_edges", "miou"),
            ("elsewhere", "oa"),
            ("elsewhere", "miou"),
        ):
            cells.append(_percent(found, lambda figures, area=area, figure=figure: figures[area][figure]))
        cells += [_percent(found, lambda figures: figures["all"]["coverage"])]
        cells += [_percent(found, lambda figures: figures.get("points", {}).get("miou", np.nan))]
        cells += [_percent(found, lambda figures: figures.get("reliability", {}).get("ece", np.nan))]
        cells += [
            spread([figures.get(key, np.nan) for figures in found], digits)
            for key, digits in (("cpu_seconds", 1), ("peak_memory_mb", 0))
        ]
        lines.append([name, *cells])
    return _grid(["", *heads], lines)


def _figures(rows: list[dict], results: list[dict]) -> list[tuple[str, list[dict]]]:
    """Name and figures on every scene: of masks, rows, and the bound, where the points' truth is known."""
    masks = [result["rows"]["masks"] for result in results]
    bounds = (
        [(BOUND, [figures["bound"] for figures in masks])]
        if all("bound" in figures for figures in masks)
        else []
    )
    made = [(row["name"], [result["rows"][row["key"]] for result in results]) for row in rows]
    return [(MASKS, masks), *made, *bounds]


def _open_table(layout: dict[str, list[dict]], results: list[dict]) -> str:
    """Share of other that is given a class, precision and recall of every class over all judged pixels."""
    unique = list({row["key"]: row for rows in layout.values() for row in rows}.values())
    classes, lines = results[0]["classes"], []
    for name, found in _figures(unique, results):
        cells = [_percent(found, lambda figures: _given(figures["all"]))]
        for label in classes:
            for figure in ("precision", "recall"):
                cells.append(
                    _percent(
                        found,
                        lambda figures, label=label, figure=figure: figures["all"][figure].get(label, np.nan),
                    )
                )
        lines.append([name, *cells])
    heads = [f"{label} {figure}" for label in classes for figure in ("precision", "recall")]
    return _grid(["", "other given a class", *heads], lines)


def _given(figures: dict) -> float:
    share = figures.get("other", {}).get("given_class")  # records of earlier versions have none
    return np.nan if share is None else share


def _differences(layout: dict[str, list[dict]], groups: dict[str, list[dict]]) -> str:
    """OA and mIoU: the paper's, ours per group."""
    keys = {row["name"]: row["key"] for rows in layout.values() for row in rows}
    lines = []
    for name, paper, better, worse in DIFFERENCES:
        cells = [" / ".join(f"{value:+.2f}" for value in paper) if paper else "–"]
        for results in groups.values():
            pairs = [
                (result["rows"][keys[better]]["all"], result["rows"][keys[worse]]["all"])
                for result in results
            ]
            cells.append(
                " / ".join(
                    spread([100 * (more[figure] - less[figure]) for more, less in pairs], 2, "+")
                    for figure in ("oa", "miou")
                )
            )
        lines.append([name, *cells])
    return _grid(["OA / mIoU, points", "paper, BeDOI-GB", *groups], lines)


def _class_differences(layout: dict[str, list[dict]], groups: dict[str, list[dict]]) -> str:
    """IoU of each class: the default against majority voting with the filter."""
    keys = {row["name"]: row["key"] for rows in layout.values() for row in rows}
    classes, lines = (
        list(
            dict.fromkeys(
                name for results in groups.values() for result in results for name in result["classes"]
            )
        ),
        [],
    )
    for group, results in groups.items():
        pairs = [
            (
                result["rows"][keys[DEFAULT]]["all"]["iou"],
                result["rows"][keys["majority voting"]]["all"]["iou"],
            )
            for result in results
        ]
        lines.append(
            [
                group,
                *(
                    spread(
                        [100 * (more.get(name, np.nan) - less.get(name, np.nan)) for more, less in pairs],
                        2,
                        "+",
                    )
                    for name in classes
                ),
            ]
        )
    return _grid(["IoU, default - majority voting with the filter", *classes], lines)


def _ablation(rows: list[dict], groups: dict[str, list[dict]]) -> str:
    """Change of mIoU when one switch is turned, sorted: what helps most stands first."""
    default, lines = rows[0]["key"], []
    for row in rows[1:]:
        changes = {
            group: [_change(result, row["key"], row["base"]) for result in results]
            for group, results in groups.items()
        }
        everywhere = [change for values in changes.values() for change in values]
        edges = [
            _change(result, row["key"], row["base"], "near_edges")
            for results in groups.values()
            for result in results
        ]
        seconds = [
            result["rows"][row["key"]]["cpu_seconds"] - result["rows"][row["base"]]["cpu_seconds"]
            for results in groups.values()
            for result in results
        ]
        cells = [spread(values, 2, "+") for values in changes.values()]
        lines.append(
            (
                np.mean(everywhere),
                [
                    row["name"],
                    *cells,
                    f"{np.mean(everywhere):+.2f}",
                    f"{np.mean(edges):+.2f}",
                    f"{np.mean(seconds):+.0f}",
                ],
            )
        )
    level = [
        spread([100 * result["rows"][default]["all"]["miou"] for result in results])
        for results in groups.values()
    ]
    every = [
        100 * result["rows"][default]["all"]["miou"] for results in groups.values() for result in results
    ]
    lines = [
        ["default, mIoU", *level, f"{np.mean(every):.1f}", "", ""],
        *(line for _, line in sorted(lines, key=lambda line: line[0])),
    ]
    return _grid(["change of mIoU, points", *groups, "mean of all scenes", "mean near edges", "CPU s"], lines)


def _change(result: dict, key: str, base: str, area: str = "all") -> float:
    return 100 * (result["rows"][key][area]["miou"] - result["rows"][base][area]["miou"])


def _percent(found: list[dict], value: Callable[[dict], float]) -> str:
    return spread([100 * value(figures) for figures in found])


def _grid(heads: list[str], lines: list[list[str]]) -> str:
    rows = [heads, ["---", *["---:"] * (len(heads) - 1)], *lines]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in rows)
