#!/usr/bin/env bash
# Sets up and runs the whole chain on synthetic photos: bash tools/demo.sh [FOLDER] [--full]
set -euo pipefail
source "$(dirname "${BASH_SOURCE[0]}")/setup.sh"
exec "$venv/bin/python" "$root/tools/demo.py" "$@"
