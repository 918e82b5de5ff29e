#!/bin/bash
# foreign_robots.sh [--seeds N] [--family WORDS] [--keep DIR]: see foreign_robots.py. Markdown to stdout.
# Needs: bodyschema
set -euo pipefail
exec /usr/bin/python3 -B "$(dirname "${BASH_SOURCE[0]}")/foreign_robots.py" "$@"
