#!/bin/bash
# spy_types.sh LCMTYPES_FOLDER: lcm-spy's jar holds a class for every message type, without a display.
set -euo pipefail
command -v javac >/dev/null && [ -f /usr/share/java/lcm.jar ] || { echo "SKIP: no Java for LCM"; exit 77; }
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
jar=$(BODYSCHEMA_BUILD="$work/a build" "$1/spy.sh" --jar)
[ "$jar" = "$work/a build/lcmtypes/bodyschema.jar" ]
diff <(jar tf "$jar" | sed -n 's|^bodyschema/\(.*\)\.class$|\1|p' | sort) <(cd "$1" && ls *.lcm | sed 's/\.lcm$//' | sort)
# A second call uses what is there.
before=$(stat -c %y "$jar")
BODYSCHEMA_BUILD="$work/a build" "$1/spy.sh" --jar >/dev/null
[ "$(stat -c %y "$jar")" = "$before" ]
