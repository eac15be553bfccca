"""Text-prompted masks: Grounding DINO finds boxes, SAM 2 or SAM 1 outlines what is in them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sc3d.classes import ClassTable
from sc3d.errors import InputError, MissingPackageError
from sc3d.segmentation.merge import Instance, merge_instances
from sc3d.segmentation.prompts import Caption, build_captions, list_prompts, match_classes
from sc3d.segmentation.run import Segmentation
from sc3d.segmentation.weights import find_weights, model_type

if TYPE_CHECKING:
    import torch

# Model types by configuration, and the class that loads them. SAM 2 on the hub is saved as a video model; photos need its image part only.
_DETECTORS = {"grounding-dino": "GroundingDinoForObjectDetection", "mm-grounding-dino": "MMGroundingDinoForObjectDetection"}
_SEGMENTERS = {"sam": "SamModel", "sam2": "Sam2Model", "sam2_video": "Sam2Model"}
_BOXES_AT_ONCE = 16  # SAM's mask decoder takes about 30 MB per box


@dataclass(frozen=True)
class GroundedSamSettings:
    """Settings of the `grounded-sam` backend."""

    box_threshold: float = 0.3
    """Detections that match no prompt better than this are dropped (0 to 1)."""
    text_threshold: float = 0.25
    """Words of a prompt that match a detection no better than this do not count when its class is chosen (0 to 1)."""
    detector: str = "IDEA-Research/grounding-dino-tiny"
    """Hub name of the Grounding DINO model that finds boxes."""
    segmenter: str = "facebook/sam2.1-hiera-small"
    """Hub name of the SAM 2 or SAM 1 model that outlines them."""
    model_dir: Path | None = None
    """Folder with downloaded models, in subfolders <model> or <owner>/<model>; looked at before the hub's cache."""
    download: bool = False
    """Download models that are not on this machine."""
    device: str = "auto"
    """Where the models run: auto (CUDA if there is one, else the CPU), cpu, cuda, cuda:1, ..."""
    max_size: int = 1333
    """Longest side of the photo that the detector sees, px; larger finds smaller things and takes longer."""

    def __post_init__(self) -> None:
        for name in ("box_threshold", "text_threshold"):
            if not 0 <= getattr(self, name) < 1:
                raise InputError(f"{name} is {getattr(self, name)}, but must be from 0 to below 1")
        if self.max_size < 64:
            raise InputError(f"max_size is {self.max_size} px, but must be at least 64")


class GroundedSam:
    """Segmenter for the classes of a table, by their prompts; models are loaded for the first photo."""

    def __init__(self, settings: GroundedSamSettings, class_table: ClassTable) -> None:
        """Find packages and weights; raises MissingPackageError or InputError at once if something is missing."""
        _check_packages()
        self._settings = settings
        self._prompts = list_prompts(class_table)
        self._device = _choose_device(settings.device)
        self.detector_path = find_weights(settings.detector, settings.model_dir, settings.download)
        self.segmenter_path = find_weights(settings.segmenter, settings.model_dir, settings.download)
        self._segmenter_type = model_type(self.segmenter_path)
        for path, known in ((self.detector_path, _DETECTORS), (self.segmenter_path, _SEGMENTERS)):
            if model_type(path) not in known:
                raise InputError(f"{path} holds a model of type {model_type(path)!r}; possible here: {', '.join(known)}")

    def segment(self, image: np.ndarray) -> Segmentation:
        """Segment a photo.

        image: (H, W, 3) uint8 RGB
        returns: (H, W) uint8 class id, 0 = unlabelled; (H, W) uint8 confidence, box score x mask score, 255 = sure, 0 where unlabelled
        """
        boxes, class_ids, box_scores = self.detect(image)
        return Segmentation(*merge_instances(self._outline(image, boxes, class_ids, box_scores), image.shape[:2]))

    def detect(self, image: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Find boxes of all classes.

        image: (H, W, 3) uint8 RGB
        returns: (N, 4) float32 left, top, right, bottom, px, within the photo; (N,) uint8 class id; (N,) float64 score 0 to 1
        """
        pixels = self._detector_pixels(image)
        found = [self._detect_caption(pixels, caption) for caption in self._captions]
        boxes, class_ids, scores = (np.concatenate(parts) for parts in zip(*found, strict=True))
        height, width = image.shape[:2]
        boxes = np.clip(boxes, 0, 1) * np.array([width, height, width, height], np.float32)
        kept = (class_ids > 0) & (boxes[:, 2:] - boxes[:, :2] >= 1).all(axis=1)
        return boxes[kept], class_ids[kept], scores[kept]

    @cached_property
    def _detector(self) -> torch.nn.Module:
        return _load_model(self.detector_path, _DETECTORS, self._device)

    @cached_property
    def _segmenter(self) -> torch.nn.Module:
        return _load_model(self.segmenter_path, _SEGMENTERS, self._device)

    @cached_property
    def _captions(self) -> list[Caption]:
        from transformers import AutoTokenizer

        try:
            tokenizer = AutoTokenizer.from_pretrained(self.detector_path, local_files_only=True, trust_remote_code=False)
        except Exception as error:
            raise InputError(f"cannot load the tokenizer in {self.detector_path}: {_first_line(error)}") from None
        # Prompts are tokenized one by one, so that it is known which tokens belong to which; a caption gives the same tokens.
        tokens = [(prompt, tokenizer(prompt.text, add_special_tokens=False)["input_ids"]) for prompt in self._prompts]
        stop = tokenizer.convert_tokens_to_ids(".")
        return build_captions(tokens, tokenizer.cls_token_id, stop, tokenizer.sep_token_id, self._detector.config.max_text_len)

    def _detector_pixels(self, image: np.ndarray) -> torch.Tensor:
        """The photo as Grounding DINO was trained: shorter side 800 px, unless the longer one then passes 1333 px; scaled to `max_size`."""
        height, width = image.shape[:2]
        scale = min(self._settings.max_size * 800 / 1333 / min(height, width), self._settings.max_size / max(height, width))
        return _to_pixels(image, max(1, round(width * scale)), max(1, round(height * scale)), self._device)

    def _detect_caption(self, pixels: torch.Tensor, caption: Caption) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """All (N, 4) boxes in 0 to 1, their class or 0, and their score."""
        import torch

        ids = torch.tensor([caption.token_ids], device=self._device)
        with torch.inference_mode():
            output = self._detector(pixel_values=pixels, input_ids=ids, token_type_ids=torch.zeros_like(ids), attention_mask=torch.ones_like(ids))
        token_scores = output.logits[0].sigmoid().cpu().numpy()
        centres, sizes = output.pred_boxes[0].cpu().numpy().reshape(-1, 2, 2).transpose(1, 0, 2)
        class_ids, scores = match_classes(token_scores, caption, self._settings.box_threshold, self._settings.text_threshold)
        return np.concatenate([centres - sizes / 2, centres + sizes / 2], axis=1), class_ids, scores

    def _outline(self, image: np.ndarray, boxes: np.ndarray, class_ids: np.ndarray, box_scores: np.ndarray) -> Iterator[Instance]:
        """One instance per box, a few at a time, so that memory does not grow with their number."""
        import torch

        if not len(boxes):
            return
        height, width = image.shape[:2]
        side = _image_side(self._segmenter)
        inner = _inner_size(width, height, side, keep_aspect=self._segmenter_type == "sam")
        scaled = torch.from_numpy(boxes * (np.array(inner * 2, np.float32) / np.array([width, height] * 2, np.float32))).to(self._device)
        pixels = torch.nn.functional.pad(_to_pixels(image, *inner, self._device), (0, side - inner[0], 0, side - inner[1]))
        embeddings = self._segmenter.get_image_embeddings(pixels)
        for start in range(0, len(boxes), _BOXES_AT_ONCE):
            part = slice(start, start + _BOXES_AT_ONCE)
            with torch.no_grad():  # closed before the yield: a generator would leave it switched on for its caller
                output = self._segmenter(image_embeddings=embeddings, input_boxes=scaled[None, part], multimask_output=False)
            scores = output.iou_scores[0, :, 0].tolist()
            for logits, class_id, box_score, score in zip(output.pred_masks[0, :, 0], class_ids[part], box_scores[part], scores, strict=True):
                yield Instance(_to_mask(logits, side, inner, (height, width)), int(class_id), float(box_score), score)


def _to_pixels(image: np.ndarray, width: int, height: int, device: str) -> torch.Tensor:
    """(1, 3, height, width) float32 of a photo, resized with antialiasing and normalised with the ImageNet statistics, as all these models want.

    Done here rather than by the models' own processors: those of SAM 2 need torchvision, and results would differ with and without it.
    """
    import torch
    from PIL import Image

    resized = np.asarray(Image.fromarray(image).resize((width, height), Image.Resampling.BILINEAR), np.float32) / 255
    normalised = (resized - np.array([0.485, 0.456, 0.406], np.float32)) / np.array([0.229, 0.224, 0.225], np.float32)
    return torch.from_numpy(normalised.transpose(2, 0, 1)[None].copy()).to(device)


def _image_side(segmenter: torch.nn.Module) -> int:
    """Side of the square image that a SAM model takes, px."""
    size = segmenter.config.prompt_encoder_config.image_size
    return int(size if isinstance(size, int) else size[0])


def _inner_size(width: int, height: int, side: int, keep_aspect: bool) -> tuple[int, int]:
    """(width, height) px of the photo within the square of a SAM model: SAM 1 pads it right and below, SAM 2 stretches it."""
    if not keep_aspect:
        return side, side
    scale = side / max(width, height)
    return max(1, int(width * scale + 0.5)), max(1, int(height * scale + 0.5))


def _to_mask(logits: torch.Tensor, side: int, inner: tuple[int, int], shape: tuple[int, int]) -> np.ndarray:
    """(H, W) bool mask of the photo from the low-resolution logits of the whole square."""
    from torch.nn.functional import interpolate

    logits = logits[None, None].float()
    if inner != (side, side):  # cut off the padding
        logits = interpolate(logits, (side, side), mode="bilinear", align_corners=False)[..., : inner[1], : inner[0]]
    return (interpolate(logits, shape, mode="bilinear", align_corners=False)[0, 0] > 0).cpu().numpy()


def _load_model(path: Path, classes: dict[str, str], device: str) -> torch.nn.Module:
    """Load a model for inference: safetensors only, from this machine only; InputError if the weights are damaged or incomplete."""
    import transformers
    from transformers.utils import logging

    model_class = getattr(transformers, classes[model_type(path)])
    verbosity, progress = logging.get_verbosity(), logging.is_progress_bar_enabled()
    logging.set_verbosity_error()  # else it warns that a sam2_video model is loaded as sam2, which is meant
    logging.disable_progress_bar()
    try:
        model, report = model_class.from_pretrained(
            path, local_files_only=True, use_safetensors=True, trust_remote_code=False, output_loading_info=True, dtype="float32",
        )
    except Exception as error:  # OSError, ValueError, RuntimeError, SafetensorError, TypeError: whatever a damaged file brings about
        raise InputError(f"cannot load the model in {path}: {_first_line(error)}; download it again") from None
    finally:
        logging.set_verbosity(verbosity)
        if progress:
            logging.enable_progress_bar()
    if report["missing_keys"]:  # those would silently be random
        raise InputError(f"the weights in {path} are incomplete ({sorted(report['missing_keys'])[0]} is missing): download the model again")
    return model.to(device).eval()


def _check_packages() -> None:
    from importlib.metadata import PackageNotFoundError, version

    for package, oldest in (("torch", 2), ("transformers", 5)):
        try:
            found = version(package)
        except PackageNotFoundError:
            raise MissingPackageError(f"the grounded-sam backend needs {package}: pip install 'sc3d[masks]'") from None
        if int(found.split(".")[0]) < oldest:
            raise MissingPackageError(f"the grounded-sam backend needs {package} {oldest} or newer, not {found}: pip install -U 'sc3d[masks]'")


def _choose_device(name: str) -> str:
    import torch

    if name == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    try:
        torch.empty(1, device=name)
    except (RuntimeError, AssertionError) as error:
        raise InputError(f"the device {name!r} cannot be used ({_first_line(error)}): choose cpu, or leave it at auto") from None
    return name


def _first_line(error: Exception) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0]
