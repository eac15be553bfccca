"""Text-prompted masks: Grounding DINO finds boxes, SAM 2 or SAM 1 outlines what is in them."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from sc3d.io.json_files import read_json
from sc3d.scene.class_table import ClassTable
from sc3d.segmentation.instances import Instance
from sc3d.segmentation.models import (
    IMAGENET,
    PromptedSegmenter,
    load_model,
    load_tokenizer,
    model_type,
    outline,
    to_pixels,
)
from sc3d.segmentation.text_prompts import Caption, Prompt, build_captions, match_prompts
from sc3d.segmentation.tiled_inference import Findings
from sc3d.settings.labels import Segment

if TYPE_CHECKING:
    import torch

# Model types by configuration, and the class that loads them. SAM 2 on the hub is saved as a video model;
# photos need its image part only.
_DETECTORS = {
    "grounding-dino": "GroundingDinoForObjectDetection",
    "mm-grounding-dino": "MMGroundingDinoForObjectDetection",
}
_SEGMENTERS = {"sam": "SamModel", "sam2": "Sam2Model", "sam2_video": "Sam2Model"}
_BOXES_AT_ONCE = 16  # SAM's mask decoder takes about 30 MB per box
# shorter side of the photo that Grounding DINO was trained on, and what the longer one may reach, px
_SIDES = 800, 1333


class Detections(NamedTuple):
    """Boxes in an image: (N, 4) float32 left, top, right, bottom, px; the N prompts that found them; (N,)
    float64 scores, 0 to 1.
    """

    boxes: np.ndarray
    prompts: list[Prompt]
    scores: np.ndarray


class GroundedSam(PromptedSegmenter):
    """Grounding DINO and SAM; the confidence of an instance is box score x mask score."""

    def __init__(self, settings: Segment, class_table: ClassTable) -> None:
        super().__init__("grounded-sam", settings, class_table)
        self.detector_path = self._find_model(settings.detector, _DETECTORS)
        self.segmenter_path = self._find_model(settings.segmenter, _SEGMENTERS)
        self._segmenter_type = model_type(self.segmenter_path)
        self._sides = _detector_sides(self.detector_path)

    def find(self, image: np.ndarray) -> Findings:
        """Instances of all classes in an (H, W, 3) uint8 RGB image, in one look."""
        return Findings(self._outline(image, self.detect(image)))

    def detect(self, image: np.ndarray) -> Detections:
        """Boxes of all classes in an (H, W, 3) uint8 RGB image, at least 1 px wide and high, within the
        image.
        """
        pixels = self._detector_pixels(image)
        found = [self._detect_caption(pixels, caption) for caption in self._captions]
        prompts = [prompt for part in found for prompt in part.prompts]
        height, width = image.shape[:2]
        boxes = np.clip(np.concatenate([part.boxes for part in found]), 0, 1) * np.array(
            [width, height, width, height], np.float32
        )
        kept = (boxes[:, 2:] - boxes[:, :2] >= 1).all(axis=1)
        return Detections(
            boxes[kept],
            [prompts[number] for number in np.flatnonzero(kept)],
            np.concatenate([part.scores for part in found])[kept],
        )

    @cached_property
    def _detector(self) -> Any:
        return load_model(self.detector_path, _DETECTORS, self._device)

    @cached_property
    def _segmenter(self) -> Any:
        return load_model(self.segmenter_path, _SEGMENTERS, self._device)

    @cached_property
    def _captions(self) -> list[Caption]:
        tokenizer = load_tokenizer(self.detector_path, "AutoTokenizer")
        # Prompts are tokenized one by one, so that it is known which tokens belong to which; a caption gives
        # the same tokens.
        tokens = [
            (prompt, tokenizer(prompt.text, add_special_tokens=False)["input_ids"])
            for prompt in self._prompts
        ]
        stop = tokenizer.convert_tokens_to_ids(".")
        return build_captions(
            tokens, tokenizer.cls_token_id, stop, tokenizer.sep_token_id, self._detector.config.max_text_len
        )

    def _detector_pixels(self, image: np.ndarray) -> torch.Tensor:
        """The image as Grounding DINO was trained: its shorter side 800 px, unless the longer one then passes
        1333 px.
        """
        height, width = image.shape[:2]
        scale = min(self._sides[0] / min(height, width), self._sides[1] / max(height, width))
        return to_pixels(
            image,
            (max(1, int(width * scale + 1e-6)), max(1, int(height * scale + 1e-6))),
            IMAGENET,
            self._device,
        )

    def _detect_caption(self, pixels: torch.Tensor, caption: Caption) -> Detections:
        """Boxes that match a prompt of one caption, in 0 to 1 of the image."""
        import torch

        ids = torch.tensor([caption.token_ids], device=self._device)
        with self._inference():
            output = self._detector(
                pixel_values=pixels,
                input_ids=ids,
                token_type_ids=torch.zeros_like(ids),
                attention_mask=torch.ones_like(ids),
            )
        token_scores = output.logits[0].float().sigmoid().cpu().numpy()
        numbers, scores = match_prompts(
            token_scores, caption, self._settings.box_threshold, self._settings.text_threshold
        )
        centers, sizes = output.pred_boxes[0].float().cpu().numpy().reshape(-1, 2, 2).transpose(1, 0, 2)
        found = numbers >= 0
        boxes = np.concatenate([centers - sizes / 2, centers + sizes / 2], axis=1)[found]
        return Detections(boxes, [caption.prompts[number] for number in numbers[found]], scores[found])

    def _outline(self, image: np.ndarray, found: Detections) -> list[Instance]:
        """One instance per box; a few boxes at a time, so that memory does not grow with their number."""
        import torch

        if not found.prompts:
            return []
        height, width = image.shape[:2]
        side = _image_side(self._segmenter)
        inner = _inner_size(width, height, side, keep_aspect=self._segmenter_type == "sam")
        scaled = found.boxes * (np.array(inner * 2, np.float32) / np.array([width, height] * 2, np.float32))
        pixels = torch.nn.functional.pad(
            to_pixels(image, inner, IMAGENET, self._device), (0, side - inner[0], 0, side - inner[1])
        )
        instances = []
        with self._inference():
            embeddings = self._segmenter.get_image_embeddings(pixels)
            for start in range(0, len(scaled), _BOXES_AT_ONCE):
                part = slice(start, start + _BOXES_AT_ONCE)
                boxes = torch.from_numpy(scaled[None, part]).to(self._device)
                output = self._segmenter(
                    image_embeddings=embeddings, input_boxes=boxes, multimask_output=False
                )
                scores = output.iou_scores[0, :, 0].float().tolist()
                for logits, prompt, box_score, score in zip(
                    output.pred_masks[0, :, 0], found.prompts[part], found.scores[part], scores, strict=True
                ):
                    runs = outline(_without_padding(logits.float(), side, inner), 0.0, (height, width))
                    instances.append(
                        Instance(runs, (height, width), prompt.class_id, float(box_score), score, prompt.text)
                    )
        return instances


def _detector_sides(path: Path) -> tuple[int, int]:
    """Shortest and longest side of the photo that a detector takes, px, as its folder says."""
    for file, part in (("preprocessor_config.json", None), ("processor_config.json", "image_processor")):
        if (path / file).is_file():
            config = read_json(path / file)
            size = (
                (config.get(part, {}) if part else config).get("size") if isinstance(config, dict) else None
            )
            if isinstance(size, dict) and {"shortest_edge", "longest_edge"} <= size.keys():
                return int(size["shortest_edge"]), int(size["longest_edge"])
    return _SIDES


def _image_side(segmenter: Any) -> int:
    """Side of the square image that a SAM model takes, px."""
    size = segmenter.config.prompt_encoder_config.image_size
    return int(size if isinstance(size, int) else size[0])


def _inner_size(width: int, height: int, side: int, keep_aspect: bool) -> tuple[int, int]:
    """(width, height) px of the photo within the square of a SAM model: SAM 1 pads it right and below, SAM 2
    stretches it.
    """
    if not keep_aspect:
        return side, side
    scale = side / max(width, height)
    return max(1, int(width * scale + 0.5)), max(1, int(height * scale + 0.5))


def _without_padding(logits: torch.Tensor, side: int, inner: tuple[int, int]) -> torch.Tensor:
    """(h, w) logits of the photo alone, from those of the whole square."""
    from torch.nn.functional import interpolate

    if inner == (side, side):
        return logits
    return interpolate(logits[None, None], (side, side), mode="bilinear", align_corners=False)[
        0, 0, : inner[1], : inner[0]
    ]
