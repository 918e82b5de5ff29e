#!/bin/bash
# targets.sh [RIG [TARGETS]]: learns RIG, then sends its end effector to random positions and compares with the simulator's truth.
# Fails if the median is above 5 mm.
set -euo pipefail
root=$(cd "$(dirname "${BASH_SOURCE[0]}")/../.." && pwd)
rig=${1:-arm7} count=${2:-20}
trap '"$root/run" stop >/dev/null 2>&1 || true' EXIT
"$root/run" --rig "$rig" --ideal --samples 60 --keep >/dev/null
"$root/run" exec targets --rig-folder "$root/config/$rig" --count "$count" --limit-mm 5
