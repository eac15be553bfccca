#!/usr/bin/env bash
# Makes .venv with everything sc3d needs, at the versions of tools/constraints.txt; sourced by demo.sh, test.sh and lint.sh.
# SC3D_PYTHON chooses the interpreter, SC3D_VENV another folder than .venv, SC3D_TORCH_INDEX the package index of PyTorch
# (empty: pip's own). Without it PyTorch comes from its own CPU index where no NVIDIA GPU is found.
set -euo pipefail
root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
venv=${SC3D_VENV:-$root/.venv}
libraries=(libgl1 libegl1 libgomp1 libusb-1.0-0 libvulkan1 mesa-vulkan-drivers)
cpu_index=https://download.pytorch.org/whl/cpu
cuda_size="2.7 GB to download, 4.5 GB on the disk" # of PyTorch with CUDA, at the version of constraints.txt
source "$root/tools/pythons.sh"

has_nvidia() { [ -e /proc/driver/nvidia/version ] || { command -v nvidia-smi >/dev/null && nvidia-smi -L 2>/dev/null | grep -q '^GPU'; }; }

torch_index() { # the index that PyTorch comes from; nothing for pip's own
    if [ -n "${SC3D_TORCH_INDEX+set}" ]; then
        printf '%s' "$SC3D_TORCH_INDEX"
    elif [ "$(uname -s)" != Linux ]; then
        : # what the usual index has there is without CUDA
    elif has_nvidia; then
        say "an NVIDIA GPU is found: PyTorch comes with CUDA, $cuda_size"
    elif "$venv/bin/python" -c 'import sys, urllib.request; urllib.request.urlopen(sys.argv[1], timeout=20)' "$cpu_index/torch/" 2>/dev/null; then
        printf '%s' "$cpu_index"
    else
        say "no NVIDIA GPU is found, but $cpu_index cannot be reached: pip's own index may bring PyTorch with CUDA, up to $cuda_size"
    fi
}

system_libraries() { # that Open3D needs, on Debian and Ubuntu; elsewhere its import tells
    local library missing=()
    command -v dpkg >/dev/null || return 0
    for library in "${libraries[@]}"; do
        dpkg -s "$library" >/dev/null 2>&1 || missing+=("$library")
    done
    [ ${#missing[@]} = 0 ] || need "${missing[@]}"
}

if [ -n "${SC3D_PYTHON:-}" ] && [ -x "$venv/bin/python" ] && [ "$(version_of "$SC3D_PYTHON")" != "$(version_of "$venv/bin/python")" ]; then
    say "SC3D_PYTHON is Python $(version_of "$SC3D_PYTHON"), but $venv was made with $(version_of "$venv/bin/python"): delete it, or set SC3D_VENV to another folder"
    exit 1
fi
stamp=$(cat "$root/setup.cfg" "$root/tools/constraints.txt" "$root/tools/setup.sh" "$root/tools/pythons.sh" | cksum)
if [ "$(cat "$venv/.sc3d-stamp" 2>/dev/null)" != "$stamp" ]; then
    python=$(find_python) || { get_python && python=$(find_python); }
    "$python" -c 'import ensurepip, venv' 2>/dev/null || need "python$(version_of "$python")-venv"
    system_libraries
    say "installing Python packages into $venv with Python $(version_of "$python") (some minutes on the first run)"
    [ -x "$venv/bin/python" ] || "$python" -m venv "$venv"
    pip=("$venv/bin/python" -m pip install --quiet --disable-pip-version-check)
    index=$(torch_index)
    "${pip[@]}" ${index:+--index-url "$index"} "$(grep -m1 '^torch==' "$root/tools/constraints.txt")"
    "${pip[@]}" -c "$root/tools/constraints.txt" -e "$root[all]"
    "$venv/bin/python" -c 'import open3d' || { say "Open3D does not load; on Debian and Ubuntu: sudo apt-get install --no-install-recommends ${libraries[*]}"; exit 1; }
    printf '%s' "$stamp" >"$venv/.sc3d-stamp"
fi
