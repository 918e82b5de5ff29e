#!/bin/bash
# supervise.sh LOG COMMAND…: restarts the command whenever it fails, as a supervisor does; SIGTERM ends
# both.
log=$1
shift
trap 'kill "$child" 2>/dev/null; wait "$child"; exit 0' TERM
while :; do
  "$@" 2>>"$log" &
  child=$!
  wait "$child" && exit 0
done
