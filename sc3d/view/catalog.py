"""What `sc3d export --format objects` found out about each object, for who clicks on one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from sc3d.errors import InputError
from sc3d.io.json_files import read_json
from sc3d.io.provenance import digest
from sc3d.runner import MAX_SIDECAR, sidecar
from sc3d.scene.scene import Scene

FILES = ("objects.geojson", "objects_local.geojson")
ROWS = {  # what is shown of an object: field of the file, and how
    "area_m2": ("area", "{:.1f} m²"),
    "height_m": ("height", "{:.1f} m above the ground"),
    "volume_m3": ("volume", "{:.0f} m³"),
    "confidence": ("mean confidence", "{:.2f}"),
    "best_photo": ("best photo", "{}"),
}
MISSING = "for area, height and volume: `sc3d export SCENE --format objects`"


class Catalog:
    """The objects of a scene by their number in the cloud; read when it is first asked, and again once a
    file has changed.
    """

    def __init__(self, scene: Scene) -> None:
        self._scene, self._state = scene, list[object]()
        self._rows: dict[int, dict[str, Any]] = {}

    def facts(self, number: int) -> list[tuple[str, str]]:
        """Names and values for people to read."""
        found = [self._scene.export / name for name in FILES if (self._scene.export / name).exists()]
        state: list[object] = [(file, file.stat().st_mtime_ns) for file in (*found, self._scene.labelled)]
        if state != self._state:
            self._rows, self._state = self._read(found), state
        row = self._rows.get(number)
        if row is None:
            return [("", MISSING)]
        shown = [(name, form, row.get(key)) for key, (name, form) in ROWS.items()]
        return [(name, form.format(value)) for name, form, value in shown if value not in (None, "")]

    def _read(self, files: list[Path]) -> dict[int, dict[str, Any]]:
        """The rows of the file that was made from the labels as they are; empty if there is none."""
        for file in files:
            try:
                record: Any = read_json(sidecar(file), MAX_SIDECAR)
                if record["inputs"][self._scene.labelled.name] != digest(self._scene.labelled):
                    continue
                content: Any = read_json(file)
                rows = [feature["properties"] for feature in content["features"]]
                return {int(row["instance"]): row for row in rows if row["instance"]}
            except (InputError, KeyError, TypeError, ValueError):
                continue
        return {}
