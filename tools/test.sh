#!/usr/bin/env bash
# Sets up and runs the tests, three files at a time, as much of it is waiting: bash tools/test.sh [pytest arguments]; the long ones with: bash tools/test.sh -m slow
set -euo pipefail
source "$(dirname "${BASH_SOURCE[0]}")/setup.sh"
cd "$root"
exec "$venv/bin/python" -m pytest --numprocesses "${SC3D_TEST_PROCESSES:-3}" --dist loadfile --no-loadscope-reorder "$@"
