#!/usr/bin/env bash
# Makes the reference of the API in build/docs from the docstrings; fails on a broken reference.
source "$(dirname "${BASH_SOURCE[0]}")/environment.sh" dev
exec python scripts/docs.py
