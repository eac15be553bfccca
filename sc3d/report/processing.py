"""Time, memory, settings and versions of the stages, as HTML; from the sidecars."""

from __future__ import annotations

import json
from html import escape

from sc3d.report.charts import formatted, number
from sc3d.report.data import ReportData

_BLOCKS = {
    "settings": "Settings",
    "summary": "Results",
    "inputs": "Inputs and their hashes",
    "versions": "Versions",
}


def processing_section(data: ReportData) -> str:
    """Time and memory per stage, then every setting and version."""
    if not data.records:
        return ""
    rows, details = [], []
    for record in data.records:
        summary = record.get("summary") if isinstance(record.get("summary"), dict) else {}
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
