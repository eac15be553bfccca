#!/usr/bin/env bash
# Runs the fast tests on the oldest, the default and the newest Python, or on those named: bash tools/test_pythons.sh [3.12 ...]
# The default is that of .venv; each other has an environment of its own, .venv-3.10 and so on (4.5 GB where PyTorch comes with
# CUDA). Ends with status 0 if all were there and passed.
set -euo pipefail
root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
source "$root/tools/pythons.sh"

default=$(version_of "$root/.venv/bin/python") || default=$(version_of "$(find_python)") || default=$newest
[ $# != 0 ] || set -- $(printf '%s\n' "$oldest" "$default" "$newest" | awk '!seen[$0]++')
results=() failed=0
for version in "$@"; do
    venv="$root/.venv-$version"
    [ "$version" != "$default" ] || venv="$root/.venv"
    if ! python=$(python_of "$version"); then
        say "Python $version is not there; one of these brings it:"
        how_to_get "$version"
        results+=("Python $version: NOT RUN") failed=1
    elif SC3D_PYTHON="$python" SC3D_VENV="$venv" bash "$root/tools/test.sh"; then
        results+=("Python $("$venv/bin/python" -c 'import platform; print(platform.python_version())'): passed")
    else
        results+=("Python $version: FAILED") failed=1
    fi
done
printf '%s\n' "${results[@]}"
exit "$failed"
