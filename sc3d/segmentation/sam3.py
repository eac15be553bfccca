"""Text-prompted masks with SAM 3: every prompt is a concept, of which the model outlines all instances in one
pass.
"""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from sc3d.errors import InputError
from sc3d.scene.class_table import ClassTable
from sc3d.segmentation.instances import Areas, Instance, paint_areas
from sc3d.segmentation.models import (
    HALVES,
    PromptedSegmenter,
    enlarge,
    load_model,
    load_tokenizer,
    outline,
    to_pixels,
)
from sc3d.segmentation.rle import Window
from sc3d.segmentation.text_prompts import Prompt
from sc3d.segmentation.tiled_inference import Findings
from sc3d.settings.labels import Segment

if TYPE_CHECKING:
    import torch

# the hub's weights are a video model, of which photos need the detector
_MODELS = {"sam3": "Sam3Model", "sam3_video": "Sam3Model"}
_MASK_THRESHOLD = 0.5  # of the probability that a pixel belongs to an object or a concept


class _Concept(NamedTuple):
    """A prompt as the model reads it: its text features, and which of its (1, T) tokens are no padding."""

    prompt: Prompt
    features: Any
    attention_mask: torch.Tensor


class Sam3(PromptedSegmenter):
    """SAM 3. The confidence of an instance is its detection score x the mean probability of its pixels.

    Pixels without an instance take the class whose concept the model sees there (its semantic output), with
    presence x probability as confidence.
    """

    def __init__(self, settings: Segment, class_table: ClassTable) -> None:
        super().__init__("sam3", settings, class_table)
        self.path = self._find_model(settings.concept_model, _MODELS)

    def find(self, image: np.ndarray) -> Findings:
        """Instances and areas of all classes in an (H, W, 3) uint8 RGB image, in one look: image features are
        computed once for all prompts.
        """
        shape = image.shape[:2]
        side = int(self._model.config.image_size)
        instances, areas = [], Areas(np.zeros(shape, np.uint8), np.zeros(shape, np.uint8))
        with self._inference():
            features = self._model.get_vision_features(to_pixels(image, (side, side), HALVES, self._device))
            for concept in self._concepts:
                output = self._model(
                    vision_embeds=features,
                    text_embeds=concept.features,
                    attention_mask=concept.attention_mask,
                )
                presence = float(output.presence_logits.float().sigmoid())
                instances += self._instances(output, presence, concept.prompt, shape)
                if presence > self._settings.box_threshold:
                    _paint_concept(
                        areas, output.semantic_seg[0, 0].float().sigmoid(), presence, concept.prompt.class_id
                    )
        return Findings(instances, areas)

    @cached_property
    def _model(self) -> Any:
        return load_model(self.path, _MODELS, self._device)

    @cached_property
    def _concepts(self) -> list[_Concept]:
        """Text features of all prompts; they serve all photos."""
        tokenizer, length = (
            load_tokenizer(self.path, "CLIPTokenizer"),
            self._model.config.text_config.max_position_embeddings,
        )
        concepts = []
        for prompt in self._prompts:
            tokens = tokenizer(prompt.text, padding="max_length", max_length=length, return_tensors="pt").to(
                self._device
            )
            if tokens["input_ids"].shape[1] > length:
                raise InputError(
                    f"the prompt {prompt.text[:40]!r} is longer than the {length} tokens that SAM 3 reads: shorten it"
                )
            with self._inference():
                features = self._model.get_text_features(
                    tokens["input_ids"], tokens["attention_mask"], return_dict=True
                )
            concepts.append(_Concept(prompt, features, tokens["attention_mask"]))
        return concepts

    def _instances(
        self, output: Any, presence: float, prompt: Prompt, shape: tuple[int, int]
    ) -> list[Instance]:
        """Instances of one concept whose score, query probability x presence, exceeds the box threshold."""
        scores = output.pred_logits[0].float().sigmoid().cpu().numpy() * presence
        instances = []
        for number in np.flatnonzero(scores > self._settings.box_threshold):
            probabilities = output.pred_masks[0, number].float().sigmoid()
            inside = probabilities[probabilities > _MASK_THRESHOLD]
            if len(inside):
                runs = outline(probabilities, _MASK_THRESHOLD, shape)
                instances.append(
                    Instance(
                        runs, shape, prompt.class_id, float(scores[number]), float(inside.mean()), prompt.text
                    )
                )
        return instances


def _paint_concept(areas: Areas, probabilities: torch.Tensor, presence: float, class_id: int) -> None:
    """Add the pixels where a concept is likelier than not, each with its own confidence, presence x
    probability.
    """
    patch = enlarge(probabilities, _MASK_THRESHOLD, areas.labels.shape)
    height, width = patch.values.shape
    values = patch.values.cpu().numpy()
    confidence = np.maximum(np.rint(255 * presence * values).astype(np.uint8), 1)
    confidence[values <= _MASK_THRESHOLD] = 0
    window = Window(patch.left, patch.top, patch.left + width, patch.top + height)
    paint_areas(areas, Areas(np.full_like(confidence, class_id), confidence), window)
