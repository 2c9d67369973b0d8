# Sourced by other scripts: creates an environment once, with the extras in $1, and activates it.
# It is .venv or, with $2 = lowest, .venv-lowest with the oldest versions that pyproject.toml allows.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

extras=${1:-} kind=${2:-}
venv=.venv${kind:+-$kind}
python=${PYTHON:-python3}
if ! "$python" -c 'import sys; sys.exit(sys.version_info < (3, 10))' 2>/dev/null; then
  echo "torchrg needs Python 3.10 or newer; set PYTHON to one, as in PYTHON=python3.12 bash $0" >&2
  exit 2
fi

sources=(pyproject.toml scripts/constraints.txt scripts/build_kernels.py torchrg/kernels/*.{cpp,h})
stamp=$venv/.torchrg-$(cat "${sources[@]}" | cksum | tr ' ' '-')${extras:+-$extras}
if [ ! -e "$stamp" ] || [ -n "$(find torchrg/kernels/*.{cpp,h} -newer "$stamp")" ]; then
  site=$("$python" -c 'import importlib.util as u; print("--system-site-packages" if u.find_spec("torch") else "")')
  [ -z "$kind" ] || site=
  [ -x "$venv/bin/python" ] || "$python" -m venv $site "$venv"
  install=("$venv/bin/python" -m pip install --quiet --disable-pip-version-check)
  # Without a compiler, download one for the build only (100 MB), or build no kernels.
  target=$("$python" -c 'import platform; print(platform.machine() + {"Linux": "-linux-gnu.2.17"}.get(platform.system(), "-macos.11.0"))')
  install_torchrg() {
    if [ -n "${TORCHRG_KERNELS+set}" ] || ${CXX:-c++} --version > /dev/null 2>&1; then
      "${install[@]}" "$@"
    elif TORCHRG_KERNELS=${target/arm64/aarch64} "${install[@]}" "$@" 2> /dev/null; then
      echo "No C++ compiler found: the package ziglang compiled the kernels of torchrg."
    else
      TORCHRG_KERNELS=0 "${install[@]}" "$@"
      echo "No C++ compiler found, and ziglang is not available: torchrg runs slower without its kernels."
    fi
  }
  echo "Installing torchrg into $venv (once; some minutes if PyTorch must be downloaded) ..."
  if [ -n "$kind" ]; then
    # "laspy[lazrs]>=2.5" becomes laspy==2.5
    grep -oE '"[A-Za-z0-9_-]+(\[[a-z,]+\])?>=[0-9.]+"' pyproject.toml | tr -d '"' |
      sed -E 's/(\[.*\])?>=/==/' | sort -u > "$venv/constraints.txt"
    install_torchrg -c "$venv/constraints.txt" -e ".${extras:+[$extras]}"
  else
    "$venv/bin/python" -c 'import torch' 2>/dev/null ||
      "${install[@]}" -c scripts/constraints.txt torch
    install_torchrg -e ".${extras:+[$extras]}"
  fi
  rm -f "$venv"/.torchrg-*"${extras:+-$extras}"
  touch "$stamp"
fi
export PATH="$PWD/$venv/bin:$PATH"
