"""Masks: the rules that need no model, the folder backend, and the text-prompted backend on tiny random-weight models."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from sc3d.classes import parse_classes
from sc3d.errors import InputError, MissingPackageError
from sc3d.io import read_index_image, write_image
from sc3d.segmentation.files import import_masks
from sc3d.segmentation.grounded_sam import GroundedSam, GroundedSamSettings
from sc3d.segmentation.merge import Instance, merge_instances
from sc3d.segmentation.prompts import Caption, Prompt, build_captions, list_prompts, match_classes
from sc3d.segmentation.run import segment_photos
from sc3d.segmentation.weights import find_weights

TABLE = parse_classes(
    [
        {"id": 1, "name": "building", "color": [214, 60, 60], "prompts": ["building", "roof"]},
        {"id": 2, "name": "road", "color": [90, 90, 90], "prompts": ["road", "parking lot"]},
        {"id": 7, "name": "tree", "color": [0, 120, 0], "prompts": ["Tree."]},
    ],
    "test",
)


@pytest.fixture
def models(tiny_models: Path) -> Iterator[Path]:
    """The tiny models, on one thread: threads would wait for one another longer than they compute, above all on a busy machine."""
    import torch

    num_threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield tiny_models
    torch.set_num_threads(num_threads)


# ---- merging


def _merge_slowly(instances: list[Instance], shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """The rule as it is written, pixel by pixel."""
    label, confidence = np.zeros(shape, np.uint8), np.zeros(shape, np.uint8)
    for row, column in np.ndindex(*shape):
        covering = [instance for instance in instances if instance.mask[row, column] and instance.score > 0]
        if covering:
            winner = min(covering, key=lambda instance: (-instance.score, instance.mask.sum(), instance.class_id))
            label[row, column], confidence[row, column] = winner.class_id, max(1, round(255 * winner.score))
    return label, confidence


def test_merge_equals_reference_in_any_order():
    random = np.random.default_rng(3)
    for _ in range(20):
        shape = (int(random.integers(1, 9)), int(random.integers(1, 9)))
        # Few different scores and areas, so that ties of every kind occur
        instances = [
            Instance(random.random(shape) < random.choice([0.3, 0.6]), int(random.integers(1, 256)), *random.choice([0.0, 0.25, 0.5, 1.0], 2))
            for _ in range(int(random.integers(0, 9)))
        ]
        expected = _merge_slowly(instances, shape)
        for _ in range(6):
            result = merge_instances((instances[index] for index in random.permutation(len(instances))), shape)
            np.testing.assert_array_equal(result, expected)
            assert result[0].dtype == result[1].dtype == np.uint8


def test_merge_ties_by_area_then_class():
    whole, half = np.ones((2, 4), bool), np.zeros((2, 4), bool)
    half[:, :2] = True
    label, confidence = merge_instances([Instance(whole, 1, 0.5, 0.8), Instance(half, 9, 0.8, 0.5), Instance(half.copy(), 4, 0.5, 0.8)], (2, 4))
    assert label.tolist() == [[4, 4, 1, 1]] * 2
    assert (confidence == round(255 * 0.4)).all()


def test_merge_ignores_worthless_and_marks_faint_instances():
    mask = np.ones((1, 2), bool)
    label, confidence = merge_instances([Instance(mask, 3, 0.9, float("nan")), Instance(mask, 3, 0.9, -0.1)], (1, 2))
    assert not label.any() and not confidence.any()
    label, confidence = merge_instances([Instance(mask, 3, 0.01, 0.01)], (1, 2))
    assert (label == 3).all() and (confidence == 1).all()
    assert merge_instances([Instance(mask, 3, 1.0, 1.03)], (1, 2))[1].max() == 255
    with pytest.raises(InputError, match="photo"):
        merge_instances([Instance(mask, 3, 1.0, 1.0)], (2, 1))


# ---- prompts

# [CLS] building . parking lot . parking garage . road . [SEP]
CAPTION = Caption(list(range(12)), [(1, 2), (3, 5), (6, 8), (9, 10)], [1, 2, 7, 3])


@pytest.mark.parametrize(
    ("scores", "expected", "score"),
    [
        ([0, 0.9, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0], 1, 0.9),
        ([0, 0.6, 0, 0, 0, 0, 0, 0, 0, 0.7, 0, 0], 3, 0.7),  # merged phrase "building road": the better one
        ([0, 0.5, 0, 0, 0, 0, 0, 0, 0, 0.5, 0, 0], 1, 0.5),  # a tie: the lower class id
        ([0, 0, 0, 0.6, 0.5, 0, 0.6, 0.1, 0, 0, 0, 0], 2, 0.6),  # both words beat one
        ([0, 0, 0, 0.5, 0.24, 0, 0.38, 0.35, 0, 0, 0, 0], 7, 0.38),  # 0.24 is below the text threshold and does not count
        ([0, 0.4, 0, 0.6, 0, 0, 0, 0, 0, 0, 0, 0], 1, 0.4),  # a whole prompt beats half of a longer one
        ([0.9, 0.2, 0.9, 0, 0, 0.9, 0, 0, 0, 0.29, 0.9, 0.9], 0, 0.0),  # special tokens and full stops are no prompt
        ([0, 0.29, 0, 0.9, 0, 0, 0, 0, 0, 0.1, 0, 0], 2, 0.9),  # only prompts above the box threshold are candidates
    ],
)
def test_match_classes(scores, expected, score):
    class_ids, box_scores = match_classes(np.array([scores]), CAPTION, 0.3, 0.25)
    assert class_ids.tolist() == [expected] and class_ids.dtype == np.uint8
    assert box_scores == pytest.approx([score])


def test_match_classes_does_not_depend_on_prompt_order():
    random = np.random.default_rng(0)
    scores = random.choice([0.1, 0.28, 0.5, 0.8], (200, 12))
    expected = match_classes(scores, CAPTION, 0.3, 0.25)[0]
    for order in (random.permutation(4) for _ in range(10)):
        shuffled = Caption(CAPTION.token_ids, [CAPTION.spans[index] for index in order], [CAPTION.class_ids[index] for index in order])
        np.testing.assert_array_equal(match_classes(scores, shuffled, 0.3, 0.25)[0], expected)
    assert match_classes(np.zeros((0, 12)), CAPTION, 0.3, 0.25)[0].shape == (0,)


def test_match_classes_needs_a_word_above_both_thresholds():
    scores = np.array([[0, 0.5, 0, 0, 0, 0, 0, 0, 0, 0.5, 0, 0]])
    class_ids, box_scores = match_classes(scores, CAPTION, 0.3, 0.6)
    assert not class_ids.any() and not box_scores.any()


def test_list_prompts():
    assert [prompt.text for prompt in list_prompts(TABLE)] == ["building", "roof", "road", "parking lot", "tree"]
    silent = {"id": 3, "name": "other", "color": [0, 0, 0], "prompts": []}
    with pytest.raises(InputError, match="no class has a prompt"):
        list_prompts(parse_classes([silent], "test"))
    with pytest.raises(InputError, match="'roof' belongs to the classes 'house' and 'roof'"):
        entries = [silent | {"name": "roof", "prompts": ["Roof"]}, silent | {"id": 1, "name": "house", "prompts": ["roof."]}]
        list_prompts(parse_classes(entries, "test"))
    with pytest.raises(InputError, match="empty prompt"):
        list_prompts(parse_classes([silent | {"prompts": [" . "]}], "test"))


def test_captions_fit_the_text_length():
    tokens = [(Prompt(str(index), index), [10 * index + word for word in range(index)]) for index in range(1, 6)]
    captions = build_captions(tokens, 101, 1012, 102, 9)
    assert [id for caption in captions for id in caption.class_ids] == [1, 2, 3, 4, 5]
    for caption in captions:
        assert len(caption.token_ids) <= 9 and caption.token_ids[0] == 101 and caption.token_ids[-2:] == [1012, 102]
        for (first, last), class_id in zip(caption.spans, caption.class_ids, strict=True):
            assert caption.token_ids[first:last] == tokens[class_id - 1][1] and caption.token_ids[last] == 1012
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
    assert (read_index_image(masks / "a.png") == 2).all() and read_index_image(masks / "a.png").shape == (12, 16)
    assert (read_index_image(masks / "b.png") == 7).all() and Image.open(masks / "b.png").mode == "L"
    assert [file.name for file in maps.iterdir()] == ["a.png"] and (read_index_image(maps / "a.png") == 200).all()
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
        ("b", np.zeros((6, 8, 3), np.uint8), "colours"),
    ],
)
def test_import_writes_nothing_if_a_mask_does_not_fit(tmp_path, stem, mask, message):
    source = _write_masks(tmp_path / "source", a=np.ones((6, 8), np.uint8), **{stem: mask})
    _assert_refused(tmp_path, source, message)


def test_import_writes_nothing_if_a_mask_is_damaged(tmp_path):
    source = _write_masks(tmp_path / "source", a=np.random.default_rng(0).integers(0, 3, (600, 800)).astype(np.uint8))
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
    assert kept.read_bytes() == before and sorted(path.name for path in scene.rglob("*")) == ["a.png", "masks"]


# ---- photo by photo


class _Halves:
    """Segmenter that labels the left half, and fails at the photo number `broken`."""

    def __init__(self, broken: int | None = None) -> None:
        self.num_calls, self.broken = 0, broken

    def segment(self, image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        self.num_calls += 1
        if self.num_calls == self.broken:
            raise KeyboardInterrupt
        label = np.zeros(image.shape[:2], np.uint8)
        label[:, : image.shape[1] // 2] = 2
        return label, label * 100


def _write_photos(folder: Path, num_photos: int = 2) -> list[Path]:
    random = np.random.default_rng(1)
    photos = [folder / f"photo{index}.jpg" for index in range(num_photos)]
    for index, photo in enumerate(photos):
        write_image(photo, random.integers(0, 256, (48 + 16 * index, 80, 3)).astype(np.uint8))
    return photos


def test_segment_photos_resumes(tmp_path):
    photos, masks, maps = _write_photos(tmp_path / "images", 3), tmp_path / "masks", tmp_path / "confidence"
    with pytest.raises(KeyboardInterrupt):
        segment_photos(photos, masks, maps, _Halves(broken=2))
    assert [file.name for file in masks.iterdir()] == ["photo0.png"]
    segmenter = _Halves()
    summary = segment_photos(photos, masks, maps, segmenter)
    assert (summary.segmented, summary.skipped) == (["photo1.jpg", "photo2.jpg"], ["photo0.jpg"]) and segmenter.num_calls == 2
    assert summary.num_pixels.sum() == 80 * (64 + 80) and summary.num_pixels[2] == 40 * (64 + 80)
    assert read_index_image(masks / "photo2.png").shape == (80, 80) and (read_index_image(maps / "photo2.png")[:, :40] == 200).all()
    assert segment_photos(photos, masks, maps, segmenter).segmented == [] and segmenter.num_calls == 2
    assert len(segment_photos(photos, masks, maps, segmenter, overwrite=True).segmented) == 3


def test_segment_photos_checks_all_photos_first(tmp_path):
    photos, masks, segmenter = _write_photos(tmp_path / "images"), tmp_path / "masks", _Halves()
    bad = tmp_path / "images" / "bad.jpg"
    bad.write_bytes(b"not a photo")
    with pytest.raises(InputError, match="bad.jpg"):
        segment_photos([*photos, bad], masks, tmp_path / "confidence", segmenter)
    double = Path(shutil.copy(photos[0], tmp_path / "photo0.jpeg"))
    with pytest.raises(InputError, match="share the name"):
        segment_photos([*photos, double], masks, tmp_path / "confidence", segmenter)
    write_image(masks / "photo1.png", np.zeros((64, 64), np.uint8))
    with pytest.raises(InputError, match="aspect"):
        segment_photos(photos, masks, tmp_path / "confidence", segmenter)
    assert segmenter.num_calls == 0 and not (tmp_path / "confidence").exists()


# ---- weights


def test_missing_weights_say_what_to_do(tmp_path, monkeypatch):
    pytest.importorskip("transformers")
    monkeypatch.setattr("huggingface_hub.snapshot_download", lambda *args, **kwargs: pytest.fail("went to the network"))
    monkeypatch.setattr("huggingface_hub.try_to_load_from_cache", lambda *args, **kwargs: None)
    with pytest.raises(InputError) as raised:
        GroundedSam(GroundedSamSettings(model_dir=tmp_path), TABLE)
    places = (str(tmp_path / "grounding-dino-tiny"), "hub cache")
    for part in ("IDEA-Research/grounding-dino-tiny", "690 MB", "Apache-2.0", *places, "--download", "hf download"):
        assert part in str(raised.value)
    assert "\n" not in str(raised.value)
    with pytest.raises(InputError, match="size and licence"):
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
    with pytest.raises(InputError, match="not on this machine"):  # a configuration without weights is no model
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
    with pytest.raises(MissingPackageError, match=r"transformers 5 or newer, not 4.57.1: pip install -U 'sc3d\[masks\]'"):
        GroundedSam(GroundedSamSettings(), TABLE)

    def missing(name):
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(importlib.metadata, "version", missing)
    with pytest.raises(MissingPackageError, match=r"pip install 'sc3d\[masks\]'"):
        GroundedSam(GroundedSamSettings(), TABLE)


def test_settings_are_checked():
    for wrong in ({"box_threshold": 1.0}, {"text_threshold": -0.1}, {"max_size": 10}, {"box_threshold": float("nan")}):
        with pytest.raises(InputError, match=next(iter(wrong))):
            GroundedSamSettings(**wrong)


def test_import_is_light():
    code = """
import sys, sc3d.segmentation.files, sc3d.segmentation.grounded_sam, sc3d.segmentation.run
print([name for name in ("torch", "transformers", "huggingface_hub", "PIL", "cv2") if name in sys.modules])
"""
    root = Path(__file__).parents[1]
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=root).stdout.strip() == "[]"


# ---- real code on tiny random models


def _tiny(models: Path, segmenter: str, **changes) -> GroundedSamSettings:
    return GroundedSamSettings(detector="tiny/dino", segmenter=f"tiny/{segmenter}", model_dir=models, device="cpu", max_size=128, **changes)


@pytest.mark.parametrize("segmenter", ["sam", "sam2", "sam2_video"])
def test_grounded_sam_writes_valid_masks(models, tmp_path, segmenter):
    photos, masks, maps = _write_photos(tmp_path / "images"), tmp_path / "masks", tmp_path / "confidence"
    backend = GroundedSam(_tiny(models, segmenter), TABLE)
    assert segment_photos(photos, masks, maps, backend).segmented == ["photo0.jpg", "photo1.jpg"]
    for index in range(2):
        label, confidence = read_index_image(masks / f"photo{index}.png"), read_index_image(maps / f"photo{index}.png")
        assert label.shape == confidence.shape == (48 + 16 * index, 80)
        assert not TABLE.unknown(label) and label.any()
        assert ((label == 0) == (confidence == 0)).all()
    before = {file: file.read_bytes() for file in masks.iterdir()}
    assert segment_photos(photos, masks, maps, backend).segmented == []
    segment_photos(photos, masks, maps, GroundedSam(_tiny(models, segmenter), TABLE), overwrite=True)
    assert before == {file: file.read_bytes() for file in masks.iterdir()}


def test_nothing_found_is_unlabelled(models):
    label, confidence = GroundedSam(_tiny(models, "sam2", box_threshold=0.9999), TABLE).segment(np.zeros((20, 30, 3), np.uint8))
    assert label.shape == (20, 30) and not label.any() and not confidence.any()


def test_detections_equal_those_of_the_models_own_processor(models):
    """One prompt per class, so that the library's boxes and scores must come out, and its phrases name the class."""
    from transformers import AutoTokenizer, GroundingDinoForObjectDetection, GroundingDinoImageProcessorPil, GroundingDinoProcessor

    image = np.random.default_rng(5).integers(0, 256, (96, 128, 3)).astype(np.uint8)
    words = ["building", "parking lot", "trees"]
    table = parse_classes([{"id": 3 + index, "name": word, "color": [0, 0, 0]} for index, word in enumerate(words)], "test")
    backend = GroundedSam(_tiny(models, "sam2", box_threshold=0.5, text_threshold=0.0), table)
    boxes, class_ids, scores = backend.detect(image)

    model = GroundingDinoForObjectDetection.from_pretrained(models / "dino").eval()
    tokenizer = AutoTokenizer.from_pretrained(models / "dino")
    processor = GroundingDinoProcessor(GroundingDinoImageProcessorPil(size={"shortest_edge": 77, "longest_edge": 128}), tokenizer)
    inputs = processor(images=image, text=[words], return_tensors="pt")
    assert inputs["input_ids"][0].tolist() == backend._captions[0].token_ids
    np.testing.assert_allclose(backend._detector_pixels(image), inputs["pixel_values"], atol=1e-5)
    output = model(**inputs)
    tokens = output.logits[0].sigmoid().detach().numpy()
    expected = processor.post_process_grounded_object_detection(output, inputs["input_ids"], threshold=0.5, target_sizes=[(96, 128)])[0]
    spans = [slice(1, 2), slice(3, 5), slice(6, 8)]
    best = np.stack([tokens[:, span].max(axis=1) for span in spans], axis=1)
    found = best.max(axis=1) > 0.5
    mean = np.where(best > 0.5, np.stack([tokens[:, span].mean(axis=1) for span in spans], axis=1), 0)[found]
    assert 0 < len(boxes) == found.sum() <= len(expected["boxes"])
    np.testing.assert_array_equal(class_ids, 3 + mean.argmax(axis=1))
    np.testing.assert_allclose(scores, best[found][np.arange(len(scores)), mean.argmax(axis=1)], atol=1e-5)
    kept = tokens.max(axis=1) > 0.5  # the library counts special tokens as well
    np.testing.assert_allclose(boxes, expected["boxes"].detach().numpy()[found[kept]].clip(0, [128, 96, 128, 96]), atol=1e-3)


def test_long_prompt_lists_take_several_captions(models):
    words = ["building", "house", "roof", "road", "tree", "grass", "solar panel", "parking lot"]
    table = parse_classes([{"id": 1, "name": "x", "color": [0, 0, 0], "prompts": [f"{a} {b}" for a in words for b in words]}], "test")
    backend = GroundedSam(_tiny(models, "sam2"), table)
    assert len(backend._captions) > 1 and all(len(caption.token_ids) <= 32 for caption in backend._captions)
    boxes, class_ids, scores = backend.detect(np.full((30, 40, 3), 128, np.uint8))
    assert len(boxes) == len(class_ids) == len(scores) <= 12 * len(backend._captions)


def test_sam1_masks_equal_those_of_its_own_processor(models):
    from transformers import SamImageProcessorPil, SamModel, SamProcessor

    image = np.random.default_rng(5).integers(0, 256, (60, 90, 3)).astype(np.uint8)
    boxes = np.array([[5, 6, 50, 40], [0, 0, 90, 60], [30.5, 10.25, 80, 59]], np.float32)
    backend = GroundedSam(_tiny(models, "sam"), TABLE)
    instances = list(backend._outline(image, boxes, np.array([1, 2, 7], np.uint8), np.full(3, 0.5)))

    sizes = {"size": {"longest_edge": 128}, "pad_size": {"height": 128, "width": 128}}
    processor = SamProcessor(SamImageProcessorPil(**sizes, mask_size={"longest_edge": 32}, mask_pad_size={"height": 32, "width": 32}))
    inputs = processor(images=image, input_boxes=[boxes.tolist()], return_tensors="pt")
    output = SamModel.from_pretrained(models / "sam").eval()(**inputs, multimask_output=False)
    masks = processor.post_process_masks(output.pred_masks.detach(), inputs["original_sizes"], inputs["reshaped_input_sizes"])[0][:, 0].numpy()
    np.testing.assert_allclose([instance.mask_score for instance in instances], output.iou_scores[0, :, 0].detach(), atol=1e-4)
    assert (np.stack([instance.mask for instance in instances]) == masks).mean() > 0.999 and 0 < masks.mean() < 1


@pytest.mark.parametrize(("segmenter", "keep_aspect"), [("sam", True), ("sam2", False)])
def test_outlines_lie_where_the_boxes_are(models, segmenter, keep_aspect):
    """A stand-in for the model fills the boxes it is given in its own square frame; more boxes than go through it at once."""
    import types

    import torch

    height, width, side, cells = 120, 200, 1024, 256

    def fill(image_embeddings, input_boxes, multimask_output):
        centres = (torch.arange(cells) + 0.5) * side / cells
        left, top, right, bottom = (input_boxes[0, :, None, None, index] for index in range(4))
        inside = (centres > left) & (centres < right) & (centres[:, None] > top) & (centres[:, None] < bottom)
        return types.SimpleNamespace(pred_masks=torch.where(inside, 1.0, -1.0)[None, :, None], iou_scores=torch.full((1, len(inside), 1), 0.5))

    def embed(pixels):
        assert pixels.shape == (1, 3, side, side) and bool((pixels[0, :, 640:] == 0).all()) == keep_aspect
        return pixels

    backend = GroundedSam(_tiny(models, segmenter), TABLE)
    config = types.SimpleNamespace(prompt_encoder_config=types.SimpleNamespace(image_size=side))
    methods = {"get_image_embeddings": staticmethod(embed), "__call__": staticmethod(fill)}
    backend.__dict__["_segmenter"] = type("Filler", (), {"config": config, **methods})()
    corners = np.random.default_rng(2).uniform([0, 0], [130, 60], (20, 2))
    boxes = np.concatenate([corners, corners + np.random.default_rng(3).uniform(20, 60, (20, 2))], axis=1).astype(np.float32)
    instances = list(backend._outline(np.full((height, width, 3), 90, np.uint8), boxes, np.arange(1, 21, dtype=np.uint8), np.full(20, 0.5)))
    assert [instance.class_id for instance in instances] == list(range(1, 21))
    for instance, (left, top, right, bottom) in zip(instances, boxes, strict=True):
        rows, columns = np.nonzero(instance.mask)
        np.testing.assert_allclose([columns.min(), rows.min(), columns.max() + 1, rows.max() + 1], [left, top, right, bottom], atol=1.0)


def test_unusable_models_are_refused(models, tmp_path):
    own = Path(shutil.copytree(models, tmp_path / "models"))
    with pytest.raises(InputError, match="type 'sam2'"):
        GroundedSam(GroundedSamSettings(detector="tiny/sam2", segmenter="tiny/sam2", model_dir=own), TABLE)
    with pytest.raises(InputError, match="device 'gpu'"):
        GroundedSam(GroundedSamSettings(detector="tiny/dino", segmenter="tiny/sam2", model_dir=own, device="gpu"), TABLE)
    photo = np.zeros((20, 30, 3), np.uint8)
    weights = own / "sam2" / "model.safetensors"
    weights.write_text("version https://git-lfs.github.com/spec/v1")
    with pytest.raises(InputError, match="cannot load the model in .*sam2"):
        GroundedSam(_tiny(own, "sam2"), TABLE).segment(photo)
    from safetensors.torch import load_file, save_file

    tensors = load_file(models / "sam2" / "model.safetensors")
    tensors.pop(sorted(tensors)[0])
    save_file(tensors, weights, metadata={"format": "pt"})
    with pytest.raises(InputError, match="incomplete"):
        GroundedSam(_tiny(own, "sam2"), TABLE).segment(photo)
    weights.rename(weights.with_name("pytorch_model.bin"))
    with pytest.raises(InputError, match="not on this machine"):
        GroundedSam(_tiny(own, "sam2"), TABLE)


def test_code_in_a_model_folder_is_not_run(models, tmp_path):
    own = Path(shutil.copytree(models, tmp_path / "models"))
    for name, base in (("dino", "GroundingDinoForObjectDetection"), ("sam2", "Sam2Model")):
        config = json.loads((own / name / "config.json").read_text())
        config["auto_map"] = {"AutoConfig": "evil.Config", "AutoModel": f"evil.{base}", "AutoTokenizer": ["evil.Tokenizer", "evil.Tokenizer"]}
        (own / name / "config.json").write_text(json.dumps(config))
        (own / name / "evil.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'w')")
    GroundedSam(_tiny(own, "sam2"), TABLE).segment(np.zeros((20, 30, 3), np.uint8))
    assert not (tmp_path / "ran").exists()
