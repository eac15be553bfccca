"""Grounding DINO with SAM 2 or SAM 1: the real code on tiny random-weight models, against the models' own
processors.
"""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sc3d.errors import InputError
from sc3d.io.images import write_image
from sc3d.io.mask_images import read_index_image
from sc3d.scene.class_table import parse_classes
from sc3d.segmentation.grounded_sam import Detections, GroundedSam
from sc3d.segmentation.models import IMAGENET, NOTHING_FOUND, enlarge, outline, to_pixels
from sc3d.segmentation.rle import fill_runs, find_runs
from sc3d.segmentation.segment import Folders, segment_photos
from sc3d.segmentation.text_prompts import Prompt
from sc3d.settings.labels import Segment
from tests.pretend_device import PretendDevice

pytest_plugins = "tests.segmentation.tiny_sam3"

TABLE = parse_classes(
    [
        {"id": 1, "name": "building", "color": [214, 60, 60], "prompts": ["building", "roof"]},
        {"id": 2, "name": "road", "color": [90, 90, 90], "prompts": ["road", "parking lot"]},
        {"id": 7, "name": "tree", "color": [0, 120, 0], "prompts": ["Tree."]},
    ],
    "test",
)


def _tiny(models: Path, segmenter: str, **changes) -> Segment:
    return Segment(
        detector="tiny/dino", segmenter=f"tiny/{segmenter}", model_dir=models, device="cpu", **changes
    )


@pytest.mark.parametrize("segmenter", ["sam", "sam2", "sam2_video"])
def test_masks_and_instances_fit_each_other(models, tmp_path, segmenter):
    random, photos = (
        np.random.default_rng(1),
        [tmp_path / "images" / f"photo{index}.jpg" for index in range(2)],
    )
    for index, photo in enumerate(photos):
        write_image(photo, random.integers(0, 256, (48 + 16 * index, 80, 3)).astype(np.uint8))
    folders = Folders(tmp_path / "masks", tmp_path / "confidence", tmp_path / "instances")
    backend = GroundedSam(_tiny(models, segmenter, tile=64), TABLE)
    assert segment_photos(photos, folders, backend, TABLE).segmented == ["photo0.jpg", "photo1.jpg"]
    for index in range(2):
        label, confidence = (
            read_index_image(folder / f"photo{index}.png") for folder in (folders.masks, folders.confidence)
        )
        assert label.shape == confidence.shape == (48 + 16 * index, 80)
        assert not TABLE.unknown(label) and label.any()
        assert ((label == 0) <= (confidence == NOTHING_FOUND)).all() and (confidence > 0).all()
        found = json.loads((folders.instances / f"photo{index}.json").read_text())["annotations"]
        assert {int(value) for value in np.unique(label[label > 0])} <= {one["category_id"] for one in found}
        assert confidence[label > 0].max() == max(max(1, round(255 * one["score"])) for one in found)
        assert all(one["prompt"] in ("building", "roof", "road", "parking lot", "tree") for one in found)
    before = {file: file.read_bytes() for file in tmp_path.rglob("photo*.*")}
    segment_photos(
        photos, folders, GroundedSam(_tiny(models, segmenter, tile=64), TABLE), TABLE, overwrite=True
    )
    assert before == {file: file.read_bytes() for file in tmp_path.rglob("photo*.*")}


@pytest.mark.parametrize("segmenter", ["sam", "sam2"])
def test_half_precision_on_a_gpu_stays_close(models, segmenter):
    import torch

    if not torch.cuda.is_available():
        pytest.skip("no GPU")
    image = np.random.default_rng(1).integers(0, 256, (48, 80, 3)).astype(np.uint8)
    found = []
    for half in (False, True):
        settings = replace(_tiny(models, segmenter, tile=64, half=half), device="cuda")
        found.append(GroundedSam(settings, TABLE).segment(image))
    (label, confidence, _), (other, other_confidence, _) = found
    assert (label == other).mean() > 0.8
    assert abs(confidence.astype(float).mean() - other_confidence.astype(float).mean()) < 10


def test_nothing_found_is_unlabelled(models):
    label, confidence, instances = GroundedSam(_tiny(models, "sam2", box_threshold=0.9999), TABLE).segment(
        np.zeros((20, 30, 3), np.uint8)
    )
    assert (
        label.shape == (20, 30)
        and not label.any()
        and (confidence == NOTHING_FOUND).all()
        and instances == ()
    )


def test_detections_equal_those_of_the_models_own_processor(models):
    """One prompt per class, so that the library's boxes and scores must come out, and its phrases name the
    class.
    """
    from transformers import (
        AutoTokenizer,
        GroundingDinoForObjectDetection,
        GroundingDinoImageProcessorPil,
        GroundingDinoProcessor,
    )

    image = np.random.default_rng(5).integers(0, 256, (96, 128, 3)).astype(np.uint8)
    words = ["building", "parking lot", "trees"]
    table = parse_classes(
        [{"id": 3 + index, "name": word, "color": [0, 0, 0]} for index, word in enumerate(words)], "test"
    )
    backend = GroundedSam(_tiny(models, "sam2", box_threshold=0.5, text_threshold=0.0), table)
    boxes, prompts, scores = backend.detect(image)

    model = GroundingDinoForObjectDetection.from_pretrained(models / "dino").eval()
    tokenizer = AutoTokenizer.from_pretrained(models / "dino")
    processor = GroundingDinoProcessor(
        GroundingDinoImageProcessorPil(size={"shortest_edge": 77, "longest_edge": 128}), tokenizer
    )
    inputs = processor(images=image, text=[words], return_tensors="pt")
    assert inputs["input_ids"][0].tolist() == backend._captions[0].token_ids
    np.testing.assert_allclose(backend._detector_pixels(image), inputs["pixel_values"], atol=1e-5)
    output = model(**inputs)
    tokens = output.logits[0].sigmoid().detach().numpy()
    expected = processor.post_process_grounded_object_detection(
        output, inputs["input_ids"], threshold=0.5, target_sizes=[(96, 128)]
    )[0]
    spans = [slice(1, 2), slice(3, 5), slice(6, 8)]
    best = np.stack([tokens[:, span].max(axis=1) for span in spans], axis=1)
    found = best.max(axis=1) > 0.5
    mean = np.where(best > 0.5, np.stack([tokens[:, span].mean(axis=1) for span in spans], axis=1), 0)[found]
    assert 0 < len(boxes) == found.sum() <= len(expected["boxes"])
    assert prompts == [Prompt(words[number], 3 + number) for number in mean.argmax(axis=1)]
    np.testing.assert_allclose(scores, best[found][np.arange(len(scores)), mean.argmax(axis=1)], atol=1e-5)
    kept = tokens.max(axis=1) > 0.5  # the library counts special tokens as well
    np.testing.assert_allclose(
        boxes, expected["boxes"].detach().numpy()[found[kept]].clip(0, [128, 96, 128, 96]), atol=1e-3
    )


def test_long_prompt_lists_take_several_captions(models):
    words = ["building", "house", "roof", "road", "tree", "grass", "solar panel", "parking lot"]
    table = parse_classes(
        [{"id": 1, "name": "x", "color": [0, 0, 0], "prompts": [f"{a} {b}" for a in words for b in words]}],
        "test",
    )
    backend = GroundedSam(_tiny(models, "sam2"), table)
    assert len(backend._captions) > 1 and all(len(caption.token_ids) <= 32 for caption in backend._captions)
    boxes, prompts, scores = backend.detect(np.full((30, 40, 3), 128, np.uint8))
    assert len(boxes) == len(prompts) == len(scores) <= 12 * len(backend._captions)


def test_sam1_masks_equal_those_of_its_own_processor(models):
    from transformers import SamImageProcessorPil, SamModel, SamProcessor

    image = np.random.default_rng(5).integers(0, 256, (60, 90, 3)).astype(np.uint8)
    boxes = np.array([[5, 6, 50, 40], [0, 0, 90, 60], [30.5, 10.25, 80, 59]], np.float32)
    backend = GroundedSam(_tiny(models, "sam"), TABLE)
    instances = backend._outline(
        image, Detections(boxes, [Prompt("x", class_id) for class_id in (1, 2, 7)], np.full(3, 0.5))
    )

    sizes = {"size": {"longest_edge": 128}, "pad_size": {"height": 128, "width": 128}}
    processor = SamProcessor(
        SamImageProcessorPil(
            **sizes, mask_size={"longest_edge": 32}, mask_pad_size={"height": 32, "width": 32}
        )
    )
    inputs = processor(images=image, input_boxes=[boxes.tolist()], return_tensors="pt")
    output = SamModel.from_pretrained(models / "sam").eval()(**inputs, multimask_output=False)
    masks = processor.post_process_masks(
        output.pred_masks.detach(), inputs["original_sizes"], inputs["reshaped_input_sizes"]
    )[0][:, 0].numpy()
    np.testing.assert_allclose(
        [instance.mask_score for instance in instances], output.iou_scores[0, :, 0].detach(), atol=1e-4
    )
    assert (
        np.stack([_mask(instance) for instance in instances]) == masks
    ).mean() > 0.999 and 0 < masks.mean() < 1


@pytest.mark.parametrize(("segmenter", "keep_aspect"), [("sam", True), ("sam2", False)])
def test_outlines_lie_where_the_boxes_are(models, segmenter, keep_aspect):
    """A stand-in for the model fills the boxes it is given in its own square frame; more boxes than go
    through it at once.
    """
    import types

    import torch

    height, width, side, cells = 120, 200, 1024, 256

    def fill(image_embeddings, input_boxes, multimask_output):
        centers = (torch.arange(cells) + 0.5) * side / cells
        left, top, right, bottom = (input_boxes[0, :, None, None, index] for index in range(4))
        inside = (centers > left) & (centers < right) & (centers[:, None] > top) & (centers[:, None] < bottom)
        return types.SimpleNamespace(
            pred_masks=torch.where(inside, 1.0, -1.0)[None, :, None],
            iou_scores=torch.full((1, len(inside), 1), 0.5),
        )

    def embed(pixels):
        assert pixels.shape == (1, 3, side, side) and bool((pixels[0, :, 640:] == 0).all()) == keep_aspect
        return pixels

    backend = GroundedSam(_tiny(models, segmenter), TABLE)
    config = types.SimpleNamespace(prompt_encoder_config=types.SimpleNamespace(image_size=side))
    methods = {"get_image_embeddings": staticmethod(embed), "__call__": staticmethod(fill)}
    backend.__dict__["_segmenter"] = type("Filler", (), {"config": config, **methods})()
    corners = np.random.default_rng(2).uniform([0, 0], [130, 60], (20, 2))
    boxes = np.concatenate(
        [corners, corners + np.random.default_rng(3).uniform(20, 60, (20, 2))], axis=1
    ).astype(np.float32)
    prompts = [Prompt("x", class_id) for class_id in range(1, 21)]
    instances = backend._outline(
        np.full((height, width, 3), 90, np.uint8), Detections(boxes, prompts, np.full(20, 0.5))
    )
    assert [instance.class_id for instance in instances] == list(range(1, 21))
    for instance, (left, top, right, bottom) in zip(instances, boxes, strict=True):
        np.testing.assert_allclose(instance.window, [left, top, right, bottom], atol=1.0)


def test_unusable_models_are_refused(models, tmp_path):
    own = Path(shutil.copytree(models, tmp_path / "models"))
    with pytest.raises(InputError, match="type 'sam2'"):
        GroundedSam(Segment(detector="tiny/sam2", segmenter="tiny/sam2", model_dir=own), TABLE)
    with pytest.raises(InputError, match="device 'gpu'"):
        GroundedSam(Segment(detector="tiny/dino", segmenter="tiny/sam2", model_dir=own, device="gpu"), TABLE)
    with pytest.raises(InputError, match="half precision is for CUDA GPUs, but the device is cpu"):
        GroundedSam(_tiny(own, "sam2", half=True), TABLE)
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
        config["auto_map"] = {
            "AutoConfig": "evil.Config",
            "AutoModel": f"evil.{base}",
            "AutoTokenizer": ["evil.Tokenizer", "evil.Tokenizer"],
        }
        (own / name / "config.json").write_text(json.dumps(config))
        (own / name / "evil.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'w')")
    GroundedSam(_tiny(own, "sam2"), TABLE).segment(np.zeros((20, 30, 3), np.uint8))
    assert not (tmp_path / "ran").exists()


def test_detector_size_is_what_its_folder_says(models, tmp_path):
    own = Path(shutil.copytree(models, tmp_path / "models"))
    image = np.zeros((30, 40, 3), np.uint8)
    assert GroundedSam(_tiny(own, "sam2"), TABLE)._detector_pixels(image).shape == (1, 3, 77, 102)
    (own / "dino" / "processor_config.json").write_text(
        json.dumps({"image_processor": {"size": {"shortest_edge": 90, "longest_edge": 100}}})
    )
    (own / "dino" / "preprocessor_config.json").unlink()
    assert GroundedSam(_tiny(own, "sam2"), TABLE)._detector_pixels(image).shape == (1, 3, 75, 100)
    (own / "dino" / "processor_config.json").unlink()
    assert GroundedSam(_tiny(own, "sam2"), TABLE)._detector_pixels(image).shape == (1, 3, 800, 1066)


def test_enlarging_where_it_matters_equals_enlarging_everything():
    import torch

    torch.manual_seed(0)
    for shape, out, threshold in (
        ((8, 8), (50, 70), 0.0),
        ((16, 9), (10, 200), 1.0),
        ((5, 7), (5, 7), -0.5),
        ((6, 6), (40, 30), 9.0),
        ((32, 32), (61, 95), 3.2),
    ):
        values = torch.randn(shape)
        expected = torch.nn.functional.interpolate(
            values[None, None], out, mode="bilinear", align_corners=False
        )[0, 0].numpy()
        patch = enlarge(values, threshold, out)
        place = (
            slice(patch.top, patch.top + patch.values.shape[0]),
            slice(patch.left, patch.left + patch.values.shape[1]),
        )
        np.testing.assert_allclose(patch.values, expected[place], atol=1e-4)
        outside = expected > threshold
        outside[place] = False
        assert not outside.any() and (patch.values.numel() > 0) == bool((values > threshold).any())
        np.testing.assert_array_equal(
            outline(values, threshold, out), find_runs(expected > threshold, out[0])
        )
    assert patch.values.numel() < 0.9 * 61 * 95


def test_pixels_and_outlines_stay_on_their_device():
    import torch

    values, image = (
        torch.randn(16, 16, generator=torch.Generator().manual_seed(0)),
        np.full((20, 30, 3), 90, np.uint8),
    )
    with PretendDevice():
        there = outline(values.to("meta"), 0.5, (50, 70))
        pixels = to_pixels(image, (16, 8), IMAGENET, "meta")
        assert pixels.device.type == "meta" and pixels.cpu().shape == (1, 3, 8, 16)
    np.testing.assert_array_equal(there, outline(values, 0.5, (50, 70)))


@pytest.mark.parametrize("segmenter", ["sam", "sam2"])
def test_half_precision_stays_close(models, monkeypatch, segmenter):
    """On a GPU only; the same code in bfloat16 on the CPU, with its refusal taken away, must run and find
    about the same.
    """
    import torch

    image = np.random.default_rng(5).integers(0, 256, (96, 128, 3)).astype(np.uint8)
    full = GroundedSam(_tiny(models, segmenter), TABLE)
    monkeypatch.setattr("sc3d.segmentation.models.choose_device", lambda settings: "cpu")
    half = GroundedSam(_tiny(models, segmenter, half=True), TABLE)
    seen = []
    half._segmenter.mask_decoder.register_forward_hook(
        lambda module, inputs, output: seen.append(output[0].dtype)
    )
    boxes, scores = full.detect(image)[::2]
    half_boxes, half_scores = half.detect(image)[::2]
    assert abs(len(boxes) - len(half_boxes)) <= 2 and abs(scores.mean() - half_scores.mean()) < 0.05
    found = Detections(
        np.array([[5, 6, 50, 40], [0, 0, 90, 60]], np.float32), [Prompt("x", 1)] * 2, np.full(2, 0.5)
    )
    pairs = zip(full._outline(image, found), half._outline(image, found), strict=True)
    assert all(abs(one.mask_score - other.mask_score) < 0.05 for one, other in pairs) and seen == [
        torch.bfloat16
    ]


def _mask(instance) -> np.ndarray:
    whole = np.zeros(instance.size, bool)
    mask, window = fill_runs(instance.runs, instance.size[0])
    whole[window.top : window.bottom, window.left : window.right] = mask
    return whole
