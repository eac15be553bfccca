#!/usr/bin/env bash
# Sets up and runs the whole chain on synthetic photos: bash tools/demo.sh [folder]. The true cameras are not used.
set -euo pipefail
source "$(dirname "${BASH_SOURCE[0]}")/setup.sh"
demo=${1:-$root/demo}
sc3d="$venv/bin/sc3d"
"$sc3d" synthesize "$demo/site" --views 24 --width 640 --num-points 300000
"$sc3d" run "$demo/site/images" "$demo/scene" --masks "$demo/site/masks" --confidence "$demo/site/confidence" \
    --classes "$demo/site/classes.json" --truth "$demo/site/truth" --train.iterations 1500 --depth.max-size 640 --train.max-size 640 --extract.max-size 640
"$sc3d" view "$demo/scene" --screenshot "$demo/labelled.png"
printf 'report: %s\npicture: %s\n' "$demo/scene/report.html" "$demo/labelled.png"
