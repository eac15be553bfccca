"""Which photos are labelled and which are judged, and a small site on which three labelled photos are enough."""

import numpy as np
import pytest

from sc3d.errors import InputError
from sc3d.scene.scene import Scene
from tests.builders import views, write_bare_scene
from tools.benchmark.few_labels import GIVEN, HAND, PLAIN, folds_of, measure, page
from tools.benchmark.settings import BenchmarkFewLabels


def test_labelled_and_judged_photos_are_spread_and_apart():
    names = [f"{row:02d}" for row in range(40)]
    (fold,) = folds_of(names, 3, 7, 1)
    rows = [[int(name) for name in part] for part in (fold.labelled, fold.judged)]
    assert [len(part) for part in rows] == [3, 7] and not set(rows[0]) & set(rows[1])
    assert np.diff(rows[0]).min() >= 12 and np.diff(rows[1]).min() >= 5
    assert [fold.judged for fold in folds_of(names[:4], 3, 1, 4)] == [("00",), ("01",), ("02",), ("03",)]
    assert all(set(fold.labelled + fold.judged) == set(names[:4]) for fold in folds_of(names[:4], 3, 1, 4))
    with pytest.raises(InputError, match="5 photos have truth, too few for 3"):
        folds_of(names[:5], 3, 7, 1)


def test_a_flat_site_is_labelled_from_three_photos(tmp_path):
    scene = Scene(write_bare_scene(tmp_path / "scene"))
    command = BenchmarkFewLabels((scene.path,), judged=2)
    found = measure(scene, command)
    assert list(found) == [HAND, PLAIN, GIVEN] and len(views()) == 5
    assert all(part.accuracy > 0.97 for part in found.values())
    text = page({"flat": {name: part.summary(scene.class_table()) for name, part in found.items()}})
    assert text.startswith("| site | masks | OA | mIoU | road | grass |") and "| flat | given masks |" in text
