#!/bin/bash
# lost_robot.sh BIN RIG: the serial device vanishes in the middle of a motion and comes back; then the driver gets
# SIGTERM in the middle of another. Its answers are in the log of the bus.
set -euo pipefail
bin=$1
work=$(mktemp -d)
trap 'kill $(jobs -p) 2>/dev/null || true; wait 2>/dev/null; rm -rf "$work"' EXIT

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
  cat "$work/driver.log" "$work/statuses" >&2
  exit 1
}
says() { grep -q "$1" "$work/statuses"; }

cp "$2"/*.yaml "$work/"
sed -i 's|^device:.*|device: robot|' "$work/robot_driver_example.yaml"
"$bin/motion_client" >"$work/statuses" &
client=$!
# The device does not exist yet: the driver waits.
"$bin/robot_driver_example" --config "$work/robot_driver_example.yaml" --record "$work/record" \
  2>"$work/driver.log" &
driver=$!
until_ok says 'IDLE rest=no' || fail "no status without a robot"

"$bin/imaginary_robot" --link "$work/robot" --signals 3 --speed 5 &
robot=$!
until_ok says 'IDLE rest=yes' || fail "the robot was not found"
kill -USR1 "$client" # a MOVE
until_ok says 'id=0 MOVING' || fail "the MOVE was not accepted"
kill -KILL "$robot"
rm "$work/robot"
until_ok says 'id=0 STOPPED rest=no' || fail "the lost robot was not noticed"

"$bin/imaginary_robot" --link "$work/robot" --signals 3 --speed 5 &
until_ok says 'id=0 STOPPED rest=yes' || fail "the robot was not found again"
kill -USR1 "$client"
until_ok says 'id=1 MOVING' || fail "no MOVE after the return"
kill -TERM "$driver"
until_ok says 'id=1 STOPPED rest=yes' || fail "SIGTERM did not halt the arm"
status=0
wait "$driver" || status=$?
[ "$status" = 0 ] || fail "exit code $status after SIGTERM"
# The motion was neither resumed nor finished.
says SETTLED && fail "a motion that was interrupted settled"
exit 0
