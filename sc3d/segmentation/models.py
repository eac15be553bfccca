"""What the text-prompted backends share: packages, weights, device, loading models, pixels in, outlines out.

Weights are looked for on this machine; nothing is downloaded unless that is allowed.
"""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from sc3d.errors import InputError, MissingPackageError
from sc3d.io.json_files import read_json
from sc3d.scene.class_table import ClassTable
from sc3d.segmentation.rle import find_runs
from sc3d.segmentation.segment import Segmentation
from sc3d.segmentation.text_prompts import list_prompts
from sc3d.segmentation.tiled_inference import Findings, segment_tiled
from sc3d.settings.labels import Segment

if TYPE_CHECKING:
    import torch

# mean and standard deviation of RGB that Grounding DINO, SAM 1 and SAM 2 were trained with
IMAGENET = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
HALVES = (0.5, 0.5, 0.5), (0.5, 0.5, 0.5)  # the same of SAM 3
NOTHING_FOUND = 128  # confidence of pixels that are looked at and of none of the classes: no model gives one
# Only data: no pickles (*.bin, *.pt), no code (*.py).
_FILES = ["*.json", "*.txt", "*.safetensors"]
_FREE, _GATED = (
    "Apache-2.0",
    "SAM license, gated: accept it on the model's page on the hub and log in with `hf auth login`",
)
_KNOWN = {  # download size in MB, license
    "IDEA-Research/grounding-dino-tiny": (690, _FREE),
    "IDEA-Research/grounding-dino-base": (930, _FREE),
    "facebook/sam2.1-hiera-tiny": (160, _FREE),
    "facebook/sam2.1-hiera-small": (185, _FREE),
    "facebook/sam2.1-hiera-base-plus": (325, _FREE),
    "facebook/sam2.1-hiera-large": (900, _FREE),
    "facebook/sam-vit-base": (375, _FREE),
    "facebook/sam-vit-large": (1250, _FREE),
    "facebook/sam-vit-huge": (2570, _FREE),
    "facebook/sam3": (3440, _GATED),
}


class PromptedSegmenter(ABC):
    """What finds the classes of a table by their prompts; models are loaded for the first photo."""

    def __init__(self, backend: str, settings: Segment, class_table: ClassTable) -> None:
        """Find packages and a device; raises MissingPackageError or InputError at once if something is
        missing.
        """
        check_packages(backend)
        check_settings(settings)
        self._settings = settings
        self._prompts = list_prompts(class_table)
        sought = {prompt.class_id for prompt in self._prompts}
        self._looks_for_all = all(entry.id in sought for entry in class_table if entry.surface)
        self._device = choose_device(settings)

    @abstractmethod
    def find(self, image: np.ndarray) -> Findings:
        """What the models find in an (H, W, 3) uint8 RGB image, in one look."""

    def segment(self, image: np.ndarray) -> Segmentation:
        """Segment a photo, (H, W, 3) uint8 RGB, as a whole and in tiles. Pixels on which nothing is
        found, while all classes are looked for, have a confidence as well.
        """
        found = segment_tiled(image, self.find, self._settings.tile, self._settings.overlap)
        if self._looks_for_all:
            found.confidence[found.labels == 0] = NOTHING_FOUND
        return found

    def _find_model(self, name: str, classes: dict[str, str]) -> Path:
        """Folder of a model, whose type is one of `classes`."""
        path = find_weights(name, self._settings.model_dir, self._settings.download)
        if model_type(path) not in classes:
            raise InputError(
                f"{path} holds a model of type {model_type(path)!r}; possible here: {', '.join(classes)}"
            )
        return path

    def _inference(self) -> AbstractContextManager[None]:
        return inference(self._device, self._settings.half)


def find_weights(name: str, model_dir: Path | None, download: bool) -> Path:
    """Folder with the configuration and the safetensors weights of a hub model.

    name: "owner/model", as on the Hugging Face hub
    model_dir: looked at first, for `<model>` and `<owner>/<model>` in it
    download: fetch the model from the hub if neither `model_dir` nor the hub's cache has it

    Raises InputError that says where the model was looked for and how to get it.
    """
    if not re.fullmatch(r"\w[\w.-]*/\w[\w.-]*", name, re.ASCII):
        raise InputError(
            f'{name!r} is not the name of a model: it should look like "facebook/sam2.1-hiera-small"'
        )
    folders = [] if model_dir is None else [model_dir / name.split("/")[1], model_dir / name]
    found = next((folder for folder in folders if _is_model(folder)), None) or _find_cached(name)
    if found is None and download:
        found = _download(name)
    if found is None:
        raise InputError(_missing_message(name, model_dir))
    return found


def model_type(path: Path) -> str:
    """`model_type` of a model folder's configuration, such as "sam2"; "" if it names none."""
    config = read_json(path / "config.json")
    return str(config.get("model_type", "")) if isinstance(config, dict) else ""


def _is_model(folder: Path) -> bool:
    return (folder / "config.json").is_file() and any(folder.glob("*.safetensors"))


def _find_cached(name: str) -> Path | None:
    from huggingface_hub import try_to_load_from_cache

    config = try_to_load_from_cache(name, "config.json")
    folder = Path(config).parent if isinstance(config, str) else None
    return folder if folder is not None and _is_model(folder) else None


def _download(name: str) -> Path:
    from huggingface_hub import snapshot_download

    try:
        folder = Path(snapshot_download(name, allow_patterns=_FILES))
    # no network, no such model, access not granted, disk full: the hub has an error class for each
    except Exception as error:
        raise InputError(f"cannot download {name}: {first_line(error)}; {_advice(name)}") from None
    if not _is_model(folder):
        raise InputError(
            f"{name} has no safetensors weights on the hub; other formats can hold code and are not loaded: choose another model"
        )
    return folder


def _missing_message(name: str, model_dir: Path | None) -> str:
    from huggingface_hub.constants import HF_HUB_CACHE

    own = (
        "no model folder was given"
        if model_dir is None
        else f"looked for {model_dir / name.split('/')[1]} and {model_dir / name}"
    )
    size = (
        "about {} MB, {}".format(*_KNOWN[name])
        if name in _KNOWN
        else "size and license: see its page on the hub"
    )
    return f"the weights of {name} ({size}) are not on this machine: {own}, and in the hub cache {HF_HUB_CACHE}; {_advice(name)}"


def _advice(name: str) -> str:
    includes = " ".join(f"--include '{pattern}'" for pattern in _FILES)
    target = name.split("/")[1]
    return f"allow the download (--download), or run `hf download {name} {includes} --local-dir MODELS/{target}` anywhere and pass --model-dir MODELS"


def check_packages(backend: str) -> None:
    """Raise MissingPackageError if torch or transformers is missing or too old."""
    from importlib.metadata import PackageNotFoundError, version

    for package, oldest in (("torch", 2), ("transformers", 5)):
        try:
            found = version(package)
        except PackageNotFoundError:
            raise MissingPackageError(
                f"the {backend} backend needs {package}: pip install 'sc3d[masks]'"
            ) from None
        if int(found.split(".")[0]) < oldest:
            raise MissingPackageError(
                f"the {backend} backend needs {package} {oldest} or newer, not {found}: pip install -U 'sc3d[masks]'"
            )


def check_settings(settings: Segment) -> None:
    """Raise InputError if an option of the text-prompted backends is out of range."""
    for name in ("box_threshold", "text_threshold"):
        if not 0 <= getattr(settings, name) < 1:
            raise InputError(f"{name} is {getattr(settings, name)}, but must be from 0 to below 1")
    if settings.tile and settings.tile < 64:
        raise InputError(f"tile is {settings.tile} px, but must be at least 64, or 0 for no tiles")
    if not 0 < settings.overlap <= 0.75:
        raise InputError(
            f"overlap is {settings.overlap}, but must be above 0 (tiles are joined where they overlap) and at most 0.75"
        )


def choose_device(settings: Segment) -> str:
    """Name of a torch device that works; InputError if there is none of that name, or half precision is
    wanted without a GPU.
    """
    import torch

    name = settings.device
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    try:
        torch.empty(1, device=name)
    except (RuntimeError, AssertionError) as error:
        raise InputError(
            f"the device {name!r} cannot be used ({first_line(error)}): choose cpu, or leave it at auto"
        ) from None
    if settings.half and torch.device(name).type != "cuda":
        raise InputError(
            f"half precision is for CUDA GPUs, but the device is {name}, where it is slower and less exact: leave --half away"
        )
    return name


@contextmanager
def inference(device: str, half: bool) -> Iterator[None]:
    """No gradients; with `half`, matrix products in bfloat16 (float16 on GPUs older than Ampere), what needs
    range in float32.
    """
    import torch

    with ExitStack() as stack:
        stack.enter_context(torch.inference_mode())
        if half:
            kind = torch.device(device).type
            old = kind == "cuda" and not torch.cuda.is_bf16_supported(including_emulation=False)
            stack.enter_context(torch.autocast(kind, dtype=torch.float16 if old else torch.bfloat16))
        yield


def load_model(path: Path, classes: dict[str, str], device: str) -> Any:
    """Load a model for inference: safetensors only, from this machine only; InputError if the weights are
    damaged or incomplete.

    classes: name of the class in transformers by model type
    """
    import transformers
    from transformers.utils import logging

    model_class = getattr(transformers, classes[model_type(path)])
    verbosity, progress = logging.get_verbosity(), logging.is_progress_bar_enabled()
    logging.set_verbosity_error()  # else it warns that a video model is loaded for images, which is meant
    logging.disable_progress_bar()
    try:
        model, report = model_class.from_pretrained(
            path,
            local_files_only=True,
            use_safetensors=True,
            trust_remote_code=False,
            output_loading_info=True,
            dtype="float32",
        )
    # OSError, ValueError, RuntimeError, SafetensorError, TypeError: whatever a damaged file brings about
    except Exception as error:
        raise InputError(f"cannot load the model in {path}: {first_line(error)}; download it again") from None
    finally:
        logging.set_verbosity(verbosity)
        if progress:
            logging.enable_progress_bar()
    if report["missing_keys"]:  # those would silently be random
        raise InputError(
            f"the weights in {path} are incomplete ({sorted(report['missing_keys'])[0]} is missing): download the model again"
        )
    return model.to(device).eval()


def load_tokenizer(path: Path, name: str):
    """Load the tokenizer in a model's folder by the name of its class in transformers; InputError if it is
    missing or damaged.
    """
    import transformers

    try:
        return getattr(transformers, name).from_pretrained(
            path, local_files_only=True, trust_remote_code=False
        )
    except Exception as error:
        raise InputError(
            f"cannot load the tokenizer in {path}: {first_line(error)}; download the model again"
        ) from None


def to_pixels(image: np.ndarray, size: tuple[int, int], statistics: tuple, device: str) -> torch.Tensor:
    """(1, 3, height, width) float32 of an (H, W, 3) uint8 photo, resized with antialiasing to `size` (width,
    height) and normalized.

    Done here rather than by the models' own processors: those of SAM 2 and 3 need torchvision, and results
    would differ with and without it.
    """
    import torch
    from PIL import Image

    mean, deviation = (np.array(values, np.float32) for values in statistics)
    resized = np.asarray(Image.fromarray(image).resize(size, Image.Resampling.BILINEAR), np.float32) / 255
    return torch.from_numpy(((resized - mean) / deviation).transpose(2, 0, 1)[None].copy()).to(device)


class ScorePatch(NamedTuple):
    """Part of a map of the photo: (h, w) float32 values; row and column of its first pixel."""

    values: torch.Tensor
    top: int
    left: int


def enlarge(values: torch.Tensor, threshold: float, shape: tuple[int, int]) -> ScorePatch:
    """Enlarge a map to the size of the photo, bilinearly (pixel centers at +0.5), but only where the result
    may exceed a threshold.

    values: (h, w) float32
    shape: (H, W) px
    returns: a rectangle of the enlarged map that holds all pixels above `threshold`, and few others; empty if
        there are none
    """
    import torch

    above = values > threshold
    low_rows, high_rows, down, top = _sources(above.any(dim=1), shape[0])
    low_columns, high_columns, across, left = _sources(above.any(dim=0), shape[1])
    rows = torch.lerp(values[low_rows], values[high_rows], down[:, None])
    return ScorePatch(torch.lerp(rows[:, low_columns], rows[:, high_columns], across), top, left)


def _sources(present: torch.Tensor, length: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, int]:
    """For each of the `length` output places that touch a present one: the two input places, the weight of
    the second; and the first such place.
    """
    import torch

    number, there = len(present), present.cpu()  # few numbers, and not every device has float64
    places = ((torch.arange(length, dtype=torch.float64) + 0.5) * (number / length) - 0.5).clamp(
        0, number - 1
    )
    low = places.floor().long()
    high = (low + 1).clamp(max=number - 1)
    touched = torch.nonzero(there[low] | there[high])[:, 0]
    part = slice(int(touched[0]), int(touched[-1]) + 1) if len(touched) else slice(0, 0)
    low, high, weight = (values[part].to(present.device) for values in (low, high, (places - low).float()))
    return low, high, weight, part.start


def outline(values: torch.Tensor, threshold: float, shape: tuple[int, int]) -> np.ndarray:
    """(K, 2) runs of the pixels of a photo of `shape` (H, W) where the enlarged map exceeds a threshold."""
    patch = enlarge(values.float(), threshold, shape)
    return find_runs((patch.values > threshold).cpu().numpy(), shape[0], patch.top, patch.left)


def first_line(error: Exception) -> str:
    """First line of an error's text, or its name."""
    return (str(error).strip().splitlines() or [type(error).__name__])[0]
