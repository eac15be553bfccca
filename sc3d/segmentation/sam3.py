"""Text-prompted masks with SAM 3: every prompt is a concept, of which the model outlines all instances in one
pass.
"""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from sc3d.errors import InputError
from sc3d.scene.class_table import ClassTable
from sc3d.segmentation.instances import Areas, Instance, paint
from sc3d.segmentation.models import (
    HALVES,
    check_packages,
    check_settings,
    choose_device,
    enlarge,
    find_weights,
    inference,
    load_model,
    load_tokenizer,
    model_type,
    outline,
    to_pixels,
)
from sc3d.segmentation.rle import Window
from sc3d.segmentation.segment import Segmentation
from sc3d.segmentation.text_prompts import Prompt, list_prompts
from sc3d.segmentation.tiled_inference import Findings, segment_tiled
from sc3d.settings.labels import Segment

if TYPE_CHECKING:
    import torch

# the hub's weights are a video model, of which photos need the detector
_MODELS = {"sam3": "Sam3Model", "sam3_video": "Sam3Model"}
_MASK_THRESHOLD = 0.5  # of the probability that a pixel belongs to an object or a concept


class _Concept(NamedTuple):
    """A prompt as the model reads it: its text features, and which of its (1, T) tokens are no padding."""

    prompt: Prompt
    features: object
    attention_mask: torch.Tensor


class Sam3:
    """Segmenter for the classes of a table, by their prompts; the model is loaded for the first photo."""

    def __init__(self, settings: Segment, class_table: ClassTable) -> None:
        """Find packages and weights; raises MissingPackageError or InputError at once if something is
        missing.
        """
        check_packages("sam3")
        check_settings(settings)
        self._settings = settings
        self._prompts = list_prompts(class_table)
        self._device = choose_device(settings)
        self.path = find_weights(settings.concept_model, settings.model_dir, settings.download)
        if model_type(self.path) not in _MODELS:
            raise InputError(
                f"{self.path} holds a model of type {model_type(self.path)!r}; possible here: {', '.join(_MODELS)}"
            )

    def segment(self, image: np.ndarray) -> Segmentation:
        """Segment a photo, (H, W, 3) uint8 RGB.

        The confidence of an instance is its detection score x the mean probability of its pixels. Pixels
        without an instance take the class
        whose concept the model sees there (its semantic output), with presence x probability as confidence.
        """
        return segment_tiled(image, self.find, self._settings.tile, self._settings.overlap)

    def find(self, image: np.ndarray) -> Findings:
        """Instances and areas of all classes in an (H, W, 3) uint8 RGB image, in one look: image features are
        computed once for all prompts.
        """
        shape = image.shape[:2]
        side = int(self._model.config.image_size)
        instances, areas = [], Areas(np.zeros(shape, np.uint8), np.zeros(shape, np.uint8))
        with inference(self._device, self._settings.half):
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
    def _model(self) -> torch.nn.Module:
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
            with inference(self._device, self._settings.half):
                features = self._model.get_text_features(
                    tokens["input_ids"], tokens["attention_mask"], return_dict=True
                )
            concepts.append(_Concept(prompt, features, tokens["attention_mask"]))
        return concepts

    def _instances(
        self, output: object, presence: float, prompt: Prompt, shape: tuple[int, int]
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
    confidence = np.where(values > _MASK_THRESHOLD, np.rint(255 * presence * values), 0).astype(np.uint8)
    confidence[values > _MASK_THRESHOLD] = np.maximum(confidence[values > _MASK_THRESHOLD], 1)
    paint(areas, class_id, confidence, Window(patch.left, patch.top, patch.left + width, patch.top + height))
