#!/bin/bash
# hosts.sh [RIG [SAMPLES]]: cost of several hosts and of lost frames. Markdown to stdout.
# Needs: programs judge_hosts
set -euo pipefail
tests=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
rig=${1:-arm7} samples=${2:-100}
bin=$BODYSCHEMA_BUILD/bin
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT

"$bin/judge_hosts" --head | sed '1s/^/| loss % /; 2s/^/| --- /'
for loss in 0 1 10; do
  for hosts in 2 3; do
    folder=$work/$hosts-$loss
    "$tests/pipeline/hosts.sh" "$tests/../config/$rig" "$hosts" "$loss" "$samples" "$folder"
    echo "| $(sed 's/.$/.&/; s/^\./0./' <<<"$loss") $("$bin/judge_hosts" "$folder" "$samples")"
  done
done
