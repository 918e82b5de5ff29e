#!/bin/bash
# experiments --quick: every experiment leaves its table and a plot, required results are reached, and the
# same seeds give the same tables on one thread and on two. Wrong arguments are refused.
#   experiments_test.sh EXPERIMENTS
set -euo pipefail
program=$1
out=$(mktemp -d)
trap 'rm -rf "$out"' EXIT
fail() { echo "FAILED: $*" >&2; exit 1; }

"$program" --quick --jobs 2 --out "$out/all" >"$out/stdout" || fail "something that must come out did not: $(grep missed "$out/stdout")"
names=$("$program" --list | cut -d' ' -f1)
[ "$(wc -w <<<"$names")" -ge 8 ] || fail "--list names" $names
for name in $names; do
  table=$out/all/$name.md plot=$out/all/$name.png
  [ "$(grep -c '^| --- ' "$table")" -ge 1 ] || fail "$table has no table"
  grep -qF "$(sed -n 1p "$table")" "$out/stdout" || fail "$table is not on stdout"
  head -1 <(grep -c '| chapter |' "$table") | grep -q '^[1-9]' || fail "$table does not show the chapter's figure"
  grep -q '| baseline' "$table" || fail "$table shows no baseline"
  grep -q 'reached' "$table" || fail "$table says nothing that must come out"
  [ "$(head -c 4 "$plot" | tail -c 3)" = PNG ] || fail "$plot is no PNG"
  [ "$(stat -c %s "$plot")" -gt 8000 ] || fail "$plot is empty"
done

"$program" chain --quick --jobs 1 --out "$out/again" >/dev/null
diff <(tail -n +3 "$out/all/chain.md") <(tail -n +3 "$out/again/chain.md") || fail "the same seeds gave another table"

refused() { # EXPECTED ARGS…
  local said
  if said=$("$program" "${@:2}" --out "$out/none" 2>&1); then fail "accepted: ${*:2}"; fi
  grep -qF -- "$1" <<<"$said" || fail "${*:2}: '$said' does not say '$1'"
  [ ! -e "$out/none" ] || fail "${*:2}: began to work"
}
refused "did you mean 'two_dof_noise'" two_dof_nose
refused "There are: local_model, spherical, chain," help
refused "--quik" --quik
refused "--jobs" chain --jobs 0
[ -f "$out/all/all.md" ] && [ ! -e "$out/again/all.md" ] || fail "all.md is not of all experiments"
# Found before the work, not after it: there was no line of progress.
mkdir -p "$out/full/.probe"
if said=$("$program" chain --quick --out "$out/full" 2>&1); then fail "wrote where it cannot"; fi
grep -q 'cannot be written' <<<"$said" && ! grep -q 'chain: ' <<<"$said" || fail "an unwritable folder: $said"
if said=$("$program" chain --quick --out "$program/x" 2>&1); then fail "wrote into a program"; fi
echo passed
