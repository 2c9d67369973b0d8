#!/usr/bin/env bash
# Makes the documentation, a site in build/docs: guides, whose examples run, commands and reference.
# Fails on an example that fails, and on a name or link that leads nowhere.
source "$(dirname "${BASH_SOURCE[0]}")/environment.sh" dev
export OMP_NUM_THREADS=${OMP_NUM_THREADS:-1}
exec python scripts/docs.py
