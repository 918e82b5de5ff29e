#!/bin/bash
# hosts.sh RIG_FOLDER HOSTS LOSS_PER_MILLE SAMPLES FOLDER: a rig's group split over 2 or 3 hosts, each a network namespace of its own
# on one bridge, that loses LOSS_PER_MILLE of the frames that arrive at each host. Each host's share is started as a user would, by
# ./run --host. Leaves FOLDER/<host>/current, and FOLDER/lost with the number of frames lost per host.
# Exit code 77 ("skip") where namespaces or packet filters are not allowed. BODYSCHEMA_BUILD names the build.
set -euo pipefail
PATH=$PATH:/usr/sbin:/sbin
source=$(cd "$(dirname "${BASH_SOURCE[0]}")/../.." && pwd)
if [ "$1" != inside ]; then
  unshare --user --map-root-user --net true 2>/dev/null || { echo "SKIP: no user namespaces" >&2; exit 77; }
  # The shell stays process 1; everything left over ends with it.
  exec unshare --user --map-root-user --net --pid --fork --kill-child --mount-proc -- \
    bash -c '"$@"; exit $?' bash "${BASH_SOURCE[0]}" inside "$@"
fi
rig=$2 num_hosts=$3 loss=$4 samples=$5 folder=$6
case $num_hosts in
  2) hosts=(robot learning) ;;
  3) hosts=(robot eye learning) ;;
  *) echo "hosts.sh: HOSTS is 2 or 3" >&2; exit 2 ;;
esac

fail() {
  echo "hosts.sh: $*" >&2
  for file in "$folder"/*.err; do tail -n 5 "$file" >&2; done
  exit 1
}
# Runs a command every 50 ms until it succeeds, for at most SECONDS.
until_ok() { # SECONDS COMMAND…
  local end=$(($(date +%s) + $1))
  until "${@:2}"; do
    [ "$(date +%s)" -lt "$end" ] || return 1
    read -rt 0.05 <> <(:) || true
  done
}

mkdir -p "$folder"
cp -r "$rig" "$folder/rig"
chmod -R u+w "$folder/rig"
# All processes except robot and camera run on the learning host.
seeing="camera marker_estimator observer log_images"
learning=
group=$(PYTHONPATH="$source" python3 -B -c 'import pathlib, sys; from launcher import group_file
print(*group_file.processes(*map(pathlib.Path, sys.argv[1:])))' "$source/config/group.conf" "$rig")
for name in $group; do
  [[ " robot_simulator $seeing " == *" $name "* ]] || learning+=" $name"
done
list() { echo "[$(tr -s ' ' ',' <<<"${*# }")]"; }
{
  printf 'network: host\nport: 7667\nttl: 1\nhosts:\n'
  if [ "$num_hosts" = 2 ]; then
    echo "  robot: $(list robot_simulator "$seeing")"
  else
    echo "  robot: $(list robot_simulator)"
    echo "  eye: $(list "$seeing")"
  fi
  echo "  learning: $(list "$learning")"
} >"$folder/rig/network.yaml"

# One network namespace a host, joined by a bridge that floods multicast.
ip link add bridge type bridge mcast_snooping 0 2>/dev/null && ip link set bridge up ||
  { echo "SKIP: no bridges here" >&2; exit 77; }
is_apart() { [ "$(readlink "/proc/$1/ns/net" 2>/dev/null)" != "$(readlink /proc/self/ns/net)" ]; }
declare -A holder run
number=0
for host in "${hosts[@]}"; do
  number=$((number + 1))
  unshare --net sleep infinity &
  holder[$host]=$!
  until_ok 10 is_apart "${holder[$host]}" || fail "no network namespace"
  ip link add "to_$host" master bridge type veth peer name eth0 netns "${holder[$host]}"
  ip link set "to_$host" up
  nsenter -t "${holder[$host]}" -n sh -c "
    ip link set lo up && ip address add 10.0.0.$number/24 dev eth0 && ip link set eth0 up && ip route add 224.0.0.0/4 dev eth0"
  [ "$loss" = 0 ] || nsenter -t "${holder[$host]}" -n sh -c "
    nft add table netdev loss && nft add chain netdev loss in '{ type filter hook ingress device eth0 priority 0; }' &&
      nft add rule netdev loss in numgen random mod 1000 '<' $loss counter drop" 2>"$folder/nft.err" ||
    { echo "SKIP: no packet filter: $(cat "$folder/nft.err")" >&2; exit 77; }
done

# Shares are started in any order; here passive ones come last.
share() { # HOST: its ./run, on its network
  BODYSCHEMA_LOGS=$folder/$1 exec nsenter -t "${holder[$1]}" -n \
    "$source/run" --rig "$folder/rig" --host "$1" --ideal --seed 3 --samples "$samples"
}
for ((i = num_hosts - 1; i >= 0; --i)); do
  host=${hosts[$i]}
  share "$host" >"$folder/$host.out" 2>"$folder/$host.err" </dev/null &
  run[$host]=$!
done
is_up() { [ -S "$(cat "$folder/$1/current/socket" 2>/dev/null)" ]; }
for host in "${hosts[@]}"; do until_ok 30 is_up "$host" || fail "$host does not start"; done
# A second share on the same host is refused.
if (share robot) >"$folder/second.out" 2>&1; then fail "a second group was started on one host"; fi
grep -q "a group runs already" "$folder/second.out" || fail "refused otherwise: $(cat "$folder/second.out")"

has_result_or_ended() { grep -q "Runs on" "$folder/learning.err" || ! kill -0 "${run[learning]}" 2>/dev/null; }
until_ok $((60 + samples * 2)) has_result_or_ended || fail "no result"
[ -f "$folder/learning/current/result.json" ] || fail "the learning host ended without a result"

# Every host hears every process.
for host in "${hosts[@]}"; do
  BODYSCHEMA_LOGS=$folder/$host nsenter -t "${holder[$host]}" -n "$source/run" status --json --seconds 4 \
    >"$folder/$host/status.json" 2>"$folder/$host/status.err" || fail "no status on $host: $(cat "$folder/$host/status.err")"
done
: >"$folder/lost"
for host in "${hosts[@]}"; do
  [ "$loss" = 0 ] || echo "$host $(nsenter -t "${holder[$host]}" -n nft list ruleset | sed -n 's/.*counter packets \([0-9]*\).*/\1/p')" >>"$folder/lost"
done
# One host is ended by a signal to its ./run, the others by ./run stop.
kill -TERM "${run[learning]}"
for host in "${hosts[@]}"; do
  [ "$host" = learning ] || BODYSCHEMA_LOGS=$folder/$host "$source/run" stop 2>/dev/null
done
for host in "${hosts[@]}"; do
  until_ok 20 sh -c "! kill -0 ${run[$host]} 2>/dev/null" || fail "./run --host $host did not end"
  status=0
  wait "${run[$host]}" || status=$?
  [ "$status" = 0 ] || fail "./run --host $host ended with exit code $status"
  kill "${holder[$host]}"
done
left=$(ps -eo pid=,args= | grep -F "$folder" | grep -vE "hosts.sh|grep|ps -eo" || true)
[ -z "$left" ] || fail "left behind: $left"
