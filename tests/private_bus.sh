#!/bin/sh
# Runs a command on an LCM bus of its own: `tests/private_bus.sh COMMAND…`.
# Two LCM programs with the same port hear each other whatever their groups, so a port of one's own
# is not enough: the command gets a network and a process namespace. Needs no root. Exit code: the
# command's; 77 ("skip") if namespaces are not allowed.
[ $# -gt 0 ] || { echo "usage: $0 COMMAND..." >&2; exit 2; }
unshare --user --map-root-user --net true 2>/dev/null || {
  echo "SKIP: this machine allows no user namespaces" >&2
  exit 77
}
LCM_DEFAULT_URL='udpm://239.255.76.67:7667?ttl=0'
export LCM_DEFAULT_URL
# The inner shell stays process 1: with exec the command would be, and an init process ignores
# signals that it does not handle. --kill-child ends the whole group with it.
exec unshare --user --map-root-user --net --pid --fork --kill-child --mount-proc -- sh -c '
  ip link set lo up multicast on && ip route add 224.0.0.0/4 dev lo || {
    echo "SKIP: cannot route multicast in a network namespace" >&2
    exit 77
  }
  "$@"
  exit $?' sh "$@"
