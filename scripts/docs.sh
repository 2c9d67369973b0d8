#!/usr/bin/env bash
# Builds the documentation in build/docs: guides with tested examples, commands and API reference.
# Fails on a failing example, and on a broken name or link.
source "$(dirname "${BASH_SOURCE[0]}")/environment.sh" dev
export OMP_NUM_THREADS=${OMP_NUM_THREADS:-1}
exec python scripts/docs.py
