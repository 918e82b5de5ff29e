#!/bin/sh
# lcm-spy with the types of this folder: `./run exec lcmtypes/spy.sh`. Needs a display and the Debian
# packages default-jdk, liblcm-java and libjchart2d-java. `spy.sh --jar` only prints the file of types.
set -eu
here=$(cd "$(dirname "$0")" && pwd)
build=${BODYSCHEMA_BUILD:-$here/../build}
jar=$build/lcmtypes/bodyschema.jar
for need in lcm-gen javac jar /usr/share/java/lcm.jar; do
  command -v "$need" >/dev/null || [ -f "$need" ] || {
    echo "spy.sh: $need is missing. Type: apt-get install default-jdk liblcm-java libjchart2d-java" >&2
    exit 1
  }
done
if [ ! -f "$jar" ] || [ -n "$(find "$here" -name '*.lcm' -newer "$jar")" ]; then
  work=$(mktemp -d)
  trap 'rm -rf "$work"' EXIT
  lcm-gen --java --jpath="$work/sources" "$here"/*.lcm
  javac -nowarn -d "$work/classes" -cp /usr/share/java/lcm.jar "$work"/sources/bodyschema/*.java
  mkdir -p "$build/lcmtypes"
  jar cf "$work/bodyschema.jar" -C "$work/classes" .
  mv "$work/bodyschema.jar" "$jar"
fi
[ "${1:-}" != --jar ] || { echo "$jar"; exit 0; }
# Debian's lcm-spy asks for options that Java has given up.
export JDK_JAVA_OPTIONS=-XX:+IgnoreUnrecognizedVMOptions
CLASSPATH=$jar exec lcm-spy "$@"
