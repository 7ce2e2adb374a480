#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# Build the native engine into .venv: `tools/native.sh STAMP`, which is written when it computes. Without a C++ compiler,
# or where the build fails, one line says so and NumPy computes. CXX=... chooses the compiler.
set -euo pipefail
cd "$(dirname "$0")/.."
python=$PWD/.venv/bin/python log=$PWD/.venv/native.log

use_numpy() {  # use_numpy REASON: no older build stays behind; LOOPCAL_STRICT=1 makes this a failure
    "$python" -m pip uninstall --quiet --disable-pip-version-check -y loopcal-native >/dev/null 2>&1 || true
    echo "set-up: $1; NumPy computes"
    [ "${LOOPCAL_STRICT:-}" != 1 ] || exit 1
    exit 0
}

compiler=${CXX:-}
for name in g++ clang++ c++; do
    [ -n "$compiler" ] || ! command -v "$name" >/dev/null || compiler=$name
done
[ -n "$compiler" ] || use_numpy "no C++ compiler was found (g++, clang++ or c++), the native engine is not built"

echo "set-up: building the native engine with $compiler into .venv"
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cp -r native "$work/native"  # the build leaves files beside its source
rm -rf "$work"/native/build "$work"/native/src/*.egg-info
CXX=$compiler "$python" -m pip install --disable-pip-version-check --no-deps --force-reinstall "$work/native" \
    >"$log" 2>&1 || use_numpy "the native engine cannot be built (see .venv/native.log)"
engine=$("$python" -c 'from loopcal.engine import select_engine; print(select_engine("native"))' 2>>"$log") ||
    use_numpy "the native engine does not run (see .venv/native.log)"
touch "$1"
echo "set-up: $engine computes; LOOPCAL_ENGINE=numpy chooses NumPy"
