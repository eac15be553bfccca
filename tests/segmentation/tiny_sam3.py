"""Pytest plugin: the tiny models of `conftest.py`, with SAM 3 beside them and small detector images. A test
module says `pytest_plugins = "tests.segmentation.tiny_sam3"`.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

SIDE = 112  # of the square image that the tiny SAM 3 takes, px


@pytest.fixture(scope="session")
def tiny_sam3(tiny_models: Path) -> Path:
    """Folder of tiny random-weight models: those of `tiny_models`, `sam3`, and `sam3_video`, the form in
    which the hub has SAM 3 (3 MB more).
    """
    import torch

    # Detectors on the hub say so in their folder as well; the default of 800 px would make every test wait
    (tiny_models / "dino" / "preprocessor_config.json").write_text(
        json.dumps({"size": {"shortest_edge": 77, "longest_edge": 128}})
    )
    torch.manual_seed(0)
    _save_sam3(tiny_models)
    return tiny_models


@pytest.fixture
def models(tiny_sam3: Path) -> Iterator[Path]:
    """The folder, on one thread: threads would wait for one another longer than they compute, above all on a
    busy machine.
    """
    import torch

    num_threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield tiny_sam3
    torch.set_num_threads(num_threads)


def _save_sam3(folder: Path) -> None:
    import torch
    from transformers import Sam3Config, Sam3Model, Sam3VideoConfig, Sam3VideoModel

    size = {"hidden_size": 32, "num_layers": 1, "num_attention_heads": 2, "intermediate_size": 32}
    vision = {
        "backbone_config": {
            "model_type": "sam3_vit_model",
            "hidden_size": 32,
            "intermediate_size": 32,
            "num_hidden_layers": 2,
            "num_attention_heads": 2,
            "image_size": SIDE,
            "patch_size": 14,
            "window_size": 4,
            "global_attn_indexes": [1],
            "pretrain_image_size": 56,
        },
        "fpn_hidden_size": 32,
        "backbone_feature_sizes": [[32, 32], [16, 16], [8, 8]],
    }
    detector = {
        "vision_config": vision,
        "geometry_encoder_config": size,
        "detr_encoder_config": size,
        "detr_decoder_config": size | {"num_layers": 2, "num_queries": 12},
        "mask_decoder_config": {"hidden_size": 32, "num_attention_heads": 2},
        "text_config": {
            "model_type": "clip_text_model",
            "vocab_size": 600,
            "hidden_size": 32,
            "intermediate_size": 32,
            "projection_dim": 16,
            "num_hidden_layers": 1,
            "num_attention_heads": 2,
            "max_position_embeddings": 32,
            "bos_token_id": 512,
            "eos_token_id": 513,
            "pad_token_id": 513,
        },
    }
    model = Sam3Model(Sam3Config(**detector))
    # spread the random outputs, so that some masks, scores and areas pass the thresholds and others do not
    with torch.no_grad():
        for name, scale in (
            ("mask_decoder.mask_embedder", 8.0),
            ("mask_decoder.semantic_projection", 8.0),
            ("dot_product_scoring", 6.0),
        ):
            for key, values in model.named_parameters():
                if key.startswith(name):
                    values *= scale
    tracker = {
        "model_type": "sam3_tracker_video",
        "vision_config": {"model_type": "sam3_vision_model"} | vision,
        "prompt_encoder_config": {"hidden_size": 32, "image_size": SIDE, "mask_input_channels": 4},
        "mask_decoder_config": {
            "hidden_size": 32,
            "mlp_dim": 32,
            "num_attention_heads": 2,
            "iou_head_hidden_dim": 32,
        },
        "memory_attention_hidden_size": 32,
        "memory_attention_num_layers": 1,
        "memory_attention_feed_forward_hidden_size": 32,
        "memory_encoder_hidden_size": 32,
        "memory_encoder_output_channels": 8,
        "mask_downsampler_embed_dim": 32,
        "memory_fuser_embed_dim": 32,
        "memory_fuser_intermediate_dim": 32,
        "memory_attention_rope_feat_sizes": [8, 8],
    }
    video = Sam3VideoModel(
        Sam3VideoConfig(detector_config={"model_type": "sam3"} | detector, tracker_config=tracker)
    )
    video.detector_model.load_state_dict(model.state_dict())
    tokenizer = _clip_tokenizer(["building", "house", "roof", "road", "tree", "parking", "lot"])
    for name, saved in (("sam3", model), ("sam3_video", video)):
        saved.save_pretrained(folder / name)
        tokenizer.save_pretrained(folder / name)


def _clip_tokenizer(words: list[str]):
    """A byte-pair tokenizer that has a token for each word, and letters for all others."""
    from transformers import CLIPTokenizer

    letters = [chr(code) for code in range(ord("a"), ord("z") + 1)]
    vocabulary = {
        text: number for number, text in enumerate([*letters, *(f"{letter}</w>" for letter in letters)])
    }
    merges = []
    for word in words:
        head, *rest = [*word[:-1], f"{word[-1]}</w>"]
        for part in rest:
            if (head, part) not in merges:
                merges.append((head, part))
            head += part
            vocabulary.setdefault(head, len(vocabulary))
    return CLIPTokenizer(vocab=vocabulary | {"<|startoftext|>": 512, "<|endoftext|>": 513}, merges=merges)
