#!/bin/bash
# targets.sh [RIG [TARGETS [ARGUMENT...]]]: learns RIG as ./run does with the arguments (--ideal --samples 60), then sends its end
# effector to random positions and compares with the simulator's truth. Fails if the median is above 1.5 mm, with calibration errors
# above 3 mm aligned.
# Needs: programs targets
set -euo pipefail
root=$(cd "$(dirname "${BASH_SOURCE[0]}")/../.." && pwd)
rig=${1:-arm7} count=${2:-20}
shift $(($# < 2 ? $# : 2))
[ $# -gt 0 ] || set -- --ideal --samples 60
trap '"$root/run" stop >/dev/null 2>&1 || true' EXIT
"$root/run" --rig "$rig" "$@" --keep >/dev/null
limit_mm=3
[[ " $* " != *" --ideal "* ]] || limit_mm=1.5
"$root/run" exec targets --rig-folder "$root/config/$rig" --count "$count" --limit-mm $limit_mm
