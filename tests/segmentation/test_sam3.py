"""SAM 3: the real code on tiny random-weight models, in both forms that the hub has, against the library's
own rules written out.
"""

from __future__ import annotations

import json
import shutil
import types
from pathlib import Path

import numpy as np
import pytest

from sc3d.errors import InputError
from sc3d.scene.class_table import parse_classes
from sc3d.segmentation.instances import Areas, merge_instances
from sc3d.segmentation.models import NOTHING_FOUND
from sc3d.segmentation.rle import find_runs
from sc3d.segmentation.sam3 import Sam3, _paint_concept
from sc3d.settings.labels import Segment

pytest_plugins = "tests.segmentation.tiny_sam3"

TABLE = parse_classes(
    [
        {"id": 1, "name": "building", "color": [214, 60, 60], "prompts": ["Building", "roof"]},
        {"id": 2, "name": "road", "color": [90, 90, 90], "prompts": ["road", "parking lot"]},
        {"id": 7, "name": "tree", "color": [0, 120, 0], "prompts": ["tree"]},
    ],
    "test",
)
IMAGE = np.random.default_rng(5).integers(0, 256, (96, 128, 3)).astype(np.uint8)


def _backend(models: Path, name: str = "sam3", **changes) -> Sam3:
    changes = {"device": "cpu"} | changes
    return Sam3(
        Segment(backend="sam3", concept_model=f"tiny/{name}", model_dir=models, **changes),
        TABLE,
    )


def _library_outputs(models: Path, text: str):
    """What `Sam3Model` says of a photo and a text, prepared as its processor, which needs torchvision,
    prepares them.
    """
    import torch
    from PIL import Image
    from transformers import CLIPTokenizer, Sam3Model

    resized = (
        np.asarray(Image.fromarray(IMAGE).resize((112, 112), Image.Resampling.BILINEAR), np.float32) / 255
    )
    pixels = torch.from_numpy((resized - 0.5) / 0.5).permute(2, 0, 1)[None]
    tokens = CLIPTokenizer.from_pretrained(models / "sam3")(
        text, return_tensors="pt", padding="max_length", max_length=32
    )
    with torch.no_grad():
        return Sam3Model.from_pretrained(models / "sam3").eval()(pixel_values=pixels, **tokens)


def test_instances_and_areas_equal_the_library_rules(models):
    """The post-processing of `Sam3ImageProcessor`: score = query x presence; probabilities enlarged, then cut
    at one half.
    """
    import torch

    found = _backend(models).find(IMAGE)
    expected_areas, number = [], 0
    for text, class_id in (("building", 1), ("roof", 1), ("road", 2), ("parking lot", 2), ("tree", 7)):
        output = _library_outputs(models, text)
        presence = output.presence_logits.sigmoid()
        scores = (output.pred_logits.sigmoid() * presence)[0]
        masks = (
            torch.nn.functional.interpolate(
                output.pred_masks.sigmoid(), (96, 128), mode="bilinear", align_corners=False
            )[0].numpy()
            > 0.5
        )
        for query in torch.nonzero(scores > 0.3)[:, 0].tolist():
            if not (output.pred_masks[0, query] > 0).any():
                continue
            instance, number = found.instances[number], number + 1
            assert (instance.prompt, instance.class_id, instance.size) == (text, class_id, (96, 128))
            assert (
                instance.box_score == pytest.approx(float(scores[query]), abs=1e-4)
                and 0.5 < instance.mask_score < 1
            )
            ours = merge_instances([instance], (96, 128))[0] > 0
            assert (ours != masks[query]).mean() < 0.001
        semantic = torch.nn.functional.interpolate(
            output.semantic_seg.sigmoid(), (96, 128), mode="bilinear", align_corners=False
        )[0, 0].numpy()
        expected_areas.append(np.where(semantic > 0.5, float(presence) * semantic, 0))
    assert number == len(found.instances) > 8
    best = np.stack(expected_areas)
    labels = np.array([1, 1, 2, 2, 7])[best.argmax(axis=0)] * (best.max(axis=0) > 0)
    assert (found.areas.labels != labels).mean() < 0.01 and len(np.unique(labels)) > 2
    np.testing.assert_allclose(found.areas.confidence, 255 * best.max(axis=0), atol=1.5)


def test_image_features_are_computed_once_per_look_and_texts_once(models):
    backend, calls = _backend(models, tile=64), {"image": 0, "text": 0}
    backend._model.vision_encoder.register_forward_hook(
        lambda *_: calls.__setitem__("image", calls["image"] + 1)
    )
    backend._model.text_encoder.register_forward_hook(lambda *_: calls.__setitem__("text", calls["text"] + 1))
    backend.segment(IMAGE[:64, :64])
    assert calls == {"image": 1, "text": 5}
    label, confidence, instances = backend.segment(IMAGE)  # 3 x 2 tiles and the whole
    assert calls == {"image": 8, "text": 5}
    assert (
        label.shape == (96, 128)
        and ((label == 0) <= (confidence == NOTHING_FOUND)).all()
        and (confidence > 0).all()
        and not TABLE.unknown(label)
        and instances
    )


def test_the_hub_s_video_model_gives_the_same(models):
    plain, video = (_backend(models, name).segment(IMAGE) for name in ("sam3", "sam3_video"))
    np.testing.assert_array_equal(plain.labels, video.labels)
    np.testing.assert_array_equal(plain.confidence, video.confidence)
    assert len(plain.instances) == len(video.instances) > 0


def test_concepts_without_presence_or_pixels_say_nothing(models):
    backend = _backend(models, box_threshold=0.9)
    label, confidence, instances = backend.segment(IMAGE)
    assert not label.any() and (confidence == NOTHING_FOUND).all() and instances == ()


def test_outlines_lie_where_the_masks_are(models):
    """A stand-in for the model outlines a rectangle in the square that it is shown; the photo's must be the
    same rectangle in its own pixels.
    """
    import torch

    logits = torch.full((1, 3, 72, 72), -9.0)
    logits[0, 1, 18:36, 9:63] = 9.0
    output = types.SimpleNamespace(pred_logits=torch.tensor([[-4.0, 4.0, 4.0]]), pred_masks=logits)
    backend = _backend(models)
    # the third has a score but no pixels, the first no score
    (instance,) = backend._instances(output, 0.9, backend._prompts[0], (400, 800))
    np.testing.assert_allclose(instance.window, [100, 100, 700, 200], atol=2)
    assert instance.box_score == pytest.approx(
        0.9 / (1 + np.exp(-4))
    ) and instance.mask_score == pytest.approx(1 / (1 + np.exp(-9)))
    areas = Areas(np.zeros((400, 800), np.uint8), np.zeros((400, 800), np.uint8))
    _paint_concept(areas, logits[0, 1].sigmoid(), 0.5, 7)
    np.testing.assert_array_equal(find_runs(areas.labels == 7, 400), instance.runs)
    assert areas.confidence.max() == 127 and areas.confidence[areas.labels == 7].min() >= 64


def test_half_precision_stays_close(models, monkeypatch):
    """On a GPU only; the same code in bfloat16 on the CPU, with its refusal taken away, must run and find
    about the same.
    """
    import torch

    with pytest.raises(InputError, match="half precision is for CUDA GPUs"):
        _backend(models, half=True)
    monkeypatch.setattr("sc3d.segmentation.models.choose_device", lambda settings: "cpu")
    half, full, seen = _backend(models, half=True), _backend(models), []
    half._model.mask_decoder.register_forward_hook(
        lambda module, inputs, output: seen.append(output.pred_masks.dtype)
    )
    one, other = full.find(IMAGE), half.find(IMAGE)
    assert seen == [torch.bfloat16] * 5 and abs(len(one.instances) - len(other.instances)) < 4
    assert (
        abs(
            max(found.box_score for found in one.instances)
            - max(found.box_score for found in other.instances)
        )
        < 0.05
    )


def test_half_precision_on_a_gpu_stays_close(models):
    import torch

    if not torch.cuda.is_available():
        pytest.skip("no GPU")
    full, half = (_backend(models, half=half, device="cuda").find(IMAGE) for half in (False, True))
    scores = [max(found.box_score for found in areas.instances) for areas in (full, half)]
    assert abs(len(full.instances) - len(half.instances)) < 4 and abs(scores[0] - scores[1]) < 0.05


def test_long_prompts_and_other_models_are_refused(models, tmp_path):
    long_table = parse_classes([{"id": 1, "name": "x", "color": [0, 0, 0], "prompts": ["zz " * 16]}], "test")
    settings = Segment(backend="sam3", concept_model="tiny/sam3", model_dir=models, device="cpu")
    with pytest.raises(InputError, match="longer than the 32 tokens that SAM 3 reads: shorten it"):
        Sam3(settings, long_table).segment(IMAGE)
    with pytest.raises(InputError, match="type 'sam2'; possible here: sam3, sam3_video"):
        _backend(models, "sam2")
    own = Path(shutil.copytree(models / "sam3", tmp_path / "sam3")).parent
    (own / "sam3" / "tokenizer.json").write_text("{")
    with pytest.raises(InputError, match="cannot load the tokenizer in .*sam3"):
        _backend(own).segment(IMAGE)


def test_tokenizer_in_the_older_form_of_two_files(models, tmp_path):
    """`vocab.json` and `merges.txt`, as some copies of the weights have them, read the same tokens."""
    own = Path(shutil.copytree(models / "sam3", tmp_path / "sam3")).parent
    saved = json.loads((own / "sam3" / "tokenizer.json").read_text())["model"]
    for file in ("tokenizer.json", "tokenizer_config.json"):
        (own / "sam3" / file).unlink()
    (own / "sam3" / "vocab.json").write_text(json.dumps(saved["vocab"]))
    (own / "sam3" / "merges.txt").write_text(
        "#version: 0.2\n" + "".join(f"{' '.join(pair)}\n" for pair in saved["merges"])
    )
    for one, other in zip(_backend(own)._concepts, _backend(models)._concepts, strict=True):
        np.testing.assert_array_equal(one.features.pooler_output, other.features.pooler_output)


def test_code_in_a_model_folder_is_not_run(models, tmp_path):
    own = Path(shutil.copytree(models / "sam3", tmp_path / "sam3")).parent
    config = json.loads((own / "sam3" / "config.json").read_text())
    config["auto_map"] = {
        "AutoConfig": "evil.Config",
        "AutoModel": "evil.Sam3Model",
        "AutoTokenizer": ["evil.Tokenizer", "evil.Tokenizer"],
    }
    (own / "sam3" / "config.json").write_text(json.dumps(config))
    (own / "sam3" / "evil.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'w')")
    _backend(own).segment(IMAGE[:40, :50])
    assert not (tmp_path / "ran").exists()
