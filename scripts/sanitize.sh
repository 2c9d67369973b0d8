#!/usr/bin/env bash
# Runs the tests of the kernels with kernels that check memory and undefined behavior (GCC's
# AddressSanitizer and UndefinedBehaviorSanitizer), in a copy of the repository. Linux only.
source "$(dirname "${BASH_SOURCE[0]}")/environment.sh" dev
copy=$(mktemp -d)
trap 'rm -rf "$copy"' EXIT
cp -r configs pyproject.toml README.md LICENSE scripts tests torchrg "$copy"
cd "$copy"
rm -f torchrg/kernels/libkernels-*
compile=("${CXX:-g++}" -std=c++17 -O1 -g -shared -fPIC -fvisibility=hidden -fno-exceptions -fno-rtti)
compile+=(-Wno-psabi -fno-math-errno -fno-trapping-math -ffp-contract=off)
compile+=(-fsanitize=address,undefined -fno-sanitize-recover=all)
"${compile[@]}" torchrg/kernels/*.cpp -o torchrg/kernels/libkernels-base.library
if [ "$(uname -m)" = x86_64 ]; then
  "${compile[@]}" -mavx2 torchrg/kernels/*.cpp -o torchrg/kernels/libkernels-avx2.library
fi
library() { "${CXX:-g++}" -print-file-name="$1"; }
export LD_PRELOAD="$(library libasan.so) $(library libstdc++.so)" ASAN_OPTIONS=detect_leaks=0
python -c 'from torchrg import kernels; assert kernels.name_of_library()'
# Tests of other folders also compare kernels with their definitions.
files=$(grep -rl "tests.kernels.clouds import" tests --include="test_*.py" | grep -v "^tests/kernels/")
# A fault ends the process; -s shows its report, and one process runs all tests.
# shellcheck disable=SC2086
python -m pytest -q -s -n 0 -p no:cacheprovider tests/kernels $files "$@"
