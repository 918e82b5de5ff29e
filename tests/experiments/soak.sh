#!/bin/bash
# soak.sh [--samples N] [--keep FOLDER]: soak.cpp on a bus of its own.
# Needs: soak
set -euo pipefail
here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
exec "$here/../private_bus.sh" "$BODYSCHEMA_BUILD/bin/soak" "$@"
