"""What this machine has: versions, libraries, Vulkan, CUDA, model weights."""

from __future__ import annotations

import ctypes
import logging
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from sc3d.errors import Sc3dError
from sc3d.io.caches import kernel_cache
from sc3d.io.provenance import versions
from sc3d.io.python_process import run_python
from sc3d.io.requirements import ALWAYS, INSTALL, LIBRARIES, outdated
from sc3d.segmentation.models import find_weights
from sc3d.settings.labels import Segment
from sc3d.settings.outputs import Doctor
from sc3d.view.renderers import VULKAN_PROBE

logger = logging.getLogger(__name__)

PROBES = {  # each in a process of its own: a missing library may abort it
    "open3d": "import open3d; print('works')",
    "pycolmap": "import pycolmap; print('works, CUDA' if pycolmap.has_cuda else 'works, CPU')",
    "torch": "import torch; print(f'works, CUDA {torch.version.cuda}' if torch.cuda.is_available() else 'works, CPU')",
    "transformers": "import transformers; print('works')",
    "vulkan pictures": VULKAN_PROBE,
    "OpenGL pictures": "import open3d as o; v = o.visualization.Visualizer(); print('work' if v.create_window(visible=False) else 'do not work')",
}


def main(command: Doctor) -> None:
    for name, version in versions().items():
        logger.info("%-22s %s", name, version)
    for old in outdated():
        logger.info("%-22s %s: pip install --upgrade", "too old", old)
    missing = [LIBRARIES[library] for library in ALWAYS if not _loads(library)]
    logger.info("%-22s %s", "system libraries", f"{INSTALL} {' '.join(missing)}" if missing else "complete")
    logger.info("%-22s %s", "compiled kernels", kernel_cache())
    logger.info("%-22s %s", "temporary files", _room(Path(tempfile.gettempdir())))
    for name, code in PROBES.items():
        logger.info("%-22s %s", name, _probe(code))
    logger.info("%-22s %s", "processor cores", os.cpu_count())
    for model in (Segment.detector, Segment.segmenter, Segment.concept_model):
        logger.info("%-22s %s", model, _weights(model, command.model_dir))


def _loads(library: str) -> bool:
    if sys.platform != "linux":
        return True
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True


def _room(folder: Path) -> str:
    return f"{shutil.disk_usage(folder).free / 2**30:.1f} GiB free in {folder} (TMPDIR names another folder)"


def _probe(code: str) -> str:
    try:
        result = run_python(code, timeout=120)
    except subprocess.TimeoutExpired:
        return "no answer within 120 s"
    if result.returncode == 0 and result.stdout.strip():
        return result.stdout.strip().splitlines()[-1]
    lines = (
        result.stderr.strip() or result.stdout.strip() or f"ended with status {result.returncode}"
    ).splitlines()
    return f"does not work: {lines[-1][:150]}"


def _weights(model: str, model_dir: Path | None) -> str:
    try:
        return f"found in {find_weights(model, model_dir, download=False)}"
    except Sc3dError:
        return "not on this machine"
