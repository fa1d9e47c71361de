#!/usr/bin/env bash
# Runs the tests of the encoders that need the extra "models", on their true architectures with random weights. The packages
# go into .venv-models beside this folder, pinned by constraints-models.txt and made at the first run (about 2 minutes and
# 6 GB); the base environment stays as it is. Run scripts/setup.sh first. Arguments go to pytest.
set -euo pipefail

ROOT=$(cd -- "$(dirname -- "${BASH_SOURCE[0]}")/.." && pwd -P)
VENV=$ROOT/.venv-models
STAMP=$VENV/.fus3dmaps
EXTRAS=(models test)
source "$ROOT/scripts/isolate.sh"

# Prints what setup.py asks for, without Open3D: it draws pictures, which no test of an encoder does.
list_requirements() {
    (cd -- "$ROOT" && "$ROOT/.venv/bin/python" - "${EXTRAS[@]}") <<'PYTHON'
import sys

import setuptools  # brings distutils where Python no longer has it
from distutils.core import run_setup

package = run_setup("setup.py", stop_after="init")
lines = package.install_requires + [line for extra in sys.argv[1:] for line in package.extras_require[extra]]
print("\n".join(line for line in lines if not line.startswith("open3d")))
PYTHON
}

make_environment() {
    rm -rf -- "$VENV"
    "$ROOT/.venv/bin/python" -m venv "$VENV"
    touch -- "$VENV/COLCON_IGNORE"
    "$VENV/bin/python" -m pip install --disable-pip-version-check --no-input --no-compile --progress-bar off --quiet \
        -c "$ROOT/constraints-models.txt" -r <(printf '%s\n' "$requirements")
    # Fails here, with its own words, where torchvision is another torch's.
    "$VENV/bin/python" -c 'import open_clip, timm, torchvision'
}

# Two runs at once would make the environment under each other's feet.
if command -v flock >/dev/null; then
    mkdir -p -- "$ROOT/build"
    exec 9>"$ROOT/build/models.lock"
    flock 9
fi
requirements=$(list_requirements)
digest=$(cat -- "$ROOT/constraints-models.txt" "${BASH_SOURCE[0]}" <(printf '%s\n' "$requirements" "$VENV") | sha256sum)
if [[ ! -f $STAMP || $(<"$STAMP") != "$digest" ]]; then
    started=$SECONDS
    make_environment
    printf '%s\n' "$digest" >"$STAMP"
    printf 'models: environment made in %d s\n' $((SECONDS - started)) >&2
fi
exec 9>&-

cd -- "$ROOT"
(($#)) || set -- -q
exec "$VENV/bin/python" -m pytest test/models "$@"
