"""The parts of a report as HTML. Text from files passes through `html.escape`, here or in `charts`."""

from __future__ import annotations

import json
from collections.abc import Iterator
from html import escape
from pathlib import Path
from typing import Literal

import numpy as np

from sc3d.errors import examples
from sc3d.geometry.cameras import View
from sc3d.io.images import data_uri, read_image
from sc3d.report.charts import (
    count_map,
    css_color,
    flight_map,
    formatted,
    histogram,
    number,
    paired_bars,
    reliability_curve,
    stacked_bar,
)
from sc3d.report.data import BYTES, ReportData, read_features
from sc3d.report.images import cloud_pictures, comparison, comparison_size, ground_picture
from sc3d.report.tally import BINS, CloudTally
from sc3d.scene.class_table import OTHER
from sc3d.scene.labelled_cloud import LabelledSurface
from sc3d.scene.labels import CORRECTED
from sc3d.tiling.seen_points import labelled_sight, surface_fits
from sc3d.view.colors import STATES, Coloring, color_points, confidence_colors, legend_entries

_NUM_PHOTOS = 4
_COLORING_NAMES: dict[Coloring | Literal["mesh"], str] = {
    "label": "Classes",
    "photo": "Photo colors",
    "confidence": "Confidence",
    "state": "Origin of the label",
    "mesh": "Mesh",
}
# file names of `sc3d export --format objects`, and what they hold
_LAYERS = {"buildings": "buildings", "trees": "trees"}
_CATALOG = "objects"
_ROWS = 40  # objects that are listed
# columns of the list of objects, their names in the file, and formats
_OBJECT = {
    "Area, m²": ("area_m2", ",.1f"),
    "Height, m": ("height_m", ".1f"),
    "Volume, m³": ("volume_m3", ",.0f"),
    "Confidence": ("confidence", ".2f"),
}
# columns of the table of photos that were held out, their names in the summary of `train`, and formats
_HELD_OUT = {
    "Photos": ("photos", ".0f"),
    "PSNR, dB": ("psnr", ".2f"),
    "SSIM": ("ssim", ".3f"),
    "Seen": ("seen", ".1%"),
    "PSNR where seen": ("seen_psnr", ".2f"),
    "SSIM where seen": ("seen_ssim", ".3f"),
    "Depth right where seen": ("seen_depth", ".1%"),
}
_BLOCKS = {
    "settings": "Settings",
    "summary": "Results",
    "inputs": "Inputs and their hashes",
    "versions": "Versions",
}


def sections(data: ReportData) -> Iterator[tuple[str, str, str]]:
    """Anchor, title and HTML of each part; empty HTML where its files are missing."""
    yield "cloud", "The labelled cloud", cloud_section(data)
    yield "found", "What was found", found_section(data)
    yield "quality", "Agreement with the truth", quality_section(data)
    yield "photos", "In the photos", photo_section(data)
    yield "certainty", "Certainty", certainty_section(data)
    yield "flight", "Flight", flight_section(data)
    yield "training", "Gaussians", training_section(data)
    yield "check", "Before the work", check_section(data.check)
    yield "processing", "Processing", processing_section(data)


def summary_line(data: ReportData) -> str:
    """One sentence about the scene."""
    parts = []
    if data.cloud is not None:
        parts.append(f"{data.num_points:,} points")
    if data.views:
        parts.append(f"from {_count(len(data.views), 'photo')}")
    counts = data.label_counts
    if counts is not None:
        parts.append(f"in {_count(int((counts[1:] > 0).sum()), 'class', 'classes')}")
    sentence = " ".join(parts) or "An empty scene"
    accuracy = number(data.figures("labels").get("oa"))
    if accuracy is not None:
        photos = data.metrics.get("photos")
        where = f" of {_count(len(photos), 'photo')} with truth" if isinstance(photos, list) else ""
        sentence += f"; {accuracy:.1%} of the pixels{where} carry the right class"
    return escape(sentence + ".")


def headline(data: ReportData) -> str:
    """The figures at the top."""
    labels, masks = data.figures("labels"), data.figures("masks")
    tiles = []
    for key, name, pattern in (("oa", "Overall accuracy", "{:.1%}"), ("miou", "Mean IoU", "{:.3f}")):
        value, before = number(labels.get(key)), number(masks.get(key))
        if value is not None:
            tiles.append(
                (
                    name,
                    pattern.format(value),
                    "" if before is None else f"given masks {pattern.format(before)}",
                )
            )
    given, before = given_class(labels), given_class(masks)
    if given is not None:
        note = "" if before is None else f"; given masks {before:.1%}"
        tiles.append(("Other", f"{given:.1%}", f"of the pixels of no class are given one{note}"))
    coverage, counts = number(labels.get("coverage")), data.label_counts
    if coverage is not None:
        tiles.append(("Coverage", f"{coverage:.1%}", "of the pixels carry a label"))
    elif counts is not None:
        tiles.append(("Labelled", f"{1 - counts[0] / max(counts.sum(), 1):.1%}", "of the points"))
    if data.cloud is not None:
        tiles.append(("Points", _short(data.num_points), ""))
    if data.views:
        tiles.append(("Photos", f"{len(data.views):,}", ""))
    return "".join(
        f'<div class="tile"><span>{escape(name)}</span><strong>{escape(value)}</strong><small>{escape(note)}</small></div>'
        for name, value, note in tiles
    )


def cloud_section(data: ReportData) -> str:
    """Pictures of the cloud: one tab per coloring, from the south and from above."""
    pictures = cloud_pictures(data)
    names = [name for name in _COLORING_NAMES if (name, "oblique") in pictures]
    tabs, panels = [], []
    for position, name in enumerate(names):
        title, selected = _COLORING_NAMES[name], str(position == 0).lower()
        tabs.append(
            f'<button type="button" role="tab" aria-selected="{selected}" data-panel="cloud-{name}">{title}</button>'
        )
        images = "".join(
            _zoomable(*pictures[name, direction], f"{title}, {text}")
            for direction, text in (("oblique", "from the south"), ("above", "from above"))
            if (name, direction) in pictures
        )
        panels.append(
            f'<figure id="cloud-{name}" class="panel" {"" if position == 0 else "hidden"}>'
            f'<figcaption class="print-only">{title}</figcaption><div class="pair">{images}</div>{_legend(data, name)}</figure>'
        )
    shown = 0 if data.cloud is None else len(data.cloud.point.positions)
    note = f'<p class="note">Pictures show {_short(shown)} of {_short(data.num_points)} points.</p>'
    tablist = f'<div class="tabs" role="tablist">{"".join(tabs)}</div>{"".join(panels)}'
    return (note if shown < data.num_points else "") + tablist if names else ""


def _zoomable(uri: str, aspect: float, text: str) -> str:
    return f'<img class="zoom" style="flex: {aspect:.3f} 1 0" src="{uri}" alt="{text}" title="{text}; click to enlarge">'


def quality_section(data: ReportData) -> str:
    """IoU per class, labels against the given masks, and the confusion of the labels."""
    labels, masks = iou_of(data, "labels"), iou_of(data, "masks")
    if not labels:
        return ""
    colors = _class_colors(data)
    rows = [
        (name, colors.get(name, (128, 128, 128)), value, masks.get(name)) for name, value in labels.items()
    ]
    note = "Intersection over union per class against the truth masks. Wide bar: fused labels" + (
        "; gray bar: the given masks." if masks else "."
    )
    near, elsewhere = (
        number(data.figures(f"labels_{where}").get("oa")) for where in ("near_edges", "elsewhere")
    )
    if near is not None and elsewhere is not None:
        note += f" Near depth edges {near:.1%} of the pixels are right, elsewhere {elsewhere:.1%}."
    note += _told_of_empty(data)
    return f'<p class="note">{note}</p>{paired_bars(rows)}{_all_judged(data)}{_confusion(data)}'


def given_class(figures: dict) -> float | None:
    """Share of the pixels of no class that are given one; None where the truth marks none."""
    other = figures.get("other")
    return number(other.get("given_class")) if isinstance(other, dict) else None


def _all_judged(data: ReportData) -> str:
    """Precision and recall over all judged pixels, and what the pixels of no class were taken for."""
    sources = {"labels": "fused labels", "masks": "given masks"}
    shares = {
        source: {name: of_classes(data.figures(source), name) for name in ("precision", "recall")}
        for source in sources
        if data.figures(source).get("precision")
    }
    given = {source: given_class(data.figures(source)) for source in shares}
    if given.get("labels") is None:
        return ""
    columns = [found[name] for found in shares.values() for name in ("precision", "recall")]
    taken = [of_classes(data.figures(source).get("other"), "given") for source in shares]
    rows = [
        [escape(name), *(formatted(values.get(name), ".1%") for values in [*columns, *taken])]
        for name in _class_colors(data)
        if any(name in values for values in [*columns, *taken])
    ]
    heads = [f"{name}, {sources[source]}" for source in shares for name in ("Precision", "Recall")]
    heads += [f"Share of other, {sources[source]}" for source in shares]
    told = "; ".join(f"{sources[source]}: {formatted(share, '.1%')}" for source, share in given.items())
    return (
        f'<h3>All judged pixels</h3><p class="note">With pixels that are none of the classes. '
        f"Of these are given a class: {told}.</p>{_table(['Class', *heads], rows)}"
    )


def _told_of_empty(data: ReportData) -> str:
    """A sentence on the truth of classes without surface; empty if there is none."""
    found, parts = data.metrics.get("without_surface"), []
    for name, counts in found.items() if isinstance(found, dict) else ():
        pixels, right = (
            number(counts.get(key)) if isinstance(counts, dict) else None for key in ("pixels", "right")
        )
        if pixels and right is not None:
            parts.append(f"{escape(str(name))} {right / pixels:.1%} of {pixels:,.0f} pixels")
    return f" Judged apart, nothing is hit: {', '.join(parts)}." if parts else ""


def photo_section(data: ReportData) -> str:
    """A handful of photos with mask, fused labels and truth."""
    chosen, rows = _choose_views(data), []
    panels_of = {view.name: panels for view, panels in _comparisons(data, chosen)}
    for view in chosen:
        panels = panels_of[view.name]
        if len(panels) > 1:
            images = "".join(
                f'<figure><img src="{uri}" alt="{caption} of {escape(view.name)}"><figcaption>{caption}</figcaption></figure>'
                for caption, uri in panels
            )
            rows.append(
                f'<h3>{escape(view.name)}{_photo_figures(data, view.name)}</h3><div class="row">{images}</div>'
            )
    return "".join(rows) + _legend(data, "label", everything=True) if rows else ""


def _comparisons(data: ReportData, chosen: list) -> Iterator[tuple[View, list[tuple[str, str]]]]:
    """Each view with its `comparison`; the labels as the photos see them from memory or from disk."""
    if not chosen or data.label_counts is None or data.scene.best_cloud is None:
        yield from ((view, comparison(data, view, None)) for view in chosen)
    elif surface_fits(data.scene, data.scene.best_cloud, data.settings):
        surface = LabelledSurface.build(data.cloud, data.views, data.scene.surface)
        yield from ((view, comparison(data, view, surface)) for view in chosen)
    else:
        sizes = {view.name: comparison_size(view) for view in chosen}
        held = 0 if data.cloud is None else len(data.cloud.point.positions) * BYTES
        with labelled_sight(
            data.scene, data.settings, data.scene.best_cloud, sizes, data.scene.report, held=held
        ) as seen:
            yield from ((view, comparison(data, view, seen.surface)) for view in chosen)


def flight_section(data: ReportData) -> str:
    """Camera positions over the ground."""
    if not data.views:
        return ""
    centers = np.array([view.center for view in data.views])
    headings = np.array([view.cam_from_world[2, :2] for view in data.views])
    ground = None
    if "colors" in (data.cloud.point if data.cloud is not None else {}):
        ground = ground_picture(data.points, color_points(data.cloud, "photo"))
    lowest, highest = centers[:, 2].min(), centers[:, 2].max()
    note = f"{_count(len(centers), 'camera')} at heights (z) of {lowest:,.1f} to {highest:,.1f} m. The line shows where each looks."
    return f'<p class="note">{note}</p>{flight_map(centers[:, :2], headings, [view.name for view in data.views], ground)}'


def check_section(check: dict) -> str:
    """What `sc3d check` found, and how many photos show each place. Content of other kinds is left out."""
    if not check:
        return ""
    found = [finding for finding in check.get("findings") or [] if isinstance(finding, dict)]
    items = "".join(f"<li>{_finding(finding)}</li>" for finding in found)
    verdict = "Ready." if check.get("ready") is True else "Not ready."
    note = f'<p class="note">{verdict} {_count(len(found), "finding")}.</p><ul>{items}</ul>'
    coverage = check.get("coverage")
    counts = number_grid(coverage.get("photos")) if isinstance(coverage, dict) else None
    if counts is None:
        return note
    text = "How many photos show each place, from above"
    return f'{note}<figure>{count_map(counts)}<figcaption class="note">{text}</figcaption></figure>'


def number_grid(content: object) -> np.ndarray | None:
    """(H, W) int of a list of lists of whole numbers of one length; None for anything else."""
    try:
        grid = np.array(content)
    except ValueError:
        return None
    return grid if grid.ndim == 2 and grid.size and np.issubdtype(grid.dtype, np.integer) else None


def _finding(finding: dict) -> str:
    named = finding.get("told") or finding.get("photos")
    names = [str(name) for name in named] if isinstance(named, list) else []
    listed = f": {examples(names)}" if names else ""
    kind = "strong" if finding.get("problem") is True else "span"
    return (
        f"<{kind}>{escape(str(finding.get('text')) + listed)}</{kind}>; {escape(str(finding.get('advice')))}"
    )


def training_section(data: ReportData) -> str:
    """The contact sheet of the training, and how it did on the photos that it left out."""
    if not data.contact_sheet_file.exists():
        return _held_out_table(data)
    text = "Photos of the flight, and the Gaussians seen by the same cameras: rendering, depth and normals"
    return (
        f'<p class="note">{text}. Where a rendering is blurred, or its depth stands out from its surroundings, too few photos overlap.</p>'
        f'<figure><img src="{data_uri(read_image(data.contact_sheet_file))}" alt="{text}"></figure>'
        + _held_out_table(data)
    )


def _held_out_table(data: ReportData) -> str:
    """Means over the photos that were not trained on, by why they were not."""
    record = next((record for record in data.records if record["stage"] == "train"), {})
    settings, summary = (
        found if isinstance(found := record.get(key), dict) else {} for key in ("settings", "summary")
    )
    every, share = number(settings.get("test_every")), number(settings.get("test_sector"))
    rows = []
    for prefix, name in (
        ("held_out_", f"Between others: one of every {formatted(every, '.0f')}"),
        ("held_out_sector_", f"Beyond others: a sector of {formatted(share, '.0%')}"),
    ):
        if number(summary.get(f"{prefix}photos")) is not None:
            figures = [formatted(number(summary.get(prefix + key)), form) for key, form in _HELD_OUT.values()]
            rows.append([name, *figures])
    if not rows:
        return ""
    note = (
        "Photos that the training did not use, with the brightness that fits best; means over the photos. Seen: pixels that show what at least two "
        "photos of the training see, judged by the sparse points around; of the rest, nothing can be known. Depth: share of the seen pixels of known "
        "depth at which it is rendered within 1 %. Per photo: held_out.csv."
    )
    return f'<h3>Held out</h3><p class="note">{note}</p>{_table(["Photos left out", *_HELD_OUT], rows)}'


def _choose_views(data: ReportData) -> list:
    """Photos spread evenly over the flight; those with truth first, then those with a mask."""

    def with_file(files: dict[str, Path]) -> list:
        return [view for view in data.views if view.name in files]

    views = with_file(data.truth_files) or with_file(data.mask_files) or data.views
    if not views:
        return []
    spread = np.linspace(0, len(views) - 1, min(_NUM_PHOTOS, len(views))).round().astype(int)
    return [views[position] for position in np.unique(spread)]


def _photo_figures(data: ReportData, name: str) -> str:
    """Accuracy of one photo, labels and given mask."""
    photos = data.metrics.get("per_photo")
    figures = photos.get(name) if isinstance(photos, dict) else None
    if not isinstance(figures, dict):
        return ""
    sources = {"labels": "fused labels", "masks": "given mask"}
    found = [
        (text, number(figures[key].get("oa")))
        for key, text in sources.items()
        if isinstance(figures.get(key), dict)
    ]
    told = [f"{text} {value:.1%} right" for text, value in found if value is not None]
    given = given_class(figures["labels"]) if isinstance(figures.get("labels"), dict) else None
    told += [] if given is None else [f"{given:.1%} of other given a class"]
    return " ".join(f"<small>{text}</small>" for text in told)


def _legend(data: ReportData, by: Coloring | Literal["mesh"], everything: bool = False) -> str:
    """What the colors mean; of classes and states only those that the cloud has, unless `everything`."""
    if by == "confidence":
        stops = ", ".join(css_color(color) for color in confidence_colors(np.linspace(0, 1, 9)))
        return f'<p class="legend">confidence 0 <i class="ramp" style="background:linear-gradient(90deg, {stops})"></i> 1</p>'
    if by == "mesh":
        return ""
    counts = None
    if data.tally is not None and by in ("label", "state"):
        counts = data.tally.labels if by == "label" else data.tally.states
    present = None if counts is None or everything else set(np.flatnonzero(counts).tolist())
    entries = legend_entries(by, data.class_table, present)
    if everything and given_class(data.figures("labels")) is not None:
        entries += legend_entries(by, data.class_table, {OTHER})
    items = "".join(
        f'<li><i style="background:{css_color(color)}"></i>{escape(name)}</li>' for name, color in entries
    )
    return f'<ul class="legend">{items}</ul>' if items else ""


def _confusion(data: ReportData) -> str:
    """The confusion matrix as shares of the true class; rows 1, 2, ... and columns 0, 1, ... are class ids,
    column 0 = no label.
    """
    try:
        counts = np.array(data.figures("labels").get("confusion"), float)
    except (TypeError, ValueError):
        return ""
    if data.class_table is None or counts.shape != (
        data.class_table.num_ids - 1,
        data.class_table.num_ids,
    ):
        return ""
    ids = [
        entry.id
        for entry in data.class_table
        if counts[entry.id - 1].sum() > 0 or counts[:, entry.id].sum() > 0
    ]
    rows = []
    for label in ids:
        shares = counts[label - 1] / max(counts[label - 1].sum(), 1)
        cells = "".join(
            f'<td style="--share:{shares[column]:.3f}">{shares[column]:.1%}</td>' for column in [*ids, 0]
        )
        rows.append(f"<tr><th>{escape(data.class_table.name(label))}</th>{cells}</tr>")
    head = "".join(f"<th>{escape(data.class_table.name(label))}</th>" for label in ids) + "<th>no label</th>"
    return (
        f'<h3>Confusion</h3><p class="note">Rows: the true class. Columns: what the fused labels say, as share of the row.</p>'
        f'<div class="scroll"><table class="confusion"><thead><tr><th></th>{head}</tr></thead><tbody>{"".join(rows)}</tbody></table></div>'
    )


def _class_colors(data: ReportData) -> dict[str, tuple[int, int, int]]:
    return {entry.name: entry.color for entry in data.class_table} if data.class_table else {}


def _count(amount: int, noun: str, plural: str | None = None) -> str:
    return f"{amount:,} {noun if amount == 1 else plural or noun + 's'}"


def _short(amount: int) -> str:
    return f"{amount / 1e6:.2f} M" if amount >= 1e6 else f"{amount:,}"


def found_section(data: ReportData) -> str:
    """Area, points and confidence of each class; number and size of the objects, where `export --format
    objects` counted them.
    """
    return _class_table(data) + _object_table(data) + _catalog(data)


def iou_of(data: ReportData, source: str) -> dict[str, float | None]:
    """IoU by class name of "labels" or "masks"; empty without metrics."""
    return of_classes(data.figures(source), "iou")


def of_classes(figures: object, key: str) -> dict[str, float | None]:
    """A figure by class name; empty if there is none."""
    found = figures.get(key) if isinstance(figures, dict) else None
    return {str(name): number(value) for name, value in found.items()} if isinstance(found, dict) else {}


def _class_table(data: ReportData) -> str:
    counts = data.label_counts
    if data.tally is None or counts is None or data.class_table is None or not data.num_points:
        return ""
    iou = iou_of(data, "labels")
    areas, sums, rows = data.tally.areas, data.tally.sums, []
    assert areas is not None
    for label in [*(entry.id for entry in data.class_table), *([0] if counts[0] else [])]:
        name = data.class_table.name(label)
        mean = "–" if sums is None or not counts[label] else f"{sums[label] / counts[label]:.2f}"
        cells = [
            f"{areas[label]:,.0f}",
            f"{areas[label] / max(areas.sum(), 1e-12):.1%}",
            f"{counts[label]:,}",
        ] + ([mean] if sums is not None else [])
        cells += [formatted(iou.get(name), ".3f")] if iou else []
        swatch = f'<i style="background:{css_color(data.class_table.palette[label])}"></i>'
        rows.append([f"{swatch}{escape(name)}", *cells])
    heads = (
        ["Class", "Area, m²", "Share", "Points"]
        + (["Confidence"] if sums is not None else [])
        + (["IoU"] if iou else [])
    )
    return (
        '<p class="note">Areas as seen straight from above; square meters if the model is metric.</p>'
        + _table(heads, rows)
    )


def _object_table(data: ReportData) -> str:
    rows = []
    for stem, name in _LAYERS.items():
        objects = _features(data, stem)
        if objects is not None:
            area, height = (
                np.array([number(item.get(key)) or 0.0 for item in objects])
                for key in ("area_m2", "height_m")
            )
            sizes = (
                [
                    f"{area.sum():,.0f}",
                    f"{np.median(area):,.0f}",
                    f"{np.median(height):.1f}",
                    f"{height.max():.1f}",
                ]
                if len(objects)
                else ["–"] * 4
            )
            rows.append([name, f"{len(objects):,}", *sizes])
    if not rows:
        return ""
    heads = ["Objects", "Number", "Area, m²", "Median area, m²", "Median height, m", "Highest, m"]
    return "<h3>Counted</h3>" + _table(heads, rows)


def _features(data: ReportData, stem: str) -> list[dict] | None:
    """Properties of the objects of an exported layer; None if there is none."""
    files = (data.scene.export / f"{stem}{where}.geojson" for where in ("", "_local"))
    return next((found for file in files if (found := read_features(file)) is not None), None)


def _catalog(data: ReportData) -> str:
    """The objects one by one, the largest first."""
    objects = _features(data, _CATALOG)
    if not objects:
        return ""
    ordered = sorted(objects, key=lambda item: -(number(item.get("area_m2")) or 0.0))
    rows = []
    for item in ordered[:_ROWS]:
        sizes = [formatted(number(item.get(key)), form) for key, form in _OBJECT.values()]
        texts = [escape(str(item.get(key, ""))) for key in ("id", "class", "best_photo")]
        rows.append([texts[0], texts[1], *sizes, texts[2]])
    note = f"The {_ROWS} largest of {len(objects):,}; all" if len(objects) > _ROWS else "All"
    text = f'<p class="note">{note} with outlines in <code>export/{_CATALOG}*.geojson</code>.</p>'
    heads = ["Object", "Class", *_OBJECT, "Best photo"]
    return "<h3>One by one</h3>" + text + _table(heads, rows)


def _table(heads: list[str], rows: list[list[str]]) -> str:
    head = "".join(f"<th>{name}</th>" for name in heads)
    body = "".join(
        f"<tr><th>{row[0]}</th>{''.join(f'<td>{cell}</td>' for cell in row[1:])}</tr>" for row in rows
    )
    return f'<div class="scroll"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'


def certainty_section(data: ReportData) -> str:
    """Confidence of the points, whether it can be believed, and how their labels came about."""
    tally, parts = data.tally or CloudTally(0), []
    states = tally.states
    if tally.distribution is not None:
        colors = confidence_colors((np.arange(BINS) + 0.5) / BINS)
        parts.append(
            f'<div><h3>Confidence</h3><p class="note">Share of the points by confidence; median {tally.median:.2f}.</p>'
            f"{histogram(tally.distribution, colors)}</div>"
        )
    parts += _reliability(data)
    if states is not None and tally.size:
        shares = states[: len(STATES)] / tally.size
        rows = [(state.name, state.color, float(share)) for state, share in zip(STATES, shares, strict=True)]
        rows = [row for row in rows if row[2] or row[0] != STATES[CORRECTED].name]
        items = "".join(
            f'<li><i style="background:{css_color(color)}"></i>{escape(name)} <b>{share:.1%}</b></li>'
            for name, color, share in rows
        )
        parts.append(
            f'<div><h3>Origin of the labels</h3><p class="note">Seeds come from the photos, propagated labels from their neighbors; '
            f'locked points were contradictory.</p>{stacked_bar(rows)}<ul class="legend">{items}</ul></div>'
        )
    return f'<div class="columns">{"".join(parts)}</div>' if parts else ""


def _reliability(data: ReportData) -> list[str]:
    """The reliability curve as a list of one block; empty without truth."""
    figures = data.figures("reliability")
    rows = figures.get("bins")
    if (
        not isinstance(rows, list)
        or not any(rows)
        or not all(row is None or isinstance(row, list) and len(row) == 3 for row in rows)
    ):
        return []
    bins = []
    for row in rows:
        confidence, accuracy, count = (None, None, None) if row is None else map(number, row)
        if None in (confidence, accuracy, count) and (confidence, accuracy, count) != (None, None, None):
            return []
        bins.append((confidence, accuracy, count))
    pixels = sum(count or 0 for _, _, count in bins)
    bins = [(confidence, accuracy, count and count / max(pixels, 1)) for confidence, accuracy, count in bins]
    error = number(figures.get("ece"))
    note = "Share of right pixels (dots) against the confidence of their label; on the line, confidence is exactly that share. Bars: share of the pixels."
    if error is not None:
        note += f" Expected calibration error {error:.3f}."
    return [f'<div><h3>Reliability</h3><p class="note">{note}</p>{reliability_curve(bins)}</div>']


def processing_section(data: ReportData) -> str:
    """Time and memory per stage, then every setting and version."""
    if not data.records:
        return ""
    rows, details = [], []
    for record in data.records:
        summary = record.get("summary")
        summary = summary if isinstance(summary, dict) else {}
        text = "; ".join(
            f"{key} {_plain(value)}" for key, value in summary.items() if not isinstance(value, dict | list)
        )
        rows.append(
            f"<tr><th>{escape(record['stage'])}</th><td>{formatted(number(record.get('seconds')), ',.1f')}</td>"
            f'<td>{formatted(number(record.get("peak_memory_mb")), ",.0f")}</td><td class="text">{escape(text)}</td></tr>'
        )
        blocks = "".join(
            f"<h4>{title}</h4>{_pairs(record[key])}" for key, title in _BLOCKS.items() if record.get(key)
        )
        details.append(
            f"<details><summary>{escape(record['stage'])} <span>{escape(', '.join(record['outputs']))}</span></summary>{blocks}</details>"
        )
    head = '<tr><th>Stage</th><th>Time, s</th><th>Memory, MB</th><th class="text">Results</th></tr>'
    table = f'<div class="scroll"><table><thead>{head}</thead><tbody>{"".join(rows)}</tbody></table></div>'
    return f"{table}<h3>Settings and versions</h3>{''.join(details)}"


def _pairs(content: object) -> str:
    if not isinstance(content, dict):
        return f"<p>{escape(_plain(content))}</p>"
    return (
        "<dl>"
        + "".join(
            f"<dt>{escape(str(key))}</dt><dd>{escape(_plain(value))}</dd>" for key, value in content.items()
        )
        + "</dl>"
    )


def _plain(value: object) -> str:
    if value is None:
        return "–"
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, int) and not isinstance(value, bool):
        return f"{value:,}"
    return value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
