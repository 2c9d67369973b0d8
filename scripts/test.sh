#!/usr/bin/env bash
# Sets up .venv with the test extras, then runs the linters, the type checker and the whole suite.
# Arguments go to pytest: bash scripts/test.sh --run-slow
source "$(dirname "${BASH_SOURCE[0]}")/environment.sh" dev
ruff check .
ruff format --check .
mypy
export OMP_NUM_THREADS=${OMP_NUM_THREADS:-1}
exec python -m pytest -q -n "${TORCHRG_TEST_WORKERS:-2}" "$@"
