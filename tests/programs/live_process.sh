#!/bin/bash
# live_process.sh PROGRAM RIG LOG_PAYLOADS: one process on the live bus that this script runs on
# (tests/private_bus.sh): PROCESS_INFO arrives at another process, a second one beside it ends, SIGTERM
# ends it with exit code 0.
set -euo pipefail
program=$1 rig=$2 log_payloads=$3
name=$(basename "$program")
work=$(mktemp -d)
trap 'kill $(jobs -p) 2>/dev/null || true; wait; rm -rf "$work"' EXIT

# Runs a command every 50 ms until it succeeds, for at most 30 s.
until_ok() {
  for _ in $(seq 600); do
    "$@" && return 0
    read -rt 0.05 <> <(:) || true
  done
  return 1
}
fail() {
  echo "$name: $*" >&2
  cat "$work/process.log" >&2
  exit 1
}

lcm-logger --quiet --lcm-url="$LCM_DEFAULT_URL" "$work/bus.lcmlog" &
"$program" --config "$rig/$name.yaml" 2>"$work/process.log" &
process=$!

# The name is in the payload: this process was heard.
is_heard() { "$log_payloads" "$work/bus.lcmlog" PROCESS_INFO 2>/dev/null | grep -qaF "$name"; }
is_heard_or_dead() { is_heard || ! kill -0 "$process" 2>/dev/null; }
has_ended() { ! kill -0 "$process" 2>/dev/null; }

until_ok is_heard_or_dead || fail "no PROCESS_INFO within 30 s"
has_ended && fail "ended by itself"

# Started twice by mistake.
status=0
timeout 30 "$program" --config "$rig/$name.yaml" 2>"$work/twin.log" || status=$?
[ "$status" = 1 ] || fail "a second one beside it ended with exit code $status: $(cat "$work/twin.log")"
grep -q "another $name is on this bus: process $process " "$work/twin.log" ||
  fail "the second one does not say who is there: $(cat "$work/twin.log")"
has_ended && fail "it ended because a second one was started"

kill -TERM "$process"
until_ok has_ended || { kill -KILL "$process"; fail "still runs 30 s after SIGTERM"; }
status=0
wait "$process" || status=$?
[ "$status" = 0 ] || fail "exit code $status after SIGTERM"
