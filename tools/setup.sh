#!/usr/bin/env bash
# Makes .venv with everything sc3d needs, at the versions of tools/constraints.txt; sourced by demo.sh, test.sh and lint.sh.
# SC3D_PYTHON chooses the interpreter, SC3D_TORCH_INDEX a package index with CPU-only torch (otherwise pip's own default).
set -euo pipefail
root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
venv="$root/.venv"
libraries=(libgl1 libegl1 libusb-1.0-0 libvulkan1 mesa-vulkan-drivers)

say() { printf 'sc3d set-up: %s\n' "$*" >&2; }

apt_install() { # packages; fails if apt may not be used here
    local sudo=()
    command -v apt-get >/dev/null || return 1
    if [ "$(id -u)" != 0 ]; then
        command -v sudo >/dev/null && sudo -n true 2>/dev/null || return 1
        sudo=(sudo -n)
    fi
    "${sudo[@]}" apt-get update -qq && "${sudo[@]}" env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "$@" >/dev/null
}

need() { # packages: install them, or say how and stop
    say "installing system packages: $*"
    apt_install "$@" || { say "please run: sudo apt-get install --no-install-recommends $*"; exit 1; }
}

find_python() {
    local candidate
    for candidate in "${SC3D_PYTHON:-}" python3.12 python3.11 python3.10 python3; do
        [ -n "$candidate" ] && command -v "$candidate" >/dev/null || continue
        "$candidate" -c 'import sys; sys.exit(not (3, 10) <= sys.version_info[:2] <= (3, 12))' 2>/dev/null && { command -v "$candidate"; return; }
    done
    say "Python 3.10, 3.11 or 3.12 is needed (set SC3D_PYTHON to choose one)"
    return 1
}

stamp=$(cat "$root/setup.cfg" "$root/tools/constraints.txt" "$root/tools/setup.sh" | cksum)
if [ "$(cat "$venv/.sc3d-stamp" 2>/dev/null)" != "$stamp" ]; then
    python=$(find_python)
    if ! "$python" -c 'import ensurepip, venv' 2>/dev/null; then
        need "python$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])')-venv"
    fi
    missing=()
    for library in "${libraries[@]}"; do
        dpkg -s "$library" >/dev/null 2>&1 || missing+=("$library")
    done
    [ ${#missing[@]} = 0 ] || need "${missing[@]}"
    say "installing Python packages into $venv (some minutes on the first run)"
    [ -x "$venv/bin/python" ] || "$python" -m venv "$venv"
    pip=("$venv/bin/python" -m pip install --quiet --disable-pip-version-check)
    "${pip[@]}" ${SC3D_TORCH_INDEX:+--index-url "$SC3D_TORCH_INDEX"} "$(grep -m1 '^torch==' "$root/tools/constraints.txt")"
    "${pip[@]}" -c "$root/tools/constraints.txt" -e "$root[all]"
    "$venv/bin/python" -c 'import open3d' || { say "Open3D does not load; please run: sudo apt-get install --no-install-recommends ${libraries[*]}"; exit 1; }
    printf '%s' "$stamp" >"$venv/.sc3d-stamp"
fi
