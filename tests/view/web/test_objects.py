"""An object is clicked in headless Chromium: its row is shown and its points are marked."""

from __future__ import annotations

import json

import numpy as np
import open3d as o3d
import pytest

from sc3d.geometry.cameras import project
from sc3d.io.clouds import read_cloud, write_geometry
from sc3d.io.provenance import digest
from sc3d.runner import sidecar
from sc3d.scene.scene import Scene
from sc3d.view.catalog import MISSING, Catalog
from sc3d.view.picking import Inspector
from tests.builders import ORIGIN, ground, labelled_scene
from tests.view.web.test_corrections import ready
from tests.view.web.test_page import Visit, browser, home_of, in_canvas, visit  # noqa: F401

ROW = {
    "area_m2": 31.25,
    "height_m": 4.5,
    "volume_m3": 140.6,
    "confidence": 0.875,
    "best_photo": "photo_4.jpg",
}
YELLOW = [255, 220, 0]


@pytest.fixture
def scene(tmp_path) -> Scene:
    """The road in the west is object 7; the grass is none."""
    found = labelled_scene(tmp_path / "scene")
    cloud = read_cloud(found.labelled)
    instance = np.where(ground()[:, 0] < ORIGIN[0], 7, 0).astype(np.uint32)
    cloud.point["instance"] = o3d.core.Tensor(instance[:, None])
    write_geometry(found.labelled, cloud)
    write_catalog(found)
    return found


def write_catalog(scene: Scene) -> None:
    file = scene.export / "objects_local.geojson"
    file.parent.mkdir(exist_ok=True)
    features = [{"type": "Feature", "id": 7, "properties": {"id": 7, "instance": 7, **ROW}}]
    file.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    sidecar(file).write_text(json.dumps({"inputs": {"labelled.ply": digest(scene.labelled)}}))


def test_rows_of_other_labels_are_not_shown(scene):
    """A catalog that was made from labels that have changed since says nothing."""
    catalog = Catalog(scene)
    assert dict(catalog.facts(7)) == {
        "area": "31.2 m²",
        "height": "4.5 m above the ground",
        "volume": "141 m³",
        "mean confidence": "0.88",
        "best photo": "photo_4.jpg",
    }
    assert catalog.facts(8) == [("", MISSING)]
    cloud = read_cloud(scene.labelled)
    cloud.point["label"][0] = 3 - cloud.point["label"][0].item() + 1
    write_geometry(scene.labelled, cloud)
    assert catalog.facts(7) == [("", MISSING)]
    write_catalog(scene)
    assert catalog.facts(7)[0] == ("area", "31.2 m²")


def test_a_clicked_object_shows_its_row(scene, browser):  # noqa: F811
    from sc3d.view.web.page import WebView, serving

    inspector = Inspector.from_scene(scene, read_cloud(scene.labelled), scene.model.views)
    with serving(WebView(scene, inspector)) as address, visit(browser, address) as found:
        ready(found)
        click(found, scene, -2.0, -2.0)
        found.wait_for(lambda: facts(found).get("object") == "7", "the object")
        assert facts(found)["area"] == "31.2 m²" and facts(found)["best photo"] == "photo_4.jpg"
        found.wait_for(lambda: found.share(YELLOW) > 0.02, "its points to be marked")
        click(found, scene, 2.5, -1.0)
        found.wait_for(lambda: facts(found).get("object") == "none", "no object")
        found.wait_for(lambda: found.share(YELLOW) == 0, "the mark to go")
        assert "area" not in facts(found) and found.errors == []


def click(found: Visit, scene: Scene, x: float, y: float) -> None:
    """Ctrl + click on a point of the ground, seen from where the page starts."""
    home, display = home_of(scene)
    window, corner = in_canvas(found.page, home)
    found.page.keyboard.down("Control")
    found.page.mouse.click(*(corner + project(window, ORIGIN + [[x, y, 0]] - display.origin)[0][0]))
    found.page.keyboard.up("Control")


def facts(found: Visit) -> dict[str, str]:
    """What the panel says of the point; rows that are being replaced have no cells."""
    rows = [row.locator("td").all_inner_texts() for row in found.page.locator("tr").all()]
    return dict(cells for cells in rows if len(cells) == 2)
