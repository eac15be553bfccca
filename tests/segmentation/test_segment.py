"""Masks: the rules that need no model, the folder backend, photo by photo, and where weights are looked for."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from sc3d.errors import InputError, MissingPackageError
from sc3d.io.images import write_image
from sc3d.io.mask_images import read_index_image
from sc3d.scene.class_table import parse_classes
from sc3d.segmentation.grounded_sam import GroundedSam
from sc3d.segmentation.instances import Areas, Instance, fill_gaps, merge_instances, paint_areas
from sc3d.segmentation.mask_formats.import_masks import import_masks
from sc3d.segmentation.models import check_settings, find_weights
from sc3d.segmentation.rle import Window
from sc3d.segmentation.sam3 import Sam3
from sc3d.segmentation.segment import Folders, Segmentation, segment_photos
from sc3d.segmentation.text_prompts import Caption, Prompt, build_captions, list_prompts, match_prompts
from sc3d.settings.labels import Segment
from tests.builders import instance_of

TABLE = parse_classes(
    [
        {"id": 1, "name": "building", "color": [214, 60, 60], "prompts": ["building", "roof"]},
        {"id": 2, "name": "road", "color": [90, 90, 90], "prompts": ["road", "parking lot"]},
        {"id": 7, "name": "tree", "color": [0, 120, 0], "prompts": ["Tree."]},
    ],
    "test",
)


# ---- merging


def _merge_slowly(
    found: list[tuple[np.ndarray, Instance]], shape: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """The rule as it is written, pixel by pixel."""
    label, confidence = np.zeros(shape, np.uint8), np.zeros(shape, np.uint8)
    for row, column in np.ndindex(*shape):
        covering = [
            (mask, instance)
            for mask, instance in found
            if mask[row, column] and instance.box_score * instance.mask_score > 0
        ]
        if covering:
            _, winner = min(
                covering,
                key=lambda pair: (-pair[1].box_score * pair[1].mask_score, pair[0].sum(), pair[1].class_id),
            )
            label[row, column], confidence[row, column] = (
                winner.class_id,
                max(1, round(255 * winner.box_score * winner.mask_score)),
            )
    return label, confidence


def test_merge_equals_reference_in_any_order():
    random = np.random.default_rng(3)
    for _ in range(20):
        shape = (int(random.integers(1, 9)), int(random.integers(1, 9)))
        # Few different scores and areas, so that ties of every kind occur
        masks = [
            random.random(shape) < random.choice([0.0, 0.3, 0.6]) for _ in range(int(random.integers(0, 9)))
        ]
        found = [
            (
                mask,
                instance_of(mask, int(random.integers(1, 256)), *random.choice([0.0, 0.25, 0.5, 1.0], 2)),
            )
            for mask in masks
        ]
        expected = _merge_slowly(found, shape)
        for _ in range(6):
            result = merge_instances([found[number][1] for number in random.permutation(len(found))], shape)
            np.testing.assert_array_equal(result, expected)
            assert result[0].dtype == result[1].dtype == np.uint8


def test_merge_ties_by_area_then_class():
    whole, half = np.ones((2, 4), bool), np.zeros((2, 4), bool)
    half[:, :2] = True
    instances = [
        instance_of(whole, 1, 0.5, 0.8),
        instance_of(half, 9, 0.8, 0.5),
        instance_of(half, 4, 0.5, 0.8),
    ]
    label, confidence = merge_instances(instances, (2, 4))
    assert label.tolist() == [[4, 4, 1, 1]] * 2
    assert (confidence == round(255 * 0.4)).all()


def test_merge_ignores_worthless_and_marks_faint_instances():
    mask = np.ones((1, 2), bool)
    label, confidence = merge_instances(
        [instance_of(mask, 3, 0.9, float("nan")), instance_of(mask, 3, 0.9, -0.1)], (1, 2)
    )
    assert not label.any() and not confidence.any()
    label, confidence = merge_instances([instance_of(mask, 3, 0.01, 0.01)], (1, 2))
    assert (label == 3).all() and (confidence == 1).all()
    assert merge_instances([instance_of(mask, 3, 1.0, 1.03)], (1, 2))[1].max() == 255
    with pytest.raises(InputError, match="photo"):
        merge_instances([instance_of(mask, 3, 1.0, 1.0)], (2, 1))


def test_areas_equal_reference_and_fill_only_gaps():
    """The highest confidence of all concepts and looks wins, the lower class at equal ones, in any order;
    instances keep their pixels.
    """
    random, shape = np.random.default_rng(2), (7, 9)
    for _ in range(30):
        maps = [
            (int(class_id), random.integers(0, 4, shape).astype(np.uint8))
            for class_id in random.integers(1, 5, 4)
        ]
        tile = (int(random.integers(0, 3)), int(random.integers(0, 4)))
        window = Window(tile[1], tile[0], tile[1] + 4, tile[0] + 3)
        part = Areas(
            random.integers(1, 5, (3, 4)).astype(np.uint8), random.integers(0, 4, (3, 4)).astype(np.uint8)
        )
        part.labels[part.confidence == 0] = 0
        expected = np.zeros((2, *shape), np.uint8)
        for row, column in np.ndindex(*shape):
            said = [(-int(values[row, column]), class_id) for class_id, values in maps if values[row, column]]
            if (
                window.top <= row < window.bottom
                and window.left <= column < window.right
                and part.confidence[row - window.top, column - window.left]
            ):
                said.append(
                    (
                        -int(part.confidence[row - window.top, column - window.left]),
                        int(part.labels[row - window.top, column - window.left]),
                    )
                )
            if said:
                expected[:, row, column] = min(said)[1], -min(said)[0]
        areas = Areas(np.zeros(shape, np.uint8), np.zeros(shape, np.uint8))
        looks = [
            (Areas(np.full_like(values, class_id), values), Window(0, 0, 9, 7)) for class_id, values in maps
        ]
        looks.append((part, window))
        for number in random.permutation(len(looks)):
            paint_areas(areas, *looks[number])
        np.testing.assert_array_equal(areas, expected)
        labels = np.where(random.random(shape) < 0.5, 9, 0).astype(np.uint8)
        filled, confidence = labels.copy(), labels * 3
        fill_gaps(filled, confidence, areas)
        np.testing.assert_array_equal(
            [filled, confidence], np.where(labels > 0, np.array([labels, labels * 3]), expected)
        )


# ---- prompts

# [CLS] building . parking lot . parking garage . road . [SEP]
CAPTION = Caption(
    list(range(12)),
    [(1, 2), (3, 5), (6, 8), (9, 10)],
    [Prompt(str(class_id), class_id) for class_id in (1, 2, 7, 3)],
)


@pytest.mark.parametrize(
    ("scores", "expected", "score"),
    [
        ([0, 0.9, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0], 1, 0.9),
        ([0, 0.6, 0, 0, 0, 0, 0, 0, 0, 0.7, 0, 0], 3, 0.7),  # merged phrase "building road": the better one
        ([0, 0.5, 0, 0, 0, 0, 0, 0, 0, 0.5, 0, 0], 1, 0.5),  # a tie: the lower class id
        ([0, 0, 0, 0.6, 0.5, 0, 0.6, 0.1, 0, 0, 0, 0], 2, 0.6),  # both words beat one
        # 0.24 is below the text threshold and does not count
        ([0, 0, 0, 0.5, 0.24, 0, 0.38, 0.35, 0, 0, 0, 0], 7, 0.38),
        ([0, 0.4, 0, 0.6, 0, 0, 0, 0, 0, 0, 0, 0], 1, 0.4),  # a whole prompt beats half of a longer one
        # special tokens and full stops are no prompt
        ([0.9, 0.2, 0.9, 0, 0, 0.9, 0, 0, 0, 0.29, 0.9, 0.9], 0, 0.0),
        # only prompts above the box threshold are candidates
        ([0, 0.29, 0, 0.9, 0, 0, 0, 0, 0, 0.1, 0, 0], 2, 0.9),
    ],
)
def test_match_prompts(scores, expected, score):
    numbers, box_scores = match_prompts(np.array([scores]), CAPTION, 0.3, 0.25)
    assert [CAPTION.prompts[number].class_id if number >= 0 else 0 for number in numbers] == [expected]
    assert box_scores == pytest.approx([score])


def test_match_prompts_does_not_depend_on_prompt_order():
    random = np.random.default_rng(0)
    scores = random.choice([0.1, 0.28, 0.5, 0.8], (200, 12))
    expected = match_prompts(scores, CAPTION, 0.3, 0.25)[0]
    for order in (random.permutation(4) for _ in range(10)):
        shuffled = Caption(
            CAPTION.token_ids,
            [CAPTION.spans[number] for number in order],
            [CAPTION.prompts[number] for number in order],
        )
        numbers = match_prompts(scores, shuffled, 0.3, 0.25)[0]
        np.testing.assert_array_equal(np.where(numbers >= 0, order[numbers], -1), expected)
    assert match_prompts(np.zeros((0, 12)), CAPTION, 0.3, 0.25)[0].shape == (0,)


def test_match_prompts_needs_a_word_above_both_thresholds():
    scores = np.array([[0, 0.5, 0, 0, 0, 0, 0, 0, 0, 0.5, 0, 0]])
    numbers, box_scores = match_prompts(scores, CAPTION, 0.3, 0.6)
    assert (numbers == -1).all() and not box_scores.any()


def test_list_prompts():
    assert [prompt.text for prompt in list_prompts(TABLE)] == [
        "building",
        "roof",
        "road",
        "parking lot",
        "tree",
    ]
    silent = {"id": 3, "name": "other", "color": [0, 0, 0], "prompts": []}
    with pytest.raises(InputError, match="no class has a prompt"):
        list_prompts(parse_classes([silent], "test"))
    with pytest.raises(InputError, match="'roof' belongs to the classes 'house' and 'roof'"):
        entries = [
            silent | {"name": "roof", "prompts": ["Roof"]},
            silent | {"id": 1, "name": "house", "prompts": ["roof."]},
        ]
        list_prompts(parse_classes(entries, "test"))
    with pytest.raises(InputError, match="empty prompt"):
        list_prompts(parse_classes([silent | {"prompts": [" . "]}], "test"))


def test_captions_fit_the_text_length():
    tokens = [
        (Prompt(str(index), index), [10 * index + word for word in range(index)]) for index in range(1, 6)
    ]
    captions = build_captions(tokens, 101, 1012, 102, 9)
    assert [prompt.class_id for caption in captions for prompt in caption.prompts] == [1, 2, 3, 4, 5]
    for caption in captions:
        assert (
            len(caption.token_ids) <= 9
            and caption.token_ids[0] == 101
            and caption.token_ids[-2:] == [1012, 102]
        )
        for (first, last), prompt in zip(caption.spans, caption.prompts, strict=True):
            assert (
                caption.token_ids[first:last] == tokens[prompt.class_id - 1][1]
                and caption.token_ids[last] == 1012
            )
    with pytest.raises(InputError, match="shorten"):
        build_captions(tokens, 101, 1012, 102, 7)


# ---- folders of masks

SIZES = {"a.jpg": (8, 6), "sub/b.JPG": (8, 6)}


def _write_masks(folder: Path, **masks: np.ndarray) -> Path:
    for stem, mask in masks.items():
        write_image(folder / f"{stem}.png", mask)
    return folder


def test_import_masks(tmp_path):
    from PIL import Image

    source = _write_masks(tmp_path / "source", a=np.full((12, 16), 2, np.uint8))
    palette = Image.fromarray(np.full((3, 4), 7, np.uint8)).convert("P")
    palette.putdata([7] * 12)
    palette.putpalette(TABLE.palette.ravel().tolist())
    palette.save(source / "b.png")
    confidence = _write_masks(tmp_path / "sure", a=np.full((12, 16), 200, np.uint8))
    masks, maps = tmp_path / "scene" / "masks", tmp_path / "scene" / "confidence"
    assert import_masks(source, masks, SIZES, TABLE, confidence, maps) == ["a.jpg", "sub/b.JPG"]
    assert sorted(file.name for file in masks.iterdir()) == ["a.png", "b.png"]
    assert (read_index_image(masks / "a.png") == 2).all() and read_index_image(masks / "a.png").shape == (
        12,
        16,
    )
    assert (read_index_image(masks / "b.png") == 7).all() and Image.open(masks / "b.png").mode == "L"
    assert [file.name for file in maps.iterdir()] == ["a.png"] and (
        read_index_image(maps / "a.png") == 200
    ).all()
    # Masks in place are checked and left alone, with their confidence; other masks replace both
    assert import_masks(masks, masks, SIZES, TABLE, None, maps) == ["a.jpg", "sub/b.JPG"] and maps.exists()
    (source / "b.png").unlink()
    assert import_masks(source, masks, SIZES, TABLE, None, maps) == ["a.jpg"]
    assert [file.name for file in masks.iterdir()] == ["a.png"] and not maps.exists()


@pytest.mark.parametrize(
    ("stem", "mask", "message"),
    [
        ("c", np.zeros((6, 8), np.uint8), "belongs to no photo"),
        ("b", np.zeros((8, 8), np.uint8), "aspect"),
        ("b", np.full((6, 8), 3, np.uint8), "class id 3"),
        ("b", np.full((6, 8, 3), (1, 2, 3), np.uint8), "colors"),
    ],
)
def test_import_writes_nothing_if_a_mask_does_not_fit(tmp_path, stem, mask, message):
    source = _write_masks(tmp_path / "source", a=np.ones((6, 8), np.uint8), **{stem: mask})
    _assert_refused(tmp_path, source, message)


def test_import_writes_nothing_if_a_mask_is_damaged(tmp_path):
    source = _write_masks(
        tmp_path / "source", a=np.random.default_rng(0).integers(0, 3, (600, 800)).astype(np.uint8)
    )
    content = (source / "a.png").read_bytes()
    for damaged in (content[: len(content) // 2], b"", b"no image"):
        (source / "a.png").write_bytes(damaged)
        _assert_refused(tmp_path, source, "damaged")
    _assert_refused(tmp_path, tmp_path / "nowhere", "no masks in")


def test_import_writes_nothing_if_confidence_does_not_fit(tmp_path):
    source = _write_masks(tmp_path / "source", a=np.ones((6, 8), np.uint8))
    other_size = _write_masks(tmp_path / "other", a=np.ones((12, 16), np.uint8))
    orphan = _write_masks(tmp_path / "orphan", b=np.ones((6, 8), np.uint8))
    _assert_refused(tmp_path, source, "must be equal", other_size)
    _assert_refused(tmp_path, source, "does not exist", orphan)


def test_import_does_not_touch_folders_of_others(tmp_path):
    source = _write_masks(tmp_path / "scene" / "masks" / "mine", a=np.ones((6, 8), np.uint8))
    with pytest.raises(InputError, match="lies inside"):
        import_masks(source, source.parent, SIZES, TABLE)
    elsewhere = _write_masks(tmp_path / "elsewhere", a=np.zeros((6, 8), np.uint8))
    (tmp_path / "link").symlink_to(elsewhere)
    with pytest.raises(InputError, match="link"):
        import_masks(source, tmp_path / "link", SIZES, TABLE)
    assert source.is_dir() and not read_index_image(elsewhere / "a.png").any()


def _assert_refused(tmp_path: Path, source: Path, message: str, confidence: Path | None = None) -> None:
    scene = tmp_path / "scene"
    kept = _write_masks(scene / "masks", a=np.full((6, 8), 7, np.uint8)) / "a.png"
    before = kept.read_bytes()
    with pytest.raises(InputError, match=message):
        import_masks(source, scene / "masks", SIZES, TABLE, confidence, scene / "confidence")
    assert kept.read_bytes() == before and sorted(path.name for path in scene.rglob("*")) == [
        "a.png",
        "masks",
    ]


# ---- photo by photo


class _Halves:
    """Segmenter that labels the left half, and fails at the photo number `broken`."""

    def __init__(self, broken: int | None = None, instances: bool = False) -> None:
        self.num_calls, self.broken, self.instances = 0, broken, instances

    def segment(self, image: np.ndarray) -> Segmentation:
        self.num_calls += 1
        if self.num_calls == self.broken:
            raise KeyboardInterrupt
        label = np.zeros(image.shape[:2], np.uint8)
        label[:, : image.shape[1] // 2] = 2
        return Segmentation(
            label,
            label * 100,
            (instance_of(label > 0, 2, 0.8, 0.5, "road"),) if self.instances else None,
        )


def _write_photos(folder: Path, num_photos: int = 2) -> list[Path]:
    random = np.random.default_rng(1)
    photos = [folder / f"photo{index}.jpg" for index in range(num_photos)]
    for index, photo in enumerate(photos):
        write_image(photo, random.integers(0, 256, (48 + 16 * index, 80, 3)).astype(np.uint8))
    return photos


def test_segment_photos_resumes(tmp_path):
    photos, folders = _write_photos(tmp_path / "images", 3), _folders(tmp_path)
    with pytest.raises(KeyboardInterrupt):
        segment_photos(photos, folders, _Halves(broken=2), TABLE)
    assert [file.name for file in folders.masks.iterdir()] == ["photo0.png"]
    segmenter = _Halves()
    summary = segment_photos(photos, folders, segmenter, TABLE)
    assert (summary.segmented, summary.skipped) == (
        ["photo1.jpg", "photo2.jpg"],
        ["photo0.jpg"],
    ) and segmenter.num_calls == 2
    assert (
        summary.num_pixels.sum() == 80 * (64 + 80)
        and summary.num_pixels[2] == 40 * (64 + 80)
        and summary.num_instances == 0
    )
    assert read_index_image(folders.masks / "photo2.png").shape == (80, 80)
    assert (
        read_index_image(folders.confidence / "photo2.png")[:, :40] == 200
    ).all() and not folders.instances.exists()
    assert segment_photos(photos, folders, segmenter, TABLE).segmented == [] and segmenter.num_calls == 2
    assert len(segment_photos(photos, folders, segmenter, TABLE, overwrite=True).segmented) == 3


def test_instances_are_written_and_do_not_outlive_their_mask(tmp_path):
    photos, folders = _write_photos(tmp_path / "images"), _folders(tmp_path)
    assert segment_photos(photos, folders, _Halves(instances=True), TABLE).num_instances == 2
    content = json.loads((folders.instances / "photo1.json").read_text())
    assert content["images"][0] == {"id": 1, "file_name": "photo1.jpg", "width": 80, "height": 64}
    (annotation,) = content["annotations"]
    assert (annotation["category_id"], annotation["name"], annotation["prompt"], annotation["score"]) == (
        2,
        "road",
        "road",
        0.4,
    )
    assert annotation["bbox"] == [0, 0, 40, 64] and annotation["segmentation"]["size"] == [64, 80]
    segment_photos(photos, folders, _Halves(), TABLE, overwrite=True)
    assert not list(folders.instances.iterdir())


def test_segment_photos_checks_all_photos_first(tmp_path):
    photos, folders, segmenter = _write_photos(tmp_path / "images"), _folders(tmp_path), _Halves()
    bad = tmp_path / "images" / "bad.jpg"
    bad.write_bytes(b"not a photo")
    with pytest.raises(InputError, match="bad.jpg"):
        segment_photos([*photos, bad], folders, segmenter, TABLE)
    write_image(folders.masks / "photo1.png", np.zeros((64, 64), np.uint8))
    with pytest.raises(InputError, match="aspect"):
        segment_photos(photos, folders, segmenter, TABLE)
    assert segmenter.num_calls == 0 and not folders.confidence.exists()


def _folders(scene: Path) -> Folders:
    return Folders(scene / "masks", scene / "confidence", scene / "instances")


# ---- weights


@pytest.mark.parametrize(
    ("backend", "words"),
    [
        (
            GroundedSam,
            (
                "IDEA-Research/grounding-dino-tiny",
                "690 MB",
                "Apache-2.0",
                "{0}/grounding-dino-tiny",
                "{0}/IDEA-Research/grounding-dino-tiny",
            ),
        ),
        (
            Sam3,
            (
                "facebook/sam3",
                "3440 MB",
                "SAM license, gated",
                "hf auth login",
                "{0}/sam3",
                "{0}/facebook/sam3",
            ),
        ),
    ],
)
def test_missing_weights_say_what_to_do(tmp_path, monkeypatch, backend, words):
    pytest.importorskip("transformers")
    monkeypatch.setattr(
        "huggingface_hub.snapshot_download", lambda *args, **kwargs: pytest.fail("went to the network")
    )
    monkeypatch.setattr("huggingface_hub.try_to_load_from_cache", lambda *args, **kwargs: None)
    with pytest.raises(InputError) as raised:
        backend(Segment(model_dir=tmp_path), TABLE)
    for part in (*words, "hub cache", "--download", "hf download"):
        assert part.format(tmp_path) in str(raised.value)
    assert "\n" not in str(raised.value)


def test_only_names_of_models_are_looked_for(tmp_path):
    pytest.importorskip("huggingface_hub")
    with pytest.raises(InputError, match="size and license"):
        find_weights("someone/else", None, download=False)
    for name in ("../secret", "a/..", "no-owner", "/etc/passwd", "a/b/c", "a b/c"):
        with pytest.raises(InputError, match="not the name of a model"):
            find_weights(name, tmp_path, download=False)


def test_weights_are_found_in_model_folder_then_hub_cache(tmp_path, monkeypatch):
    constants = pytest.importorskip("huggingface_hub").constants
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "cache"))
    snapshot = tmp_path / "cache" / "models--owner--model" / "snapshots" / "0123abc"
    folders = [tmp_path / "own" / "model", tmp_path / "own" / "owner" / "model", snapshot]
    for folder in folders:
        folder.mkdir(parents=True)
        (folder / "config.json").write_text("{}")
    (snapshot.parents[1] / "refs").mkdir()
    (snapshot.parents[1] / "refs" / "main").write_text("0123abc")
    # a configuration without weights is no model
    with pytest.raises(InputError, match="not on this machine"):
        find_weights("owner/model", tmp_path / "own", download=False)
    for folder in reversed(folders):
        (folder / "model.safetensors").touch()
        assert find_weights("owner/model", tmp_path / "own", download=False) == folder
    assert find_weights("owner/model", None, download=False) == snapshot


def test_failed_download_is_one_line(monkeypatch):
    pytest.importorskip("huggingface_hub")

    def fail(*args, **kwargs):
        raise ConnectionError("no route to host\nlong story")

    monkeypatch.setattr("huggingface_hub.snapshot_download", fail)
    with pytest.raises(InputError, match="cannot download some/model: no route to host; allow") as raised:
        find_weights("some/model", None, download=True)
    assert "\n" not in str(raised.value)


def test_missing_package(monkeypatch):
    import importlib.metadata

    monkeypatch.setattr(importlib.metadata, "version", lambda name: "4.57.1")
    with pytest.raises(
        MissingPackageError, match=r"transformers 5 or newer, not 4.57.1: pip install -U 'sc3d\[masks\]'"
    ):
        GroundedSam(Segment(), TABLE)

    def missing(name):
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(importlib.metadata, "version", missing)
    with pytest.raises(MissingPackageError, match=r"pip install 'sc3d\[masks\]'"):
        GroundedSam(Segment(), TABLE)


def test_settings_are_checked():
    wrongs = (
        {"box_threshold": 1.0},
        {"text_threshold": -0.1},
        {"box_threshold": float("nan")},
        {"tile": -5},
        {"tile": 10},
        {"overlap": 0.0},
        {"overlap": 0.9},
    )
    for wrong in wrongs:
        with pytest.raises(InputError, match=next(iter(wrong))):
            check_settings(Segment(**wrong))
    check_settings(Segment(tile=0))


def test_import_is_light():
    code = """
import sys, sc3d.segmentation.mask_formats.import_masks, sc3d.segmentation.grounded_sam, sc3d.segmentation.sam3, sc3d.segmentation.segment
print([name for name in ("torch", "transformers", "huggingface_hub", "PIL", "cv2") if name in sys.modules])
"""
    root = Path(__file__).parents[2]
    assert (
        subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=root
        ).stdout.strip()
        == "[]"
    )
