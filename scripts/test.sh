#!/usr/bin/env bash
# Sets up .venv with the test extras, then runs the linters, the type checker and the whole suite.
# Arguments go to pytest: bash scripts/test.sh --run-slow
# With --lowest first: only the suite, in .venv-lowest with the oldest versions that pyproject.toml
# allows (several GB, Python 3.10 to 3.12). Warnings are not errors there, because old packages use
# deprecated functions of newer dependencies.
if [ "${1:-}" = --lowest ]; then
  shift
  source "$(dirname "${BASH_SOURCE[0]}")/environment.sh" dev,ray lowest
  set -- -W default "$@"
else
  source "$(dirname "${BASH_SOURCE[0]}")/environment.sh" dev
  ruff check .
  ruff format --check .
  mypy
fi
export OMP_NUM_THREADS=${OMP_NUM_THREADS:-1}
exec python -m pytest -q -n "${TORCHRG_TEST_WORKERS:-2}" "$@"
