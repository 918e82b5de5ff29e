#!/bin/bash
# targets.sh SOURCE BUILD: a group learns arm2, then the end effector is sent to random positions; stop, resume,
# hold and release are said by the console; the controller is killed with a hold and in the middle of a target and holds.
set -euo pipefail
source=$1 build=$2
work=$(mktemp -d)
export BODYSCHEMA_BUILD=$build BODYSCHEMA_LOGS=$work/logs
trap '"$source/run" stop >/dev/null 2>&1 || true; rm -rf "$work"' EXIT
unshare --user --map-root-user --net true 2>/dev/null || { echo "SKIP: no user namespaces" >&2; exit 77; }
fail() {
  echo "targets: $*" >&2
  tail -n 30 "$work"/*.txt "$work"/logs/current/controller.log >&2 || true
  exit 1
}
console() { "$source/run" exec bodyschema "$@" >>"$work/console.txt" 2>&1; }

"$source/run" --rig arm2 --seed 3 --samples 30 --keep >"$work/run.txt" 2>&1 || fail "the group did not learn"
"$source/run" exec targets --rig-folder "$work/logs/current/config" --count 6 --limit-mm 8 >"$work/targets.txt" 2>&1 ||
  fail "the targets were not reached"
console target --part 5 --position 9 9 9 --timeout 30 && fail "a target out of reach was reached"
grep -q "refused: out of reach" "$work/console.txt" || fail "a target out of reach is not refused"
console stop || fail "stop"
console target --part 5 --position 0.1 0.1 0.1 --timeout 30 && fail "a stopped arm was moved"
grep -q "first: bodyschema resume" "$work/console.txt" || fail "a stop is not said"
console resume || fail "resume"
console hold || fail "hold"
# The program itself, not the setpriv that became it: its command line begins with its path.
controller=$("$source/run" exec pgrep -f "^$build/bin/controller ")
kill -KILL "$controller"
console hold || fail "no hold after the restart"
grep -q "held as before the restart" "$work/logs/current/run.lcmlog.00" || fail "the hold did not survive a kill"
console release || fail "release"

# Killed in the middle of a target, which stays open because its SAMPLE does not come: the one who follows it is
# told, and it is not served again.
position=$(awk -F'|' '/reached/ {print $3; exit}' "$work/targets.txt")
observer=$("$source/run" exec pgrep -f "^$build/bin/observer ")
kill -STOP "$observer"
# shellcheck disable=SC2086
"$source/run" exec bodyschema target --part 5 --position $position --timeout 60 >"$work/middle.txt" 2>&1 &
follower=$!
for _ in $(seq 100); do
  grep -q "waiting for the SAMPLE of action" "$work/middle.txt" && break
  read -rt 0.1 <> <(:) || true
done
kill -KILL "$("$source/run" exec pgrep -f "^$build/bin/controller ")"
kill -CONT "$observer"
status=0
wait "$follower" || status=$?
[ "$status" = 1 ] || fail "the follower of a target that was cut short ended with $status"
grep -q "restarted in the middle of target" "$work/middle.txt" || fail "who follows is not told of the restart"
console release || fail "release after the restart"
