"""Where the weights of a model lie on this machine; nothing is downloaded unless that is allowed."""

from __future__ import annotations

import re
from pathlib import Path

from sc3d.errors import InputError
from sc3d.io.json_files import read_json

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
        raise InputError(
            f"cannot download {name}: {(str(error).splitlines() or [type(error).__name__])[0]}; {_advice(name)}"
        ) from None
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
