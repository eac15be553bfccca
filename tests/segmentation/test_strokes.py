"""Masks from strokes: files, features, filter, classifier and the whole backend on painted textures."""

import json
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest
from PIL import Image
from sklearn.ensemble import ExtraTreesClassifier

from sc3d.cli import main
from sc3d.errors import InputError
from sc3d.scene.class_table import parse_classes
from sc3d.scene.site_model import ModelPart, read_model, write_model
from sc3d.segmentation.strokes.backend import Strokes, StrokesSettings, assign_folds, sample_pixels
from sc3d.segmentation.strokes.features import pixel_features
from sc3d.segmentation.strokes.files import NOTHING, PhotoStrokes, StrokeShape, parse_shapes, read_strokes
from sc3d.segmentation.strokes.forest import Forest
from sc3d.segmentation.strokes.guided_filter import fit_lines
from sc3d.segmentation.strokes.model_file import from_part, to_part
from sc3d.segmentation.strokes.novelty import fit_novelty
from sc3d.segmentation.strokes.pixel_classifier import best_temperature
from sc3d.settings.labels import Segment

pytestmark = pytest.mark.usefixtures("one_thread")
CLASSES = [
    {"id": 1, "name": "road", "color": [150, 150, 160]},
    {"id": 2, "name": "tree", "color": [40, 150, 60]},
    {"id": 7, "name": "grass", "color": [170, 220, 110]},
]
TABLE = parse_classes(CLASSES, "test")
SIZE = (240, 160)
QUICK = StrokesSettings(members=2, trees=10, steps=120)


def truth() -> np.ndarray:
    """Left third road, a round crown on the lawn that is the rest."""
    label = np.full(SIZE[::-1], 7, np.uint8)
    label[:, :80] = 1
    return cv2.circle(label, (170, 80), 40, 2, -1)


def photo(seed: int, label: np.ndarray | None = None) -> np.ndarray:
    """A photo of `truth`: flat gray, smooth green, and coarse green of nearly the same mean color."""
    random, label = np.random.default_rng(seed), truth() if label is None else label
    fine, coarse = (
        random.normal(0, 1, (*label.shape, 1)),
        cv2.GaussianBlur(random.normal(0, 1, label.shape), (0, 0), 2.5)[..., None],
    )
    colors = {
        1: [150, 148, 155] + 4 * fine,
        2: [90, 130, 60] + 200 * coarse,
        7: [95, 135, 62] + 5 * fine,
        9: [200, 60, 40] + 5 * fine,
    }
    image = np.zeros((*label.shape, 3))
    for value, color in colors.items():
        image[label == value] = color[label == value]
    return np.clip(image, 0, 255).astype(np.uint8)


def shape(label: str, points: list, kind: str = "linestrip", **more) -> dict:
    return {"label": label, "points": points, "shape_type": kind, **more}


SHAPES = [
    shape("road", [[10, 20], [60, 60]], width=8),
    shape("road", [[20, 140], [60, 100]], width=8),
    shape("road", [[70, 5], [70, 150]], width=6),
    shape("tree", [[150, 60], [180, 60], [180, 80], [150, 80]], "polygon"),
    shape("tree", [[150, 100], [190, 100]], width=10),
    shape("tree", [[170, 50], [200, 80]], width=8),
    shape("grass", [[100, 10], [230, 10]], width=10),
    shape("grass", [[100, 20], [100, 140]], width=10),
    shape("grass", [[225, 60], [225, 150]], width=10),
]


def labelme(shapes: list, **more) -> dict:
    return {
        "version": "5.5.0",
        "imagePath": "a.png",
        "imageWidth": SIZE[0],
        "imageHeight": SIZE[1],
        "imageData": None,
        "shapes": shapes,
    } | more


@pytest.fixture
def scene(tmp_path):
    for folder in ("images", "strokes"):
        (tmp_path / folder).mkdir()
    for seed, name in enumerate(("a", "b")):
        Image.fromarray(photo(seed)).save(tmp_path / "images" / f"{name}.png")
    (tmp_path / "classes.json").write_text(json.dumps(CLASSES))
    (tmp_path / "strokes" / "a.json").write_text(json.dumps(labelme(SHAPES)))
    return tmp_path


def iou(label: np.ndarray, value: int) -> float:
    return float(
        ((label == value) & (truth() == value)).sum() / ((label == value) | (truth() == value)).sum()
    )


def test_command_labels_photos_without_strokes(scene):
    main(["segment", str(scene), "--backend", "strokes"])
    label, confidence = (np.array(Image.open(scene / folder / "b.png")) for folder in ("masks", "confidence"))
    assert label.shape == confidence.shape == SIZE[::-1]
    assert iou(label, 1) > 0.98 and iou(label, 2) > 0.85 and iou(label, 7) > 0.92
    assert (confidence[label == 0] == 0).all() and (confidence[label > 0] >= 127).all()
    right = (label == truth())[label > 0]
    assert confidence[label > 0][right].mean() > confidence[label > 0][~right].mean() + 10


def test_same_seed_same_masks(scene):
    first, second, other = (
        Strokes.fit(scene / "strokes", scene / "images", TABLE, settings).segment(photo(5))
        for settings in (QUICK, QUICK, StrokesSettings(members=2, trees=10, steps=120, seed=1))
    )
    assert np.array_equal(first.labels, second.labels) and np.array_equal(first.confidence, second.confidence)
    assert not np.array_equal(first.confidence, other.confidence)


def test_what_no_stroke_shows_stays_unlabelled_and_background_too(scene):
    label = truth()
    label[100:, :80] = 9  # a red thing
    learned = Strokes.fit(scene / "strokes", scene / "images", TABLE, QUICK)
    found, confidence, _ = learned.segment(photo(3, label))
    assert (found[115:, 5:65] == 0).mean() > 0.95 and (found[20:80, 5:65] == 1).mean() > 0.95
    assert (confidence[found == 0] == 0).all()  # unlike all strokes: nothing is known
    Image.fromarray(photo(1, label)).save(scene / "images" / "b.png")
    red = [
        shape("_background_", [[10, 120], [60, 120]], width=10),
        shape("_background_", [[10, 145], [60, 145]], width=10),
    ]
    (scene / "strokes" / "b.json").write_text(json.dumps(labelme(red, imagePath="b.png")))
    learned = Strokes.fit(scene / "strokes", scene / "images", TABLE, QUICK)
    found = learned.segment(photo(3, label))
    assert (found.labels[110:, 5:70] == 0).mean() > 0.98
    # of the background: looked at, and none of the classes
    assert (found.confidence[115:, 5:65] > 127).mean() > 0.95


def test_large_photos_are_looked_at_small_but_cut_finely(scene):
    settings = StrokesSettings(members=2, trees=10, steps=120, max_size=240)
    learned = Strokes.fit(scene / "strokes", scene / "images", TABLE, settings)
    large = cv2.resize(photo(2), None, fx=4, fy=4, interpolation=cv2.INTER_NEAREST)
    label = learned.segment(large).labels
    assert label.shape == (640, 960)
    edges = [int(np.argmax(row != 1)) for row in label[40:600:40]]
    assert np.abs(np.array(edges) - 320).max() <= 6  # 1.5 px of the reduced photo


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda folder: (folder / "a.json").unlink(), "no strokes in"),
        (
            lambda folder: (folder / "c.json").write_text(json.dumps(labelme(SHAPES, imagePath="c.png"))),
            "belongs to no photo",
        ),
        (lambda folder: (folder / "a.json").write_text(json.dumps(labelme(SHAPES[:6]))), "show no 'grass'"),
        (
            lambda folder: (folder / "a.json").write_text(json.dumps(labelme([shape("roof", [[1, 1]])]))),
            "class 'roof'",
        ),
        (
            lambda folder: (folder / "a.json").write_text(
                json.dumps(labelme([shape("road", [[1, 1]], "polygon")]))
            ),
            "at least 3 points",
        ),
        (
            lambda folder: (folder / "a.json").write_text(
                json.dumps(labelme([shape("road", [[1, float("nan")]])]))
            ),
            "list of [x, y]",
        ),
        (
            lambda folder: (folder / "a.json").write_text(
                json.dumps(labelme([shape("road", [[1, 1]], "cuboid")]))
            ),
            "possible are",
        ),
        (
            lambda folder: (folder / "a.json").write_text(
                json.dumps(labelme(SHAPES, imageWidth=160, imageHeight=240))
            ),
            "aspect",
        ),
        (
            lambda folder: (folder / "a.json").write_text(json.dumps({"imagePath": "a.png"})),
            "no list of shapes",
        ),
        (lambda folder: (folder / "a.json").write_text("{"), "not valid JSON"),
        (lambda folder: Image.new("RGB", SIZE, (1, 2, 3)).save(folder / "b.png"), "color #010203"),
        (lambda folder: Image.new("RGB", (50, 50)).save(folder / "b.png"), "aspect"),
    ],
)
def test_errors_say_what_to_do(scene, capsys, change, words):
    change(scene / "strokes")
    with pytest.raises(SystemExit) as stopped:
        main(["segment", str(scene), "--backend", "strokes"])
    error = capsys.readouterr().err
    assert stopped.value.code == 2 and words in error and error.count("\n") == 1
    assert not (scene / "masks").exists()


def test_shapes_cover_what_geometry_says():
    def covered(kind, points, width=0.0, scale=1):
        labels, groups = PhotoStrokes(
            None, (400, 300), (StrokeShape(5, kind, np.array(points, float), width),)
        ).paint(400 * scale, 300 * scale)
        assert ((labels == 5) == (groups == 1)).all() and set(np.unique(labels)) <= {NOTHING, 5}
        return (labels == 5).sum() / scale**2, np.argwhere(labels == 5).mean(axis=0)[
            ::-1
        ] / scale + 0.5 / scale

    for scale in (1, 2):
        for kind, points, width, area, center in [
            ("polygon", [[50, 50], [250, 50], [250, 150], [50, 150]], 0, 200 * 100, (150, 100)),
            ("rectangle", [[250, 150], [50, 50]], 0, 200 * 100, (150, 100)),
            ("circle", [[200, 150], [200, 50]], 0, np.pi * 100**2, (200, 150)),
            ("linestrip", [[100, 80], [300, 80]], 20, 200 * 20 + np.pi * 100, (200, 80)),
            ("point", [[200, 100]], 30, np.pi * 15**2, (200, 100)),
        ]:
            found, middle = covered(kind, points, width, scale)
            assert abs(found - area) < 0.04 * area + 0.5 * 2 * np.sqrt(np.pi * area), kind
            assert np.abs(middle - center).max() < 0.8, kind


def test_later_shapes_lie_on_top_and_coordinates_follow_the_stated_size():
    shapes = [
        shape("grass", [[0, 0], [120, 0], [120, 80], [0, 80]], "polygon"),
        shape("_background_", [[60, 0], [120, 0], [120, 80], [60, 80]], "polygon"),
    ]
    parsed = parse_shapes(labelme(shapes, imageWidth=120, imageHeight=80), "x", SIZE, TABLE)
    labels, groups = PhotoStrokes(None, SIZE, parsed).paint(*SIZE)
    assert (labels[:, :118] == 7).all() and (labels[:, 122:] == 0).all()
    assert (groups[:, :118] == 1).all() and (groups[:, 122:] == 2).all()


def test_colors_of_a_png_and_json_above_it(scene):
    picture = np.zeros((*SIZE[::-1], 4), np.uint8)
    picture[10:30, 10:30] = [150, 150, 160, 255]
    picture[50:70, 10:13] = [40, 150, 60, 255]
    picture[90:99, 10:30] = [40, 150, 60, 0]  # transparent
    Image.fromarray(picture).save(scene / "strokes" / "a.png")
    (scene / "strokes" / "a.json").write_text(
        json.dumps(labelme([shape("grass", [[20, 0], [20, 160]], width=4)]))
    )
    (drawn,) = read_strokes(scene / "strokes", scene / "images", TABLE)
    labels, groups = drawn.paint(*SIZE)
    assert labels[15, 12] == 1 and labels[60, 11] == 2 and labels[95, 12] == NOTHING and labels[15, 20] == 7
    assert len(np.unique(groups)) == 4  # nothing, two areas, one stroke
    # 3 px wide, less than one pixel of the reduced photo
    assert 2 in drawn.paint(SIZE[0] // 4, SIZE[1] // 4)[0]


def test_features_turn_with_the_photo_and_do_not_know_where_they_are():
    image = photo(0)
    features = pixel_features(image)
    turned = np.rot90(pixel_features(np.ascontiguousarray(np.rot90(image))), -1)
    assert np.allclose(features, turned, atol=2e-2)  # float32 sums of another order
    moved = pixel_features(np.ascontiguousarray(np.roll(image, (20, 30), axis=(0, 1))))[20:, 30:]
    inner = (slice(75, -80), slice(75, -80))
    assert np.allclose(features[:-20, :-30][inner], moved[inner], atol=2e-2)
    for value in (0, 255):
        assert np.isfinite(pixel_features(np.full((40, 50, 3), value, np.uint8))).all()


def test_guided_filter_equals_a_regression_in_every_window():
    random = np.random.default_rng(0)
    guide, plane, radius, smoothing = (
        random.random((14, 15, 3)).astype(np.float32),
        random.random((14, 15)).astype(np.float32),
        2,
        0.02,
    )
    found = next(fit_lines(guide, plane[..., None], radius, smoothing)).apply(guide)
    padded_guide, padded = (
        np.pad(values, [(4, 4), (4, 4)] + [(0, 0)] * (values.ndim - 2), mode="symmetric").astype(np.float64)
        for values in (guide, plane)
    )
    expected = np.zeros((14 + 4, 15 + 4, 4))
    for row in range(2, 2 + 18):
        for column in range(2, 2 + 19):
            window = (slice(row - 2, row + 3), slice(column - 2, column + 3))
            colors, values = padded_guide[window].reshape(-1, 3), padded[window].ravel()
            centered = colors - colors.mean(axis=0)
            slope = np.linalg.solve(
                centered.T @ centered / 25 + smoothing * np.eye(3), centered.T @ values / 25
            )
            expected[row - 2, column - 2] = *slope, values.mean() - slope @ colors.mean(axis=0)
    means = np.stack(
        [expected[row : row + 14, column : column + 15] for row in range(5) for column in range(5)]
    ).mean(axis=0)
    inner = (slice(4, -4), slice(4, -4))  # there both pad alike
    assert np.allclose(
        found[inner], ((means[..., :3] * guide).sum(axis=-1) + means[..., 3])[inner], atol=2e-4
    )


def test_guided_filter_keeps_edges_of_the_photo_only():
    guide = np.zeros((60, 60, 3), np.float32)
    guide[:, 30:] = 0.8
    noisy = (np.random.default_rng(0).random((60, 60)) < np.where(np.arange(60) < 30, 0.2, 0.8)).astype(
        np.float32
    )
    smooth = next(fit_lines(guide, noisy[..., None], 8, 0.01)).apply(guide)
    assert np.abs(smooth[:, :29] - 0.2).max() < 0.2 and np.abs(smooth[:, 31:] - 0.8).max() < 0.2
    assert (smooth[:, 30] - smooth[:, 29]).mean() > 0.5


def test_strokes_are_dealt_out_whole_and_evenly():
    random = np.random.default_rng(0)
    sizes = random.integers(1, 60, 40)
    strokes = np.repeat(np.arange(40), sizes)
    codes = (strokes % 4 == 0).astype(int) + 2 * (strokes == 39)
    folds = assign_folds(strokes, codes, 3)
    assert all(len(np.unique(folds[strokes == name])) == 1 for name in range(40))
    assert (folds[strokes == 39] == -1).all()  # the only one of its class
    for code in (0, 1):
        filled = np.bincount(folds[codes == code], minlength=3)
        assert filled.max() - filled.min() <= sizes.max()


def test_pixels_are_picked_by_size_but_small_strokes_are_kept():
    strokes = np.repeat([1, 2, 3], [100_000, 10_000, 50])
    wanted = np.ones(len(strokes), bool)
    wanted[:1000] = False
    places = sample_pixels(strokes, wanted, 5000, np.random.default_rng(0))
    assert (np.diff(places) > 0).all() and places.min() >= 1000
    assert np.bincount(strokes[places]).tolist() == [0, 4539, 458, 50]


def test_temperature_is_recovered():
    random = np.random.default_rng(0)
    logits = random.normal(0, 2, (20_000, 4))
    probabilities = np.exp(logits) / np.exp(logits).sum(axis=1, keepdims=True)
    codes = (probabilities.cumsum(axis=1) < random.random((20_000, 1))).sum(axis=1)
    blunt = probabilities**0.5 / (probabilities**0.5).sum(axis=1, keepdims=True)
    assert (
        abs(best_temperature(probabilities, codes) - 1) < 0.06
        and abs(best_temperature(blunt, codes) - 0.5) < 0.04
    )
    assert best_temperature(probabilities[:0], codes[:0]) == 1


def test_distance_decides_what_is_novel():
    random = np.random.default_rng(0)
    features = random.normal(0, 1, (3000, 12)).astype(np.float32)
    novelty = fit_novelty(features, np.arange(3000) % 3)
    pixels = (
        np.repeat(random.normal(0, 1, (20, 12)), 16, axis=0)
        .reshape(20, 16, 12)
        .repeat(4, axis=0)
        .astype(np.float32)
    )
    far = pixels + 12
    assert novelty.share(pixels).mean() < 0.05 and novelty.share(far).min() > 0.99
    assert fit_novelty(features, np.full(3000, -1)) is None


def test_forest_as_arrays_says_what_scikit_learn_says():
    random = np.random.default_rng(0)
    rows = random.normal(size=(3000, 5)).astype(np.float32)
    codes = (rows[:, 0] > 0).astype(int) + (rows[:, 1] > 0.5)
    grown = ExtraTreesClassifier(7, min_samples_leaf=5, random_state=0).fit(rows, codes, random.random(3000))
    forest = Forest.from_sklearn(grown)
    asked = random.normal(size=(500, 5)).astype(np.float32)
    assert (forest.probabilities(asked) == grown.predict_proba(asked).astype(np.float32)).all()
    assert forest.fits(5, 3) and not forest.fits(4, 3) and not forest.fits(5, 2)
    looping = forest.children.copy()
    looping[0, 0] = 0
    assert not replace(forest, children=looping).fits(5, 3)


def test_model_makes_the_same_masks_without_a_stroke(scene, tmp_path):
    learned = Strokes.fit(scene / "strokes", scene / "images", TABLE, QUICK)
    write_model(scene / "site.npz", TABLE, {"strokes": to_part(learned)})
    expected = learned.segment(photo(1))
    read = from_part(read_model(scene / "site.npz", TABLE, "strokes"), TABLE, scene / "site.npz")
    found = read.segment(photo(1))
    assert (found.labels == expected.labels).all() and (found.confidence == expected.confidence).all()
    shutil.rmtree(scene / "strokes")
    main(["segment", str(scene), "--backend", "strokes", "--model", str(scene / "site.npz")])
    assert (np.array(Image.open(scene / "masks" / "b.png")) == expected.labels).all()


def test_models_of_strokes_that_are_damaged_are_refused(scene):
    learned = Strokes.fit(scene / "strokes", scene / "images", TABLE, QUICK)
    part = to_part(learned)
    cut = {
        name: part.arrays[name][:-1] for name in ("member0_layer0", "member1_children", "low", "novelty_axes")
    }
    wrong = {name: np.full_like(part.arrays[name], 99) for name in ("member0_feature", "codes")}
    for name, values in [*cut.items(), *wrong.items()]:
        with pytest.raises(InputError, match="is damaged"):
            from_part(ModelPart(part.facts, {**part.arrays, name: values}), TABLE, scene / "site.npz")
    with pytest.raises(InputError, match="without --strokes"):
        Segment(backend="files", model=scene / "site.npz")
