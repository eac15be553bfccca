"""Photos in tiles: the joining rules against brute force, and against an oracle that knows all objects."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from scipy import ndimage

from sc3d.segmentation.instances import Areas, Instance, drop_duplicates
from sc3d.segmentation.rle import Window, fill_runs, find_runs, iou, join_runs
from sc3d.segmentation.tiled_inference import (
    Findings,
    TiledObject,
    join_looks,
    join_tiles,
    list_tiles,
    segment_tiled,
)
from tests.builders import instance_of


def _unpack(instance: Instance) -> np.ndarray:
    whole = np.zeros(instance.size, bool)
    mask, window = fill_runs(instance.runs, instance.size[0])
    whole[window.top : window.bottom, window.left : window.right] = mask
    return whole


# ---- windows


@pytest.mark.parametrize(
    ("width", "height", "tile", "overlap"),
    [(5472, 3648, 1600, 0.2), (1601, 900, 1600, 0.2), (300, 1000, 100, 0.75), (101, 101, 100, 0.01)],
)
def test_tiles_cover_the_photo_and_overlap(width, height, tile, overlap):
    windows = list_tiles(width, height, tile, overlap)
    seen = np.zeros((height, width), np.uint8)
    for window in windows:
        assert (window.right - window.left, window.bottom - window.top) == (
            min(tile, width),
            min(tile, height),
        )
        assert Window(0, 0, width, height).holds(window)
        seen[window.top : window.bottom, window.left : window.right] += 1
    assert seen.all() and len(set(windows)) == len(windows)
    for axis in (0, 1):  # two neighbors share at least the wanted strip
        starts = sorted({window[axis] for window in windows})
        assert all(
            tile - (second - first) >= int(tile * overlap)
            for first, second in zip(starts, starts[1:], strict=False)
        )


def test_small_photos_are_seen_once():
    assert list_tiles(1600, 1200, 1600, 0.2) == list_tiles(9000, 9000, 0, 0.2) == []


# ---- an oracle


def _site(seed: int, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A label image as a photo whose color is the number of the object, 4-connected and of any form; class
    and score per number; 0 = nothing.
    """
    random = np.random.default_rng(seed)
    relief = ndimage.gaussian_filter(random.normal(size=shape), random.choice([4, 6, 10]))
    objects = np.zeros(shape, np.int32)
    for level in np.unique(bands := np.digitize(relief, np.quantile(relief, [0.2, 0.5, 0.6, 0.9]))):
        if level != 1:
            found, number = ndimage.label(bands == level)
            objects = np.where(found > 0, found + objects.max(), objects)
    number = objects.max()
    image = np.stack([objects & 255, objects >> 8, np.zeros_like(objects)], axis=-1).astype(np.uint8)
    return (
        image,
        np.concatenate([[0], random.integers(1, 4, number)]),
        np.concatenate([[0], random.choice([0.3, 0.6, 0.9], number)]),
    )


class _Oracle:
    """Finds every object of the image it is shown, perfectly; `blind`: but nothing in a whole photo."""

    def __init__(
        self, classes: np.ndarray, scores: np.ndarray, blind: tuple[int, ...] = (), areas: bool = False
    ) -> None:
        self.classes, self.scores, self.blind, self.areas, self.num_looks = classes, scores, blind, areas, 0

    def __call__(self, image: np.ndarray) -> Findings:
        self.num_looks += 1
        objects = image[..., 0] + 256 * image[..., 1].astype(np.int32)
        numbers = [] if image.shape[:2] == self.blind else np.unique(objects[objects > 0])
        found = [
            instance_of(objects == number, int(self.classes[number]), self.scores[number], 0.7, f"{number}")
            for number in numbers
        ]
        objects = np.where(np.isin(objects, numbers), objects, 0)
        known = Areas(
            self.classes[objects].astype(np.uint8), np.rint(100 * self.scores[objects]).astype(np.uint8)
        )
        return Findings(found, known if self.areas else None)


def _assert_equal(first, second) -> None:
    np.testing.assert_array_equal(first.labels, second.labels)
    np.testing.assert_array_equal(first.confidence, second.confidence)
    assert len(first.instances) == len(second.instances) > 5
    for one, other in zip(first.instances, second.instances, strict=True):
        assert (one.prompt, one.class_id, one.box_score, one.mask_score, one.size) == (
            other.prompt,
            other.class_id,
            other.box_score,
            other.mask_score,
            other.size,
        )
        np.testing.assert_array_equal(one.runs, other.runs)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("tile", "overlap"), [(40, 0.2), (55, 0.02), (45, 0.6)])
def test_tiled_equals_untiled_for_an_oracle(seed, tile, overlap):
    """Objects cross up to all tiles, wind in and out of them, and touch others of their class; scores are
    often equal.
    """
    shape = (90, 130)
    image, classes, scores = _site(seed, shape)
    expected = segment_tiled(image, _Oracle(classes, scores), 0, overlap)
    assert (expected.labels == classes[image[..., 0] + 256 * image[..., 1].astype(int)]).all()
    _assert_equal(segment_tiled(image, oracle := _Oracle(classes, scores), tile, overlap), expected)
    assert oracle.num_looks == 1 + len(list_tiles(130, 90, tile, overlap)) > 6
    # the same if the shrunk photo shows nothing, so that all objects are put together from tiles
    _assert_equal(segment_tiled(image, _Oracle(classes, scores, blind=shape), tile, overlap), expected)


@pytest.mark.parametrize("blind", [(), (130, 210)])
def test_areas_of_an_oracle_fill_what_no_instance_claims(blind):
    image, classes, scores = _site(3, (130, 210))
    oracle = _Oracle(classes, scores, blind, areas=True)
    result = segment_tiled(image, lambda shown: Findings([], oracle(shown).areas), 64, 0.2)
    objects = image[..., 0] + 256 * image[..., 1].astype(int)
    assert (
        (result.labels == classes[objects]).all()
        and (result.confidence == np.rint(100 * scores[objects])).all()
        and result.instances == ()
    )


def test_small_objects_come_from_tiles_and_large_outlines_are_refined():
    """The whole photo shows objects in blocks of 8 px and none below 300 px; tiles show them as they are."""
    image, classes, scores = _site(1, (128, 208))

    def find(shown: np.ndarray) -> Findings:
        if shown.shape[:2] != image.shape[:2]:
            return _Oracle(classes, scores)(shown)
        blocks = np.kron(shown[4::8, 4::8], np.ones((8, 8, 1), np.uint8))
        return Findings(
            [found for found in _Oracle(classes, scores * 0.9)(blocks).instances if found.area > 300]
        )

    tiled, truth = segment_tiled(image, find, 72, 0.2), segment_tiled(image, _Oracle(classes, scores), 0, 0.2)
    coarse = segment_tiled(image, find, 0, 0.2)
    wrong, wrong_coarse = ((result.labels != truth.labels).mean() for result in (tiled, coarse))
    # what is left: blocks that are no object's, by half of the union
    assert wrong_coarse > 0.1 and wrong < wrong_coarse / 50
    assert {one.prompt for one in truth.instances} <= {one.prompt for one in tiled.instances} and len(
        coarse.instances
    ) < len(truth.instances) / 2


def test_memory_does_not_grow_with_the_number_of_objects():
    """A photo of 20 megapixels with 400 trees, of which 40 bool masks would take 800 MB."""
    shape = (3648, 5472)
    disc = np.hypot(*np.indices((121, 121)) - 60) < 60
    grid = np.stack(np.meshgrid(np.arange(20) * 170, np.arange(20) * 260, indexing="ij"), axis=-1).reshape(
        -1, 2
    )
    corners = grid + np.random.default_rng(0).integers(0, 100, grid.shape)  # some overlap, but not by half
    trees = [
        Instance(find_runs(disc, shape[0], int(top), int(left)), shape, 1, 0.5, 0.5) for top, left in corners
    ]
    tracemalloc.start()
    result = segment_tiled(
        np.zeros((*shape, 3), np.uint8),
        lambda image: Findings(trees if image.shape[:2] == shape else []),
        1600,
        0.2,
    )
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    # the photo, labels, confidence, one tile, runs
    assert peak < 60e6 + 2.1 * shape[0] * shape[1] + 3 * 1600 * 1600
    expected = np.zeros(shape, bool)
    for top, left in corners:
        expected[top : top + 121, left : left + 121] |= disc
    assert ((result.labels == 1) == expected).all() and len(result.instances) == 400


# ---- the rules, one by one and against brute force


def _box(
    window: tuple[int, int, int, int],
    score: float = 0.5,
    class_id: int = 1,
    size: tuple[int, int] = (100, 180),
) -> Instance:
    mask = np.zeros(size, bool)
    mask[window[1] : window[3], window[0] : window[2]] = True
    return instance_of(mask, class_id, score, 1.0)


TWO = [Window(0, 0, 100, 100), Window(80, 0, 180, 100)]


@pytest.mark.parametrize(
    ("first", "second", "expected"),
    [
        ((50, 10, 100, 30), (80, 10, 150, 30), [(50, 10, 150, 30)]),  # cut by both borders: joined
        ((50, 10, 100, 30), (80, 12, 150, 34), [(50, 10, 150, 34)]),  # roughly the same in the strip: joined
        # different in the strip: two, each seen by its tile alone
        ((50, 10, 100, 30), (80, 25, 150, 45), [(50, 10, 100, 30), (80, 25, 150, 45)]),
        # a fragment of what the other tile sees whole
        ((85, 10, 100, 30), (85, 10, 130, 30), [(85, 10, 130, 30)]),
        # a fragment that the other tile, which sees all of it, does not confirm
        ((85, 10, 100, 30), None, []),
        ((85, 10, 99, 30), None, [(85, 10, 99, 30)]),  # ends before the border: whole, hence kept
        ((70, 10, 100, 30), None, [(70, 10, 100, 30)]),  # cut, but no other tile sees all of it
        ((85, 0, 99, 30), None, [(85, 0, 99, 30)]),  # at the photo's own border
    ],
)
def test_parts_are_joined_kept_or_dropped(first, second, expected):
    found = [[_box(first)], [] if second is None else [_box(second)]]
    objects = join_tiles(found, TWO)
    assert sorted(tuple(found.instance.window) for found in objects) == expected
    if len(objects) == 1 and second is not None:
        assert objects[0].windows == frozenset(TWO) and objects[0].instance.area == sum(
            part.area for part in (*found[0], *found[1])
        ) - round(_common_area(*found[0], *found[1]))
    other_class = join_tiles([[_box(first)], [] if second is None else [_box(second, class_id=2)]], TWO)
    assert all(len(found.windows) == 1 for found in other_class)


def _common_area(first: Instance, second: Instance) -> float:
    share = iou(first.runs, second.runs, first.size[0])
    return share * (first.area + second.area) / (1 + share)


def test_the_largest_part_gives_the_scores():
    (joined,) = join_tiles([[_box((50, 10, 100, 30), 0.9)], [_box((80, 10, 170, 30), 0.4)]], TWO)
    assert joined.instance.box_score == 0.4


def test_the_better_look_gives_the_scores_and_tiles_the_outline():
    whole, tiled = _box((40, 10, 170, 40), 0.8), _box((40, 12, 100, 38), 0.6)
    (joined,) = join_looks([whole], [TiledObject(_box((40, 12, 150, 38), 0.6), frozenset([TWO[0]]))])
    assert joined.box_score == 0.8 and joined.window == (40, 10, 170, 40)
    expected = join_runs([tiled.runs, _box((100, 10, 170, 40)).runs, _box((40, 12, 150, 38)).runs], 100)
    np.testing.assert_array_equal(joined.runs, expected)
    # less than half in common: two objects
    assert len(join_looks([whole], [TiledObject(tiled, frozenset([TWO[0]]))])) == 2


def test_joining_tiles_equals_brute_force():
    """Rules 3 and 4 written down with pixels and repeated merging, on random boxes in four tiles."""
    windows, size = list_tiles(40, 40, 24, 0.3), (40, 40)
    assert len(windows) == 4
    random, num_joined, num_dropped = np.random.default_rng(5), 0, 0
    for _ in range(60):
        found = [
            [_random_box(random, window, size) for _ in range(int(random.integers(0, 7)))]
            for window in windows
        ]
        objects = join_tiles(found, windows)
        groups = _groups_slowly(found, windows)
        assert sorted(_describe(found.instance, found.windows) for found in objects) == sorted(
            map(_join_slowly, groups)
        )
        num_joined += sum(len(found.windows) > 1 for found in objects)
        num_dropped += sum(map(len, found)) - sum(map(len, groups))
    assert num_joined > 30 and num_dropped > 30


def _random_box(random: np.random.Generator, window: Window, size: tuple[int, int]) -> Instance:
    left, top = random.integers(0, 12, 2) * 3  # on a coarse grid, so that parts fit often
    width, height = random.integers(1, 6, 2) * 5
    box = Window(int(left), int(top), int(left + width), int(top + height)).common(window)
    return (
        _random_box(random, window, size)
        if box.empty
        else _box(box, float(random.random()), int(random.integers(1, 3)), size)
    )


def _describe(instance: Instance, windows: frozenset) -> tuple:
    return instance.class_id, _unpack(instance).tobytes(), instance.box_score, sorted(windows)


def _groups_slowly(
    found: list[list[Instance]], windows: list[Window]
) -> list[list[tuple[Instance, Window, np.ndarray]]]:
    parts = [
        (instance, window, _unpack(instance))
        for instances, window in zip(found, windows, strict=True)
        for instance in instances
    ]

    def same(one, other) -> bool:
        strip = _inside(one[1]) & _inside(other[1])
        first, second = one[2] & strip, other[2] & strip
        return (
            one[1] != other[1]
            and one[0].class_id == other[0].class_id
            and 2 * (first & second).sum() > (first | second).sum()
        )

    groups = [[part] for part in parts]
    while True:
        pair = next(
            (
                (one, other)
                for one in groups
                for other in groups
                if one is not other and any(same(a, b) for a in one for b in other)
            ),
            None,
        )
        if pair is None:
            break
        groups = [group for group in groups if group is not pair[1]]
        pair[0].extend(pair[1])
    return [group for group in groups if len(group) > 1 or not _fragment(*group[0], windows)]


def _inside(window: Window) -> np.ndarray:
    rows, columns = np.indices((40, 40))
    return (rows >= window.top) & (rows < window.bottom) & (columns >= window.left) & (columns < window.right)


def _fragment(_: Instance, own: Window, mask: np.ndarray, windows: list[Window]) -> bool:
    beyond = ndimage.binary_dilation(_inside(own)) & ~_inside(own)  # photo pixels just outside the tile
    cut = (ndimage.binary_dilation(mask) & beyond).any()
    return bool(cut) and any(not (mask & ~_inside(other)).any() for other in windows if other != own)


def _join_slowly(group: list[tuple[Instance, Window, np.ndarray]]) -> tuple:
    masks = [mask for _, _, mask in group]
    largest = min(group, key=lambda part: (-part[2].sum(), -part[0].score, part[1].top, part[1].left))[0]
    return (
        largest.class_id,
        np.logical_or.reduce(masks).tobytes(),
        largest.box_score,
        sorted({window for _, window, _ in group}),
    )


def test_duplicates_in_one_look():
    best, same, other_class, apart, half = (
        _box((0, 0, 20, 20), 0.9),
        _box((0, 0, 20, 19), 0.8),
        _box((0, 0, 20, 20), 0.7, class_id=2),
        _box((60, 0, 80, 20), 0.6),
        _box((0, 0, 10, 20), 0.5),
    )
    for order in ([0, 1, 2, 3, 4], [4, 3, 2, 1, 0], [1, 4, 0, 3, 2]):
        kept = drop_duplicates([(best, same, other_class, apart, half)[number] for number in order])
        assert kept == [best, other_class, apart, half]  # exactly half of the union is not more than half
    assert (
        drop_duplicates(
            [
                _box((0, 0, 5, 5), 0.0),
                _box((0, 0, 5, 5), float("nan")),
                Instance(np.zeros((0, 2), np.int64), (100, 180), 1, 1.0, 1.0),
            ]
        )
        == []
    )
