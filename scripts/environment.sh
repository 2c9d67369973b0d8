# Sourced by demo.sh and test.sh: makes .venv once, with the extras named in $1, and activates it.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

extras=${1:-}
python=${PYTHON:-python3}
if ! "$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then
  echo "torchrg needs Python 3.11 or newer; set PYTHON to one, as in PYTHON=python3.12 bash $0" >&2
  exit 2
fi

stamp=.venv/.torchrg-$(cat pyproject.toml scripts/constraints.txt | cksum | tr ' ' '-')${extras:+-$extras}
if [ ! -e "$stamp" ]; then
  site=$("$python" -c 'import importlib.util as u; print("--system-site-packages" if u.find_spec("torch") else "")')
  [ -x .venv/bin/python ] || "$python" -m venv $site .venv
  echo "Installing torchrg into .venv (once; some minutes if PyTorch has to be downloaded) ..."
  .venv/bin/python -c 'import torch' 2>/dev/null ||
    .venv/bin/python -m pip install --quiet --disable-pip-version-check -c scripts/constraints.txt torch
  .venv/bin/python -m pip install --quiet --disable-pip-version-check -e ".${extras:+[$extras]}"
  rm -f .venv/.torchrg-*"${extras:+-$extras}"
  touch "$stamp"
fi
export PATH="$PWD/.venv/bin:$PATH"
