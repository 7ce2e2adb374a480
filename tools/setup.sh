#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# Make .venv hold loopcal: `tools/setup.sh core` (what a user installs) or `tools/setup.sh dev` (with all checks).
# PYTHON=/path/to/python chooses the interpreter; otherwise the first one found that is 3.11 or newer and has venv.
set -euo pipefail
cd "$(dirname "$0")/.."

fail() { echo "set-up: $1" >&2; exit 1; }
usable() { "$1" -c 'import ensurepip, sys, venv; sys.exit(sys.version_info < (3, 11))' >/dev/null 2>&1; }

command -v git >/dev/null || fail "git was not found; install it (Debian: apt-get install git) and run make again."
if [ ! -x .venv/bin/python ] || ! .venv/bin/python -c '' 2>/dev/null; then
    found=""
    for candidate in ${PYTHON:-python3 python3.14 python3.13 python3.12 python3.11}; do
        if usable "$candidate"; then found=$candidate; break; fi
    done
    [ -n "$found" ] || fail "no Python 3.11 or newer with venv was found under ${PYTHON:-the names python3, python3.14 to python3.11}; install one (Debian: apt-get install python3-venv) or run make PYTHON=/path/to/python."
    "$found" -m venv --clear .venv
fi

minor=$(.venv/bin/python -c 'import sys; print("{}.{}".format(*sys.version_info))')
target=.
[ "$1" = core ] || target=".[$1]"
constraints=constraints/python$minor.txt
if [ -f "$constraints" ]; then pinned=(-c "$constraints"); else pinned=(); fi
echo "set-up: installing loopcal ($1) for Python $minor into .venv${pinned:+ with $constraints}"
.venv/bin/python -m pip install --quiet --disable-pip-version-check ${pinned[@]+"${pinned[@]}"} -e "$target"
