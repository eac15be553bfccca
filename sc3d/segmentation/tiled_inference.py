"""Large photos in overlapping tiles: the whole photo for what is large, tiles for what is small, one set of
objects out of both.

1. The photo is looked at as a whole (the model shrinks it), and in tiles of equal size that overlap and are
   spread evenly.
2. In each look, of two instances of one class that are the same object (more than half of their union in
   common) the better stays.
3. Instances of one class in two tiles are parts of one object if, in the strip that both tiles see, they have
   more than half of their union in common. Parts are joined, over as many tiles as it takes; the object has
   the scores and the prompt of its largest part.
4. A part that ends at a tile's border (not the photo's), has no partner, and lies where another tile sees all
   of it, is dropped: it is a fragment that the tile with the better view did not confirm. One that no other
   tile sees in full is kept.
5. An object found both in tiles and in the whole photo (again by half of the union) has the tiles' finer
   outline inside the tiles in which it was found, the whole photo's elsewhere, and the better of the two
   scores.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from itertools import combinations
from typing import NamedTuple

import numpy as np

from sc3d.io.progress import progress
from sc3d.segmentation.instances import (
    SAME_OBJECT,
    Areas,
    Instance,
    candidates,
    drop_duplicates,
    fill_gaps,
    merge_instances,
    move,
    paint_areas,
    useful,
)
from sc3d.segmentation.rle import Window, clip_runs, cut_runs, iou, join_runs
from sc3d.segmentation.segment import Segmentation


class Findings(NamedTuple):
    """What a model finds in one look at an image: instances in its pixels; what it says of every pixel, if it
    does.
    """

    instances: list[Instance]
    areas: Areas | None = None


class TiledObject(NamedTuple):
    """An object found in tiles, in pixels of the photo, and the tiles it was found in."""

    instance: Instance
    windows: frozenset[Window]


def segment_tiled(
    image: np.ndarray, find: Callable[[np.ndarray], Findings], tile: int, overlap: float
) -> Segmentation:
    """Segment a photo as a whole and, if it is larger than `tile`, in tiles.

    image: (H, W, 3) uint8 RGB
    find: looks at one image
    tile: side of a tile, px; 0 = no tiles
    overlap: share of a tile that it has in common with the next, above 0
    """
    shape = image.shape[:2]
    windows = list_tiles(shape[1], shape[0], tile, overlap)
    found = find(image)
    whole, areas, parts = drop_duplicates(found.instances), found.areas, []
    for window in progress(windows, "tiles", "tile", bar=bool(windows), leave=False):
        found = find(np.ascontiguousarray(image[window.top : window.bottom, window.left : window.right]))
        parts.append([move(instance, window, shape) for instance in drop_duplicates(found.instances)])
        if areas is not None and found.areas is not None:
            paint_areas(areas, found.areas, window)
    instances = useful(join_looks(whole, join_tiles(parts, windows)))
    labels, confidence = merge_instances(instances, shape)
    if areas is not None:
        fill_gaps(labels, confidence, areas)
    return Segmentation(labels, confidence, tuple(instances))


def list_tiles(width: int, height: int, tile: int, overlap: float) -> list[Window]:
    """Windows of equal size that cover a photo row by row; none if the photo is no larger than a tile, or
    `tile` is 0.
    """
    if not tile or max(width, height) <= tile:
        return []
    across, down = _starts(width, tile, overlap), _starts(height, tile, overlap)
    return [
        Window(left, top, min(left + tile, width), min(top + tile, height)) for top in down for left in across
    ]


def _starts(length: int, tile: int, overlap: float) -> list[int]:
    if length <= tile:
        return [0]
    common = max(1, round(tile * overlap))
    number = math.ceil((length - common) / (tile - common))
    return [round(place) for place in np.linspace(0, length - tile, number)]


def join_tiles(found: list[list[Instance]], windows: list[Window]) -> list[TiledObject]:
    """Objects from the instances of each tile, in pixels of the photo, by rules 3 and 4."""
    parts = [(tile, instance) for tile, instances in enumerate(found) for instance in instances]
    first = np.cumsum([0, *map(len, found)])
    group, linked = list(range(len(parts))), set[int]()

    def root(number: int) -> int:
        while group[number] != number:
            number = group[number]
        return number

    for one, other in combinations(range(len(windows)), 2):
        for row, column in _partners(found[one], found[other], windows[one].common(windows[other])):
            pair = int(first[one]) + row, int(first[other]) + column
            linked.update(pair)
            roots = sorted(map(root, pair))
            group[roots[1]] = roots[0]
    objects: dict[int, list[tuple[int, Instance]]] = {}
    for number, (tile, instance) in enumerate(parts):
        if number in linked or not _unconfirmed(instance, tile, windows):
            objects.setdefault(root(number), []).append((tile, instance))
    return [_join(members, windows) for members in objects.values()]


def _partners(first: list[Instance], second: list[Instance], strip: Window) -> list[tuple[int, int]]:
    """Numbers of the instances of two tiles that are parts of one object, judged in the strip that both tiles
    see.
    """
    if strip.empty:
        return []
    numbers, seen = [], []
    for instances in (first, second):
        near = {
            number: instance
            for number, instance in enumerate(instances)
            if not instance.window.common(strip).empty
        }
        clipped = {
            number: replace(instance, runs=clip_runs(instance.runs, instance.size[0], strip))
            for number, instance in near.items()
        }
        numbers.append([number for number, instance in clipped.items() if len(instance.runs)])
        seen.append([clipped[number] for number in numbers[-1]])
    pairs = [(one, other) for one, other in candidates(*seen) if _same(seen[0][one], seen[1][other])]
    return [(numbers[0][one], numbers[1][other]) for one, other in pairs]


def _same(first: Instance, second: Instance) -> bool:
    return iou(first.runs, second.runs, first.size[0]) > SAME_OBJECT


def _unconfirmed(instance: Instance, tile: int, windows: list[Window]) -> bool:
    """Whether a part without partner ends at an inner border of its tile, and another tile sees all of it."""
    (height, width), box, own = instance.size, instance.window, windows[tile]
    cut = (
        (box.left == own.left > 0)
        or (box.top == own.top > 0)
        or (box.right == own.right < width)
        or (box.bottom == own.bottom < height)
    )
    return cut and any(window.holds(box) for number, window in enumerate(windows) if number != tile)


def _join(members: list[tuple[int, Instance]], windows: list[Window]) -> TiledObject:
    """One object of its parts, each with the number of its tile."""
    _, largest = min(members, key=lambda member: (-member[1].area, -member[1].score, member[0]))
    runs = join_runs([instance.runs for _, instance in members], largest.size[0])
    return TiledObject(replace(largest, runs=runs), frozenset(windows[tile] for tile, _ in members))


def join_looks(whole: list[Instance], tiled: list[TiledObject]) -> list[Instance]:
    """Objects from the instances of the whole photo and the objects of the tiles, by rule 5; each is joined
    with one other at most, the nearest.
    """
    objects = [found.instance for found in tiled]
    nearness = [
        (-iou(whole[first].runs, objects[second].runs, whole[first].size[0]), first, second)
        for first, second in candidates(whole, objects)
    ]
    joined: list[Instance] = []
    used: tuple[set[int], set[int]] = set(), set()
    for _, first, second in sorted(pair for pair in nearness if -pair[0] > SAME_OBJECT):
        if first not in used[0] and second not in used[1]:
            used[0].add(first)
            used[1].add(second)
            joined.append(_refine(whole[first], tiled[second]))
    joined += [instance for number, instance in enumerate(whole) if number not in used[0]]
    return joined + [instance for number, instance in enumerate(objects) if number not in used[1]]


def _refine(instance: Instance, found: TiledObject) -> Instance:
    """The tiles' outline in the tiles, the whole photo's elsewhere, and the better scores."""
    coarse = instance.runs
    for window in found.windows:
        coarse = cut_runs(coarse, instance.size[0], window)
    better = max(instance, found.instance, key=lambda other: other.score)
    return replace(better, runs=join_runs([coarse, found.instance.runs], instance.size[0]))
