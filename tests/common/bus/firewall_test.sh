#!/bin/bash
# firewall_test.sh README RELAY: tests the rules in config/README.md. Without them a packet that
# another machine sends to this one, to no multicast group, reaches a process on the bus, whatever its
# ttl; with them none does, and the bus itself still works. The other machine is a network namespace
# behind a veth pair.
set -euo pipefail
if [ "${1:-}" != inside ]; then
  unshare --user --map-root-user --net nft list ruleset 2>/dev/null ||
    { echo "SKIP: no namespaces or no packet filter" >&2; exit 77; }
  exec unshare --user --map-root-user --net --pid --fork --kill-child --mount-proc -- "$0" inside "$@"
fi
readme=$2 relay=$3
work=$(mktemp -d)
trap 'kill $(jobs -p) 2>/dev/null || true; wait; rm -rf "$work"' EXIT

# The N-th ```nft block.
rules() { awk -v wanted="$1" '/^```nft/ { n++; inside = 1; next } /^```/ { inside = 0 } inside && n == wanted' "$readme"; }
until_ok() {
  for _ in $(seq 600); do
    "$@" && return 0
    read -rt 0.05 <> <(:) || true
  done
  return 1
}
fail() {
  echo "$*" >&2
  cat "$work/relay.err" >&2
  exit 1
}

ip link set lo up multicast on
sleep infinity | unshare --net sh -c 'echo ready && exec cat' >"$work/other" &
other=$!
until_ok grep -q ready "$work/other"
ip link add name eth1 type veth peer name eth9
ip link set eth9 netns $other
ip addr add 192.168.7.1/24 dev eth1
ip link set eth1 up multicast on
there() { nsenter -t $other -n "$@"; }
there ip addr add 192.168.7.2/24 dev eth9
there ip addr add 192.168.7.9/24 dev eth9
there ip link set eth9 up multicast on
there ip route add 224.0.0.0/4 dev eth9

# A packet of LCM's on CHANNEL that no process can decode: a process that hears it reports it.
packet='printf "LC02\0\0\0\1$0\0junk" >"/dev/udp/$1/7700"'
here() { bash -c "$packet" "$@"; }
hears() { grep -q "$1: dropped a malformed message" "$work/relay.err"; }

begin() { # DEVICE ADDRESS: of the bus
  ip route replace 224.0.0.0/4 dev "$1" src "$2"
  : >"$work/relay.err"
  "$relay" --config "$work/relay.yaml" --in 'udpm://239.255.76.67:7700?ttl=0' >"$work/relay.out" 2>"$work/relay.err" &
  process=$!
  until_ok grep -q ready "$work/relay.out" || fail "the process does not start"
}
end() { kill -TERM "$process"; wait "$process" || fail "the process failed"; }
# The process has reported every earlier packet once it reports one on MOTION_STATUS.
drain() {
  drained() { here MOTION_STATUS 239.255.76.67 && hears MOTION_STATUS; }
  until_ok drained || fail "the bus itself is cut off: $1"
}
echo "a: 1" >"$work/relay.yaml"

begin lo 127.0.0.1
reached() { there bash -c "$packet" SAMPLE 192.168.7.1 && hears SAMPLE; }
until_ok reached || fail "without rules a packet from another machine does not arrive: this test tests nothing"
end

[ -n "$(rules 1)" ] && [ -n "$(rules 2)" ] || fail "no rules in $readme"
nft -f <(rules 1)
begin lo 127.0.0.1
for _ in $(seq 20); do there bash -c "$packet" SAMPLE 192.168.7.1; done
drain "one machine"
hears SAMPLE && fail "a packet from another machine came through the rules for one machine"
end

nft flush ruleset
nft -f <(rules 2)
begin eth1 192.168.7.1
reached_group() { there bash -c "$packet" SAMPLE 239.255.76.67 && hears SAMPLE; }
until_ok reached_group || fail "the rules for several machines cut off the other machine"
end
begin eth1 192.168.7.1
there ip route replace 224.0.0.0/4 dev eth9 src 192.168.7.9
for _ in $(seq 20); do
  there bash -c "$packet" SAMPLE 192.168.7.1
  there bash -c "$packet" SAMPLE 239.255.76.67
done
drain "several machines"
hears SAMPLE && fail "a stranger's packet, or one to no group, came through the rules for several machines"
end
