#!/bin/bash
# driver_test_example.sh BIN RIG: robot_driver_example keeps every rule of lcmtypes/DRIVER.md, none is skipped:
# real programs, a motion in real time, kill -9 in the middle of it.
set -euo pipefail
bin=$1 here=$(dirname "$0")
work=$(mktemp -d)
trap 'kill $(jobs -p) 2>/dev/null || true; wait 2>/dev/null; rm -rf "$work"' EXIT

cp "$2"/*.yaml "$work/"
sed -i 's|^device:.*|device: robot|' "$work/robot_driver_example.yaml"
"$bin/imaginary_robot" --link "$work/robot" --signals 3 --speed 12 &
"$here/supervise.sh" "$work/driver.log" \
  "$bin/robot_driver_example" --config "$work/robot_driver_example.yaml" --record "$work/record" &

status=0
"$bin/bodyschema" driver-test --rig-folder "$work" --yes --kill robot_driver_example >"$work/result" ||
  status=$?
cat "$work/result"
[ "$status" = 0 ] || { cat "$work/driver.log"; exit 1; }
grep -q '^17 rules: 17 ok, 0 failed, 0 skipped' "$work/result"
