#!/bin/bash
# faults.sh SOURCE BUILD: while arm7 babbles the console breaks it in seven ways and repairs it each time; each change
# is found, named and repaired in the schema by processes that are killed in between. In the end the schema is right and
# the report shows it all.
set -euo pipefail
source=$1 build=$2
work=$(mktemp -d)
export BODYSCHEMA_BUILD=$build BODYSCHEMA_LOGS=$work/logs
run=
trap '"$source/run" stop >/dev/null 2>&1 || true; [ -z "$run" ] || kill "$run" 2>/dev/null || true; wait; rm -rf "$work"' EXIT
unshare --user --map-root-user --net true 2>/dev/null || { echo "SKIP: no user namespaces" >&2; exit 77; }
fail() {
  echo "faults: $*" >&2
  tail -n 15 "$work"/*.txt >&2 || true
  exit 1
}
status() {
  "$source/run" exec bodyschema status --seconds 1.2 >"$work/status.txt" 2>&1 || true
  "$source/run" exec bodyschema status --seconds 1.2 --json >"$work/status.json" 2>&1 || true
}
# until WHAT COMMAND…: within a minute or two, however slow the machine.
until_true() {
  local what=$1
  shift
  for _ in $(seq 60); do
    status
    "$@" && return
  done
  fail "$what"
}
newest() {
  local sample
  sample=$(sed -n 's/^sample *\([0-9]*\):.*/\1/p' "$work/status.txt")
  echo "${sample:-0}"
}
# told SINCE PATTERN: one of the newest 32 events, at that sample or a later one, matches.
told() {
  awk -v since="$1" -v pattern="$2" '/"sample":/ {sample = $2 + 0} /"text":/ && sample >= since && $0 ~ pattern {found = 1}
    END {exit !found}' "$work/status.json"
}
is_learned() { [ "$(newest)" -ge 40 ] && is_sound; }
is_sound() { grep -q "^schema .*complete" "$work/status.txt" && ! grep -qE "INVALID|SUSPECT" "$work/status.txt"; }
fault() { "$source/run" fault "$@" >>"$work/console.txt" 2>&1 || fail "fault $*"; }
# The program itself, not the setpriv that became it: its command line begins with its path.
kill_process() { kill -KILL "$("$source/run" exec pgrep -f "^$build/bin/$1 .*$work")" || fail "no $1 to kill"; }

"$source/run" --rig arm7 --ideal --seed 1 --samples 100000 --keep >"$work/run.txt" 2>&1 &
run=$!
until_true "the arm was not learned" is_learned

# nothing_wrong: the list of findings exists and is empty.
nothing_wrong() { grep -q '^  "wrong": \[\]' "$work/status.json"; }

# break_and_repair PLACE WHAT VICTIM FAULT…: patterns of the text of events and findings.
break_and_repair() {
  local place=$1 what=$2 victim=$3
  shift 3
  local one since
  since=$(newest)
  for one in "$@"; do
    # shellcheck disable=SC2086
    fault $one
  done
  until_true "$*: not found" told "$since" "$what.*: (found|adopted)"
  until_true "$*: not listed" grep -q -A 9 "^What is wrong now" "$work/status.txt"
  kill_process "$victim"
  since=$(newest)
  fault repair
  until_true "$*: the repair was not found" told $((since + 1)) "$place.*(back to normal|undone)"
  until_true "$*: not sound again" is_sound
  until_true "$*: still listed as wrong" nothing_wrong
}
break_and_repair "4→5" "q3 .4→5. stuck at" model_monitor "stuck q3"
break_and_repair "5→6" "5→6 bent or exchanged by" observer "bend forearm 20"
break_and_repair "7→8" "7→8 bent or exchanged by" structure_learner "tool 1"
break_and_repair camera "camera moved by" marker_estimator "camera-bump"
break_and_repair "part 9" "marker of part 9 not seen" model_monitor "marker-lost 32" "marker-lost 33" "marker-lost 34" "marker-lost 35"
break_and_repair "tag 20 of part 6" "tag 20 of part 6 not where it was" structure_learner "marker-lost 20"
break_and_repair "tag 28 of part 8" "tag 28 of part 8 elsewhere" robot_simulator "marker-moved 28"

"$source/run" stop >>"$work/console.txt" 2>&1 || fail "stop"
wait
"$build/bin/judge_schema" "$work/logs/current/config" "$work/logs/current/schema.lcmlog" >"$work/judge.txt" 2>&1 ||
  fail "the schema is wrong in the end"
"$source/run" report "$work/logs/current" >>"$work/console.txt" 2>&1 || fail "report"
for what in "q3 (4→5) stuck at" "5→6 bent or exchanged by" "camera moved by" "marker of part 9 not seen" "tag 28 of part 8 elsewhere"; do
  grep -q "$what" "$work/logs/current/report.html" || fail "the report does not tell: $what"
done
