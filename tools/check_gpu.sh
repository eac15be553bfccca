#!/usr/bin/env bash
# What no machine without an NVIDIA GPU can check: bash tools/check_gpu.sh FOLDER [options of the benchmark]
# FOLDER gets gpu.md, the table: image and gradients against the CPU, a training to the end, time and memory of a
# step at 0.2, 1 and 5 million Gaussians, lifted labels, blocks; more scenes by --scenes SCENE ...
set -euo pipefail
source "$(dirname "${BASH_SOURCE[0]}")/setup.sh"
cd "$root"
[ $# -ge 1 ] || { echo "usage: bash tools/check_gpu.sh FOLDER [--scenes SCENE ...] [--no-against-cpu]" >&2; exit 2; }
python="$venv/bin/python"
"$python" - <<'PYTHON'
import sys

import torch

if not torch.cuda.is_available():
    sys.exit("torch finds no NVIDIA GPU here: this script is for machines that have one")
from sc3d.splatting.gpu.gsplat_backend import cuda_functions

cuda_functions()  # compiles the kernels if the wheel has none, which takes minutes
PYTHON
"$python" -m pytest -q tests/splatting/gpu tests/splatting/test_device.py \
    tests/segmentation/test_sam3.py tests/segmentation/test_grounded_sam.py
"$python" -m tools.benchmark gpu "$@"
cat "$1/gpu.md"
