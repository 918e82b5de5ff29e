#!/bin/bash
# driver_test_simulator.sh BIN RIG: robot_simulator keeps lcmtypes/DRIVER.md, as far as that is visible with
# motions that take no time.
set -euo pipefail
bin=$1 rig=$2 here=$(dirname "$0")
work=$(mktemp -d)
trap 'kill $(jobs -p) 2>/dev/null || true; wait 2>/dev/null; rm -rf "$work"' EXIT

# A process whose program has another name than in PROCESS_INFO is not killed.
ln -s "$bin/robot_simulator" "$work/stranger"
"$work/stranger" --config "$rig/robot_simulator.yaml" --state "$work/state.yaml" 2>"$work/driver.log" &
stranger=$!
if "$bin/bodyschema" driver-test --rig-folder "$rig" --yes --kill robot_simulator 2>"$work/error"; then exit 1; fi
grep -q "process $stranger is 'stranger' here, not robot_simulator" "$work/error" || { cat "$work/error"; exit 1; }
kill "$stranger"
wait "$stranger"

"$here/supervise.sh" "$work/driver.log" \
  "$bin/robot_simulator" --config "$rig/robot_simulator.yaml" --state "$work/state.yaml" &
status=0
"$bin/bodyschema" driver-test --rig-folder "$rig" --yes --kill robot_simulator >"$work/result" ||
  status=$?
cat "$work/result"
[ "$status" = 0 ] || { cat "$work/driver.log"; exit 1; }
grep -q '^17 rules: 13 ok, 0 failed, 4 skipped' "$work/result"

# Without confirmation nothing moves.
status=0
"$bin/bodyschema" driver-test --rig-folder "$rig" </dev/null 2>/dev/null || status=$?
[ "$status" = 2 ] || { echo "exit code $status without confirmation"; exit 1; }

# Faults reach it by command and are named; a wrong one is refused with the choices.
"$bin/bodyschema" fault bend forearm 5 | grep -qx 'bend forearm 5 deg'
"$bin/bodyschema" fault marker-lost 12 | grep -qx 'marker-lost 12'
if "$bin/bodyschema" fault stuck q9 2>"$work/error"; then exit 1; fi
grep -q 'no signal q9; there are q1, q2' "$work/error"
"$bin/bodyschema" fault repair | grep -qx 'repaired: as built'
