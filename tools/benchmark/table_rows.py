"""The rows of the tables: baselines, the paper's method and ours, and one row per switch of Label and
Propagate.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass, fields, is_dataclass, replace
from typing import Literal, TypeVar, get_args, get_origin, get_type_hints

from sc3d.settings.common import Resources
from sc3d.settings.labels import Label, PaperMechanisms, Propagate
from tools.make_manual import helps

OURS, DEFAULT = "conflict-lock + geometry", "sc3d as it is by default"
NO_FILTER = Label(depth_filter=False)
GEOMETRY = Propagate(method="geometry")
BASELINES = ("direct", "majority")
RESOURCES = {field.name for field in fields(Resources)}


Settings = TypeVar("Settings", Label, Propagate, PaperMechanisms)


@dataclass(frozen=True)
class Row:
    """One way to label a cloud. propagate: None = the labels of `fuse` as they are; base: the row that an
    ablation row turns a switch of.
    """

    name: str
    label: Label
    propagate: Propagate | None
    base: Row | None = None

    @property
    def key(self) -> str:
        """Identity of the settings, whatever the row is called."""
        return hashlib.sha256(json.dumps(self.settings, sort_keys=True).encode()).hexdigest()[:16]

    @property
    def settings(self) -> dict:
        """JSON-ready; the options that name files are left out."""
        records = {"label": self.label, "propagate": self.propagate}
        return {
            stage: record
            and {
                name: value
                for name, value in asdict(record).items()
                if _is_mechanism(type(record), name) or name == "voxel_size"
            }
            for stage, record in records.items()
        }


def tables() -> dict[str, list[Row]]:
    """The rows of each table by its title; rows of equal settings are computed once."""
    ours, default, as_printed = (
        Row(OURS, Label(), GEOMETRY),
        Row(DEFAULT, Label(), Propagate()),
        Propagate(method="geometry", verify_seeds=False, color=False),
    )
    return {
        "Table 1: semantic accuracy": [
            Row("direct overlay, no filter", replace(NO_FILTER, method="direct"), None),
            Row("direct overlay", Label(method="direct"), None),
            Row("majority voting, no filter", replace(NO_FILTER, method="majority"), None),
            Row("majority voting", Label(method="majority"), None),
            Row(
                "majority voting + KNN", Label(method="majority"), Propagate(method="knn", verify_seeds=False)
            ),
            Row("paper preset (any conflict locks) + geometry", Label(method="paper"), as_printed),
            ours,
            default,
        ],
        "Table 2: propagation": [
            Row("conflict-lock, seeds only", Label(), None),
            Row(
                "conflict-lock + KNN, seeds not verified",
                Label(),
                Propagate(method="knn", verify_seeds=False),
            ),
            Row("conflict-lock + geometry, seeds not verified", Label(), as_printed),
            Row("conflict-lock + KNN", Label(), Propagate(method="knn")),
            ours,
            Row("conflict-lock + map", Label(), Propagate(method="map")),
        ],
        "Table 3: first-surface filter": [
            Row("conflict-lock + geometry, no filter", NO_FILTER, GEOMETRY),
            ours,
            Row("default, no filter", NO_FILTER, Propagate()),
            default,
        ],
        "Ablation": [default, *ablation()],
    }


def ablation() -> list[Row]:
    """The default with one switch turned, for every switch; switches of knn and geometry alone are turned in
    conflict-lock + geometry.
    """
    default, geometry = Row(DEFAULT, Label(), Propagate()), Row(OURS, Label(), GEOMETRY)
    rows = [Row(f"label: {text}", record, Propagate(), default) for text, record in turned(Label())]
    for text, record in turned(Propagate()):
        option = text.removeprefix("--no-").removeprefix("--").split()[0].replace("-", "_")
        if "(knn, geometry)" in helps(Propagate)[option]:
            rows.append(
                Row(f"propagate, geometry: {text}", Label(), replace(record, method="geometry"), geometry)
            )
        else:
            rows.append(Row(f"propagate: {text}", Label(), record, default))
    return rows


def turned(record: Settings) -> list[tuple[str, Settings]]:
    """Description and record for every switch that can be turned: flags, choices, and numbers for which the
    help says that 0 is off.
    """
    kind, found = type(record), []
    hints = get_type_hints(kind)
    for field in fields(kind):
        value, option = getattr(record, field.name), field.name.replace("_", "-")
        if is_dataclass(value):
            inside = turned(value)
            found += [(text, replace(record, **{field.name: inner})) for text, inner in inside]
        elif not _is_mechanism(kind, field.name):
            continue
        elif hints[field.name] is bool:
            found.append((f"--{'no-' if value else ''}{option}", replace(record, **{field.name: not value})))
        elif get_origin(hints[field.name]) is Literal:
            others = [
                choice
                for choice in get_args(hints[field.name])
                if choice != value and choice not in BASELINES
            ]
            found += [(f"--{option} {choice}", replace(record, **{field.name: choice})) for choice in others]
        elif "0 = off" in helps(kind)[field.name]:
            other = 0.0 if value else 1.0
            found.append((f"--{option} {other:g}", replace(record, **{field.name: type(value)(other)})))
    return found


def _is_mechanism(record: type, name: str) -> bool:
    return name != "voxel_size" and name not in RESOURCES and "Path" not in str(get_type_hints(record)[name])
