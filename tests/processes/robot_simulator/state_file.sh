#!/bin/bash
# state_file.sh BIN RIG: robot_simulator on a full disk goes on and warns once; with a damaged state it ends and
# says what to do.
set -euo pipefail
bin=$1 rig=$2
work=$(mktemp -d)
trap 'kill $(jobs -p) 2>/dev/null || true; wait 2>/dev/null; umount "$work/disk" 2>/dev/null || true; rm -rf "$work"' EXIT

# Runs a command every 50 ms until it succeeds, for at most 20 s.
until_ok() {
  for _ in $(seq 400); do
    "$@" && return 0
    read -rt 0.05 <> <(:) || true
  done
  return 1
}
fail() {
  echo "$*" >&2
  cat "$work"/*.log >&2
  exit 1
}

mkdir "$work/disk"
mount -t tmpfs -o size=16k none "$work/disk" || { echo "SKIP: no tmpfs here" >&2; exit 77; }
"$bin/robot_simulator" --config "$rig/robot_simulator.yaml" --state "$work/disk/state.yaml" 2>"$work/simulator.log" &
simulator=$!
until_ok "$bin/bodyschema" fault camera-bump >/dev/null 2>>"$work/fault.log" || fail "does not start"
[ -s "$work/disk/state.yaml" ] || fail "no state was saved"
dd if=/dev/zero of="$work/disk/full" bs=1k 2>/dev/null || true
for _ in 1 2 3; do
  "$bin/bodyschema" fault camera-bump >/dev/null || fail "ended by a full disk"
done
kill -0 "$simulator" || fail "ended by a full disk"
[ "$(grep -c 'a restart would not know' "$work/simulator.log")" = 1 ] || fail "not warned exactly once"
# The earlier state is whole.
grep -q '^served_faults:' "$work/disk/state.yaml" || fail "the old state was destroyed"
kill "$simulator"
wait "$simulator" || fail "exit code $? after SIGTERM"

head -c 200 "$work/disk/state.yaml" >"$work/damaged.yaml"
if "$bin/robot_simulator" --config "$rig/robot_simulator.yaml" --state "$work/damaged.yaml" 2>"$work/damaged.log"; then
  fail "started from a damaged state"
fi
grep -q 'delete it to start anew' "$work/damaged.log" || fail "does not say what to do"
[ "$(wc -l <"$work/damaged.log")" = 1 ] || fail "more than one line"
