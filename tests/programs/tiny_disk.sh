#!/bin/sh
# tiny_disk.sh COMMAND…: runs a command in a mount namespace where $TINY_DISK is a file system of
# 64 kB, which is easily filled. Exit code 77 ("skip") where namespaces are not allowed.
TINY_DISK=$(mktemp -d) || exit 2
export TINY_DISK
unshare --mount true 2>/dev/null || {
  echo "SKIP: this machine allows no mount namespaces" >&2
  exit 77
}
unshare --mount -- sh -c '
  mount -t tmpfs -o size=64k tiny "$TINY_DISK" || { echo "SKIP: cannot mount a tmpfs" >&2; exit 77; }
  "$@"
  exit $?' sh "$@"
status=$?
rmdir "$TINY_DISK"
exit $status
