#!/bin/bash
# supervise.sh LOG COMMAND…: starts the command again whenever it fails, as a supervisor does; ends
# it when it is told to end.
log=$1
shift
trap 'kill "$child" 2>/dev/null; wait "$child"; exit 0' TERM
while :; do
  "$@" 2>>"$log" &
  child=$!
  wait "$child" && exit 0
done
