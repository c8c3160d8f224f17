#!/usr/bin/env bash
# Checks taisoft on a machine with one GPU, Python 3.12 and no network, in under eight minutes.
#
#   benchmarks/gpu.sh --fetch WHEELS     on a machine with a network: fetch the wheels (60 MB)
#   benchmarks/gpu.sh WHEELS OUT         on the machine with the GPU: install them aside, write OUT/gpu.md and .json
#
# NumPy and SciPy are taken from the machine; add their wheels to WHEELS where it has none. Further arguments go to
# `taisoft bench gpu`. PYTHON names the interpreter. A wheel that cannot be installed does not stop the rest.
set -uo pipefail
PYTHON=${PYTHON:-python3}

if [ "${1:-}" = "--fetch" ] && [ -n "${2:-}" ]; then
  platforms=()
  for tag in manylinux_2_28 manylinux_2_27 manylinux_2_17 manylinux2014; do platforms+=(--platform "${tag}_x86_64"); done
  exec "$PYTHON" -m pip download --quiet --no-deps --only-binary=:all: --python-version 3.12 --implementation cp \
    "${platforms[@]}" --dest "$2" taichi==1.7.4 meshio networkx colorama dill rich markdown-it-py mdurl pygments \
    pytest iniconfig pluggy packaging
fi
if [ -z "${1:-}" ] || [ -z "${2:-}" ] || [ ! -d "${1:-}" ]; then
  sed -n '2,8s/^# \{0,1\}//p' "$0" >&2
  exit 2
fi

wheels=$(realpath "$1") && mkdir -p "$2" && out=$(realpath "$2") || exit 2
shift 2
cd "$(dirname "$0")/.." || exit 2
site=$(mktemp -d)
trap 'rm -rf "$site"' EXIT
for wheel in "$wheels"/*.whl; do
  [ -e "$wheel" ] || continue
  "$PYTHON" -m pip install --quiet --no-index --no-deps --no-compile --no-cache-dir --target "$site" "$wheel" ||
    echo "could not be installed: $wheel" | tee -a "$out/not-installed.txt" >&2
done
export PYTHONPATH="$site:$PWD${PYTHONPATH:+:$PYTHONPATH}" XDG_CACHE_HOME="$site/cache"
"$PYTHON" -m taisoft bench gpu --arch cuda --out "$out/gpu.json" "$@"
