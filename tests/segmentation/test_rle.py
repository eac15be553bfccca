"""Masks as runs against bool arrays; COCO run-length encoding and the instance file against pycocotools."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy import ndimage

from sc3d.scene.class_table import parse_classes
from sc3d.segmentation.instances import write_instances
from sc3d.segmentation.rle import (
    Window,
    area,
    bounds,
    clip_runs,
    cut_runs,
    encode_runs,
    fill_runs,
    find_runs,
    iou,
    join_runs,
    move_runs,
)
from tests.builders import instance_of


def _random_masks(number: int):
    random = np.random.default_rng(7)
    for _ in range(number):
        shape = tuple(int(side) for side in random.integers(1, 14, 2))
        yield random, random.random(shape) < random.choice([0.0, 0.1, 0.5, 0.9, 1.0])


def _unpack(runs: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    flat = np.zeros(shape[0] * shape[1], bool)
    for first, last in runs:
        flat[first:last] = True
    return flat.reshape(shape[1], shape[0]).T


def test_runs_equal_masks_in_every_operation():
    for random, mask in _random_masks(300):
        height, width = mask.shape
        other = random.random(mask.shape) < 0.5
        runs, other_runs = find_runs(mask, height), find_runs(other, height)
        np.testing.assert_array_equal(_unpack(runs, mask.shape), mask)
        assert (runs[:, 0] // height == (runs[:, 1] - 1) // height).all() and area(runs) == mask.sum()
        left, right = np.sort(random.integers(0, width + 1, 2))
        top, bottom = np.sort(random.integers(0, height + 1, 2))
        window, inside = Window(int(left), int(top), int(right), int(bottom)), np.zeros(mask.shape, bool)
        inside[top:bottom, left:right] = True
        # one form per mask: equal masks have equal runs, however they came about
        np.testing.assert_array_equal(clip_runs(runs, height, window), find_runs(mask & inside, height))
        np.testing.assert_array_equal(cut_runs(runs, height, window), find_runs(mask & ~inside, height))
        np.testing.assert_array_equal(join_runs([runs, other_runs], height), find_runs(mask | other, height))
        union = (mask | other).sum()
        assert iou(runs, other_runs, height) == ((mask & other).sum() / union if union else 0)
        crop = mask[top:bottom, left:right]
        np.testing.assert_array_equal(
            find_runs(crop, height, int(top), int(left)), find_runs(mask & inside, height)
        )
        np.testing.assert_array_equal(
            move_runs(
                find_runs(crop, max(1, bottom - top)), max(1, bottom - top), height, int(top), int(left)
            ),
            find_runs(mask & inside, height),
        )
        if mask.any():
            filled, box = fill_runs(runs, height)
            rows, columns = np.nonzero(mask)
            assert (
                box == bounds(runs, height) == (columns.min(), rows.min(), columns.max() + 1, rows.max() + 1)
            )
            np.testing.assert_array_equal(filled, mask[box.top : box.bottom, box.left : box.right])


def test_coco_encoding_equals_pycocotools():
    coco = pytest.importorskip("pycocotools.mask")
    masks = [mask for _, mask in _random_masks(300)]
    # long runs: up to 5 digits
    masks += [
        np.indices((2000, 1500)).sum(axis=0) // 700 % 2 == 0,
        np.ones((3000, 1), bool),
        np.zeros((1, 3000), bool),
    ]
    for mask in masks:
        expected = coco.encode(np.asfortranarray(mask.astype(np.uint8)))
        assert encode_runs(find_runs(mask, mask.shape[0]), mask.shape) == expected["counts"].decode()


def test_instance_file_is_coco(tmp_path):
    coco_module = pytest.importorskip("pycocotools.coco")
    random = np.random.default_rng(0)
    masks = [ndimage.gaussian_filter(random.random((40, 60)), 4) > 0.5 for _ in range(3)]
    table = parse_classes(
        [{"id": 2, "name": "road", "color": [0, 0, 0]}, {"id": 9, "name": "tree", "color": [0, 0, 0]}], "test"
    )
    instances = tuple(
        instance_of(mask, class_id, 0.5, 0.25, "big tree")
        for mask, class_id in zip(masks, (9, 2, 9), strict=True)
    )
    write_instances(tmp_path / "a.json", "a.jpg", (40, 60), instances, table)
    data = coco_module.COCO(str(tmp_path / "a.json"))
    assert data.getCatIds(catNms=["tree"]) == [9] and data.loadImgs(1)[0] == {
        "id": 1,
        "file_name": "a.jpg",
        "width": 60,
        "height": 40,
    }
    assert [data.cats[annotation["category_id"]]["name"] for annotation in data.anns.values()] == [
        "tree",
        "road",
        "tree",
    ]
    for mask, annotation in zip(masks, data.anns.values(), strict=True):
        np.testing.assert_array_equal(data.annToMask(annotation), mask)
        rows, columns = np.nonzero(mask)
        assert (
            annotation["bbox"] == [columns.min(), rows.min(), np.ptp(columns) + 1, np.ptp(rows) + 1]
            and annotation["area"] == mask.sum()
        )
        assert (annotation["score"], annotation["box_score"], annotation["mask_score"]) == (0.125, 0.5, 0.25)
        assert (
            annotation["prompt"] == "big tree"
            and annotation["name"] == data.cats[annotation["category_id"]]["name"]
        )
    write_instances(tmp_path / "none.json", "a.jpg", (40, 60), (), table)
    assert json.loads((tmp_path / "none.json").read_text())["annotations"] == []
