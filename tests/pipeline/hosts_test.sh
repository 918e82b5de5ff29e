#!/bin/bash
# hosts_test.sh BUILD RIG_FOLDER HOSTS LOSS_PER_MILLE SAMPLES: tests/pipeline/hosts.sh in a folder of its own, and its judge.
set -euo pipefail
work=$(mktemp -d)
export BODYSCHEMA_BUILD=$1
"$(dirname "$0")/hosts.sh" "$2" "$3" "$4" "$5" "$work/run"
"$1/bin/judge_hosts" "$work/run" "$5"
# Of one frame in a thousand a run may lose none.
[ "$4" -lt 10 ] || grep -q ' [1-9]' "$work/run/lost" || { echo "no frame was lost: the test tests nothing" >&2; exit 1; }
rm -rf "$work"
