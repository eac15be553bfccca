"""Fixtures that several test files share."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

# Files that take 10 s and more, about the longest first, as `bash tools/test.sh --durations=0` counts them. Kernels are
# compiled by whoever first needs them: the first two need others, and those in the browser find them compiled.
LONG = (
    "tests/end_to_end/test_chain.py",
    "tests/robustness/test_interrupted.py",
    "tests/tiling/test_tiling.py",
    "tests/view/web/test_questions.py",
    "tests/robustness/test_security.py",
    "tests/splatting/test_steady_sums.py",
    "tests/stereo/test_depth_stage.py",
    "tests/robustness/test_fuzz.py",
    "tests/view/web/test_corrections.py",
    "tests/tools/test_tables.py",
    "tests/robustness/test_clouds.py",
    "tests/tiling/test_site_model.py",
    "tests/end_to_end/test_examples.py",
    "tests/report/test_report.py",
    "tests/splatting/test_blocks.py",
    "tests/view/web/test_measure.py",
    "tests/view/test_screenshot.py",
    "tests/robustness/test_annotations.py",
    "tests/georeferencing/test_georeference.py",
    "tests/robustness/test_platforms.py",
    "tests/stereo/test_patch_match.py",
    "tests/view/web/test_page.py",
    "tests/robustness/test_environment.py",
    "tests/splatting/test_trainer.py",
    "tests/annotate/test_annotate.py",
    "tests/annotate/test_suggest.py",
    "tests/synthetic/test_street.py",
    "tests/splatting/test_median_depth.py",
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Long files first: a worker that begins one at the end works on alone."""
    place = {name: row for row, name in enumerate(LONG)}
    items.sort(key=lambda item: place.get(item.nodeid.partition("::")[0], len(LONG)))


@pytest.fixture(scope="session", autouse=True)
def fsync() -> Iterator[Callable[[int], None]]:
    """The real `os.fsync`. Nothing waits here until a disk has what was written: tests kill processes, whose writes
    stay, not machines. The processes that tests start do wait.
    """
    real = os.fsync
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda _: None)
        yield real


@pytest.fixture(scope="module")
def one_thread():
    """Threads cost more than they give on photos this small, above all on a busy machine."""
    import numba
    import torch

    before = torch.get_num_threads(), numba.get_num_threads()
    torch.set_num_threads(1)
    numba.set_num_threads(1)
    yield
    torch.set_num_threads(before[0])
    numba.set_num_threads(before[1])


@pytest.fixture(scope="session")
def tiny_models(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of tiny random-weight models, saved like those of the hub: `dino`, `sam`, `sam2` and
    `sam2_video` (about 3 MB).
    """
    pytest.importorskip("transformers")
    import torch

    folder = tmp_path_factory.mktemp("models")
    torch.manual_seed(0)
    _save_grounding_dino(folder / "dino")
    _save_sam(folder / "sam")
    _save_sam2(folder)
    return folder


def _save_grounding_dino(path: Path) -> None:
    import torch
    from transformers import (
        BertConfig,
        BertTokenizer,
        GroundingDinoConfig,
        GroundingDinoForObjectDetection,
        SwinConfig,
    )

    words = ["building", "house", "roof", "road", "parking", "lot", "tree", "grass", "solar", "panel", "##s"]
    vocabulary = [f"[unused{index}]" for index in range(1100)]
    vocabulary[0], vocabulary[100:104] = "[PAD]", ["[UNK]", "[CLS]", "[SEP]", "[MASK]"]
    # the ids of bert-base-uncased: Grounding DINO has them built in as separators
    vocabulary[1012], vocabulary[1029] = ".", "?"
    vocabulary[1040 : 1040 + len(words)] = words
    tokenizer = BertTokenizer(
        vocab={word: index for index, word in enumerate(vocabulary)}, do_lower_case=True
    )
    swin = SwinConfig(
        image_size=64,
        embed_dim=8,
        depths=[1, 1, 1, 1],
        num_heads=[1, 1, 1, 1],
        window_size=4,
        out_indices=[2, 3, 4],
    )
    bert = BertConfig(
        vocab_size=len(vocabulary),
        hidden_size=32,
        num_hidden_layers=1,
        num_attention_heads=2,
        intermediate_size=32,
    )
    config = GroundingDinoConfig(
        backbone_config=swin,
        text_config=bert,
        d_model=32,
        num_queries=12,
        encoder_layers=1,
        decoder_layers=2,
        encoder_ffn_dim=32,
        decoder_ffn_dim=32,
        encoder_attention_heads=2,
        decoder_attention_heads=2,
        max_text_len=32,
    )
    model = GroundingDinoForObjectDetection(config)
    with torch.no_grad():
        model.model.decoder.layer_norm.weight *= 0.05  # else random scores are all 0 or 1
    model.save_pretrained(path)
    tokenizer.save_pretrained(path)


def _save_sam(path: Path) -> None:
    from transformers import SamConfig, SamModel

    config = SamConfig(
        vision_config=dict(
            hidden_size=32,
            output_channels=32,
            num_hidden_layers=2,
            num_attention_heads=2,
            image_size=128,
            window_size=4,
            global_attn_indexes=[1],
            num_pos_feats=16,
            mlp_dim=32,
            initializer_range=0.02,
        ),
        prompt_encoder_config=dict(hidden_size=32, image_size=128, mask_input_channels=4),
        mask_decoder_config=dict(hidden_size=32, mlp_dim=32, num_attention_heads=2, iou_head_hidden_dim=32),
    )
    _save_sure(SamModel(config), path)


def _save_sam2(folder: Path) -> None:
    from transformers import Sam2Config, Sam2Model, Sam2VideoConfig, Sam2VideoModel

    parts = dict(
        vision_config=dict(
            backbone_config=dict(
                model_type="sam2_hiera_det_model",
                hidden_size=8,
                image_size=[128, 128],
                blocks_per_stage=[1, 1, 2, 1],
                embed_dim_per_stage=[8, 16, 32, 64],
                num_attention_heads_per_stage=[1, 1, 2, 2],
                window_size_per_stage=[4, 4, 4, 4],
                global_attention_blocks=[3],
            ),
            backbone_channel_list=[64, 32, 16, 8],
            backbone_feature_sizes=[[32, 32], [16, 16], [8, 8]],
            fpn_hidden_size=32,
        ),
        prompt_encoder_config=dict(hidden_size=32, image_size=128, mask_input_channels=4),
        mask_decoder_config=dict(hidden_size=32, mlp_dim=32, num_attention_heads=2, iou_head_hidden_dim=32),
    )
    _save_sure(Sam2Model(Sam2Config(**parts)), folder / "sam2")
    # The hub's SAM 2 weights are video models ("model_type": "sam2_video") of which photos need the image
    # part only
    memory = dict(
        memory_attention_hidden_size=32,
        memory_attention_num_layers=1,
        memory_attention_feed_forward_hidden_size=32,
        memory_encoder_hidden_size=32,
        memory_encoder_output_channels=8,
        mask_downsampler_embed_dim=32,
        memory_fuser_embed_dim=32,
        memory_fuser_intermediate_dim=32,
        memory_attention_rope_feat_sizes=[8, 8],
    )
    _save_sure(Sam2VideoModel(Sam2VideoConfig(**parts, **memory)), folder / "sam2_video")


def _save_sure(model, path: Path) -> None:
    """Save a SAM model whose mask scores are near 0.8; random ones may all be negative, which means no mask."""
    import torch

    with torch.no_grad():
        model.mask_decoder.iou_prediction_head.proj_out.bias.fill_(0.8)
    model.save_pretrained(path)
