"""The parts of a report as HTML. Text from files passes through `html.escape`, here or in `charts`."""

from __future__ import annotations

from collections.abc import Iterator
from html import escape
from pathlib import Path

import numpy as np

from sc3d.io.images import read_image
from sc3d.report.certainty import certainty_section
from sc3d.report.charts import css_color, flight_map, number, paired_bars
from sc3d.report.data import ReportData
from sc3d.report.images import cloud_pictures, comparison, ground_picture, jpeg
from sc3d.report.objects import found_section, iou_of
from sc3d.report.processing import processing_section
from sc3d.scene.labelled_cloud import LabelledSurface
from sc3d.view.colors import color_points, confidence_colors, legend_entries

_NUM_PHOTOS = 4
_COLORING_NAMES = {
    "label": "Classes",
    "photo": "Photo colors",
    "confidence": "Confidence",
    "state": "Origin of the label",
    "mesh": "Mesh",
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
    yield "processing", "Processing", processing_section(data)


def summary_line(data: ReportData) -> str:
    """One sentence about the scene."""
    parts = []
    if data.cloud is not None:
        parts.append(f"{len(data.points):,} points")
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
    coverage, counts = number(labels.get("coverage")), data.label_counts
    if coverage is not None:
        tiles.append(("Coverage", f"{coverage:.1%}", "of the pixels carry a label"))
    elif counts is not None:
        tiles.append(("Labelled", f"{1 - counts[0] / max(counts.sum(), 1):.1%}", "of the points"))
    if data.cloud is not None:
        tiles.append(("Points", _short(len(data.points)), ""))
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
    return f'<div class="tabs" role="tablist">{"".join(tabs)}</div>{"".join(panels)}' if names else ""


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
    return f'<p class="note">{note}</p>{paired_bars(rows)}{_confusion(data)}'


def photo_section(data: ReportData) -> str:
    """A handful of photos with mask, fused labels and truth."""
    chosen, rows = _choose_views(data), []
    labelled = None
    if chosen and data.label_counts is not None:
        labelled = LabelledSurface.build(data.cloud, data.views, data.scene.mesh)
    for view in chosen:
        panels = comparison(data, view, labelled)
        if len(panels) > 1:
            images = "".join(
                f'<figure><img src="{uri}" alt="{caption} of {escape(view.name)}"><figcaption>{caption}</figcaption></figure>'
                for caption, uri in panels
            )
            rows.append(
                f'<h3>{escape(view.name)}{_photo_figures(data, view.name)}</h3><div class="row">{images}</div>'
            )
    return "".join(rows) + _legend(data, "label", everything=True) if rows else ""


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


def training_section(data: ReportData) -> str:
    """The contact sheet of the training."""
    if not data.training_sheet.exists():
        return ""
    text = "Photos of the flight, and the Gaussians seen by the same cameras: rendering, depth and normals"
    return (
        f'<p class="note">{text}. Where a rendering is blurred, or its depth stands out from its surroundings, too few photos overlap.</p>'
        f'<figure><img src="{jpeg(read_image(data.training_sheet))}" alt="{text}"></figure>'
    )


def _choose_views(data: ReportData) -> list:
    """Photos spread evenly over the flight; those with truth first, then those with a mask."""

    def with_file(folder: Path) -> list:
        return [view for view in data.views if (folder / f"{Path(view.name).stem}.png").exists()]

    views = with_file(data.truth) or with_file(data.scene.masks) or data.views
    chosen = (
        np.unique(np.linspace(0, len(views) - 1, min(_NUM_PHOTOS, len(views))).round().astype(int))
        if views
        else []
    )
    return [views[position] for position in chosen]


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
    return " ".join(f"<small>{text} {value:.1%} right</small>" for text, value in found if value is not None)


def _legend(data: ReportData, by: str, everything: bool = False) -> str:
    """What the colors mean; of classes and states only those that the cloud has, unless `everything`."""
    if by == "confidence":
        stops = ", ".join(css_color(color) for color in confidence_colors(np.linspace(0, 1, 9)))
        return f'<p class="legend">confidence 0 <i class="ramp" style="background:linear-gradient(90deg, {stops})"></i> 1</p>'
    values = data.values(by) if by in ("label", "state") else None
    present = None if values is None or everything else set(np.unique(values).tolist())
    entries = legend_entries(by, data.class_table, present)
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
