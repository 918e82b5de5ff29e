#!/bin/bash
# replay_live.sh BIN RIG RUN_LOG EXPECTED: plays the SAMPLEs of RUN_LOG with lcm-logplayer onto the bus
# that this script runs on (tests/private_bus.sh), where a learner and a logger listen, until the last
# LEARNED_SCHEMA has the bytes in EXPECTED.
set -euo pipefail
bin=$1 rig=$2 log=$3 expected=$4
work=$(mktemp -d)
trap 'kill $(jobs -p) 2>/dev/null || true; wait; rm -rf "$work"' EXIT

lcm-logger --quiet --lcm-url="$LCM_DEFAULT_URL" "$work/replayed.lcmlog" &
"$bin/structure_learner" --config "$rig/structure_learner.yaml" 2>"$work/learner.log" &

# lcm-logplayer starts at once, so first make sure that both hear the bus: the logger has recorded that the learner,
# which first listens for a twin, waits for samples.
for _ in $(seq 200); do
  "$bin/log_payloads" "$work/replayed.lcmlog" PROCESS_INFO --last 2>/dev/null | grep -aq "waiting for SAMPLE" && break
  read -rt 0.1 <> <(:) || true
done
lcm-logplayer -s 20 -e SAMPLE --lcm-url="$LCM_DEFAULT_URL" "$log" >/dev/null
for _ in $(seq 200); do
  "$bin/log_payloads" "$work/replayed.lcmlog" LEARNED_SCHEMA --last >"$work/last" 2>/dev/null || true
  cmp -s "$work/last" "$expected" && exit 0
  read -rt 0.1 <> <(:) || true
done
echo "the schema learned from the replay differs from $expected" >&2
cat "$work/learner.log" >&2
exit 1
