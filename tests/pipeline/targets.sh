#!/bin/bash
# targets.sh SOURCE BUILD: a group learns arm2, then the end effector is sent to random positions and along a path; the console
# says halt, resume, hold and release; a target that times out or is interrupted is dropped; the controller is
# killed with a hold and in the middle of a target and holds.
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

"$source/run" --rig arm2 --ideal --seed 3 --samples 30 --keep >"$work/run.txt" 2>&1 || fail "the group did not learn"
"$source/run" exec targets --rig-folder "$work/logs/current/config" --count 6 --limit-mm 8 >"$work/targets.txt" 2>&1 ||
  fail "the targets were not reached"
# Where the arm is, by the newest schema: at the target that it reached last.
"$source/run" where 5 --json >"$work/where.json" || fail "where"
python3 - "$work/where.json" "$(awk -F'|' '/reached/ && $3 ~ /^ *-?[0-9.]+ / {at = $3} END {print at}' "$work/targets.txt")" <<'END' || fail "where is elsewhere"
import json, sys
part = json.load(open(sys.argv[1]))["parts"][0]
target = [float(word) for word in sys.argv[2].split()]
position = part["X_RB"]["position_m"]
assert max(abs(p - t) for p, t in zip(position, target)) < 0.005, (position, target)
assert all(low <= p <= high for low, p, high in zip(part["lowest_m"], position, part["highest_m"])), part
END
# Along a path: poses of the arm at actions in a row, by the schema. Of two joints these alone are reached.
schema=$work/logs/current/schema.lcmlog
{
  echo x,y,z,qw,qx,qy,qz
  for q in 0 0.1 0.2; do
    "$source/run" exec bodyschema predict "$schema" --action "$q" 0.3 --json | python3 -c 'import json, sys
part = next(part for part in json.load(sys.stdin)["parts"] if part["part"] == 5)
print(*part["X_RB"]["position_m"], *part["X_RB"]["rotation_wxyz"], sep=",")'
  done
} >"$work/path.csv"
"$source/run" follow "$work/path.csv" --part 5 --step 0.5 --json >"$work/follow.json" 2>>"$work/console.txt" || fail "the path was not followed"
python3 - "$work/follow.json" <<'END' || fail "the path is not as it is told"
import json, sys
path = json.load(open(sys.argv[1]))
assert path["reached"] and path["of"] == len(path["way_points"]) == 3, path
assert all(point["predicted_error_deg"] < 1 and point["observed_error_deg"] < 2 for point in path["way_points"]), path
END
moves_of() { "$source/run" exec bodyschema status --json | python3 -c 'import json, sys; print(json.load(sys.stdin)["arm"]["action_id"])'; }
before=$(moves_of)
printf 'x,y,z\n9,9,9\n' | "$source/run" exec bodyschema follow - --part 5 2>>"$work/console.txt" && fail "a path out of reach was followed"
grep -q "nothing was moved" "$work/console.txt" && [ "$before" = "$(moves_of)" ] || fail "a path out of reach moved the arm"
console target --part 5 --position 9 9 9 --timeout 30 && fail "a target out of reach was reached"
grep -q "held: out of reach.*the arm stays here" "$work/console.txt" || fail "a target out of reach is not refused, or gives a held arm back"
console stop && fail "stop did something"
grep -q "stops the arm; a group is ended by" "$work/console.txt" || fail "stop does not say what may be meant"
console halt || fail "halt"
console target --part 5 --position 0.1 0.1 0.1 --timeout 30 && fail "a stopped arm was moved"
grep -q "first: ./run resume" "$work/console.txt" || fail "a halt is not said"
console resume || fail "resume"
console hold || fail "hold"
# The program itself, not the setpriv that became it: its command line begins with its path.
controller=$("$source/run" exec pgrep -f "^$build/bin/controller .*$work/")
kill -KILL "$controller"
says_held() { grep -q "held as before the restart" "$work/logs/current/run.lcmlog.00"; }
for _ in $(seq 100); do
  says_held && break
  sleep 0.1
done
says_held || fail "the hold did not survive a kill"
console hold || fail "no hold after the restart"
console release || fail "release"

position=$(awk -F'|' '/reached/ {print $3; exit}' "$work/targets.txt")
elsewhere=$(awk -F'|' '/reached/ && ++n == 2 {print $3; exit}' "$work/targets.txt")
observer=$("$source/run" exec pgrep -f "^$build/bin/observer .*$work/")

# Without a follower the target is dropped and the arm held, also once its SAMPLE has come.
state() { "$source/run" exec bodyschema status --json | python3 -c 'import json, sys
status = json.load(sys.stdin)
print(status["control"]["state"], status["newest_sample"], status["arm"]["action_id"])'; }
for end in timeout interrupt; do
  kill -STOP "$observer"
  if [ "$end" = timeout ]; then
    # shellcheck disable=SC2086
    console target --part 5 --position $position --timeout 3 && fail "a target without its SAMPLE was reached"
  else
    # shellcheck disable=SC2086
    "$source/run" exec timeout --signal INT 3 bodyschema target --part 5 --position $position >"$work/interrupt.txt" 2>&1 || true
    cat "$work/interrupt.txt" >>"$work/console.txt"
  fi
  kill -CONT "$observer"
  tail -n 1 "$work/console.txt" | grep -q "the target was dropped: the arm is held until" || fail "$end: the target is not dropped"
  before=$(state)
  [[ $before = "holding "* ]] || fail "$end: the arm is not held but $before"
  # Two status take 4 s, in which the next step would come.
  state >/dev/null
  after=$(state)
  [ "${before##* }" = "${after##* }" ] && [[ $after = "holding "* ]] || fail "$end: it goes on, from $before to $after"
  console release || fail "release after $end"
done

# Killed in the middle of a target, which stays open because its SAMPLE does not come: its follower is
# told, and it is not served again.
kill -STOP "$observer"
# shellcheck disable=SC2086
"$source/run" exec bodyschema target --part 5 --position $elsewhere --timeout 60 >"$work/middle.txt" 2>&1 &
follower=$!
for _ in $(seq 100); do
  grep -q "waiting for the SAMPLE of action" "$work/middle.txt" && break
  read -rt 0.1 <> <(:) || true
done
kill -KILL "$("$source/run" exec pgrep -f "^$build/bin/controller .*$work/")"
kill -CONT "$observer"
status=0
wait "$follower" || status=$?
[ "$status" = 1 ] || fail "the follower of a target that was cut short ended with $status"
grep -q "restarted in the middle of target" "$work/middle.txt" || fail "who follows is not told of the restart"
console release || fail "release after the restart"
