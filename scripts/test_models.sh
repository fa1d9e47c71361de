#!/usr/bin/env bash
# Runs the tests of the encoders that need the extra "models", on their true architectures with random weights. Arguments go
# to pytest:
#   scripts/test_models.sh                everything
#   scripts/test_models.sh -k naradio     some tests
#   scripts/test_models.sh --environment-only   none: makes the environment, where it is not up to date
# The packages of the extra go into .venv-models beside this folder, pinned by constraints-models.txt and installed at the
# first run (about a minute and 5 GB, nearly all of it torch for CUDA, to which PyPI's torchvision is bound). All else, ROS and
# the package itself too, it takes from .venv, which is set up first and stays as it is.
#
#   FUS3DMAPS_MODELS_VENV       where the environment is instead of .venv-models
#   FUS3DMAPS_TORCH_INDEX_URL   package index for torch and torchvision alone, as for scripts/setup.sh
set -euo pipefail

ROOT=$(cd -- "$(dirname -- "${BASH_SOURCE[0]}")/.." && pwd -P)
BASE=$ROOT/.venv
VENV=$(realpath -m -- "${FUS3DMAPS_MODELS_VENV:-$ROOT/.venv-models}")
STAMP=$VENV/.fus3dmaps
bash "$ROOT/scripts/setup.sh"
source "$ROOT/scripts/isolate.sh"
# As scripts/test.sh has it: nodes of these tests and everybody else's do not meet.
export ROS_DOMAIN_ID=${FUS3DMAPS_TEST_DOMAIN_ID:-$((1 + RANDOM % 101))}
export ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST

# Prints what setup.py asks for in the extra.
list_requirements() {
    (cd -- "$ROOT" && "$BASE/bin/python") <<'PYTHON'
import setuptools  # brings distutils where Python no longer has it
from distutils.core import run_setup

print("\n".join(run_setup("setup.py", stop_after="init").extras_require["models"]))
PYTHON
}

# Prints the pins of both environments; where both name a package, the one of this environment.
list_pins() { awk -F '==' '!/^#/ && !seen[$1]++' "$ROOT/constraints-models.txt" "$ROOT/constraints.txt"; }

# Lets the new environment find what the base has after what is its own.
join_base() {
    local packages
    packages=$("$BASE/bin/python" -c 'import sysconfig; print(sysconfig.get_paths()["purelib"])')
    "$VENV/bin/python" - "$BASE" "$packages" <<'PYTHON'
import sys
import sysconfig
from pathlib import Path

base, packages = sys.argv[1:]
own = Path(sysconfig.get_paths()["purelib"])
(own / "fus3dmaps_base.py").write_text(f'''\
"""Adds the packages of the base environment to those of this one, and heeds its .pth files."""

import site
import sys

own = sys.prefix
# The ROS wheels look for their shared libraries below the prefix, and start Python anew with a path to them.
sys.prefix = {base!r}
try:
    site.addsitedir({packages!r})
finally:
    sys.prefix = own
''')
(own / "fus3dmaps_base.pth").write_text("import fus3dmaps_base\n")
PYTHON
}

pip_install() {
    "$VENV/bin/python" -m pip install --disable-pip-version-check --no-input --no-compile --progress-bar off --quiet \
        -c <(list_pins) "$@"
}

make_environment() {
    if [[ -e $VENV && ! -f $VENV/pyvenv.cfg ]]; then
        printf 'models: %s is no environment of Python; it is left alone\n' "$VENV" >&2
        exit 1
    fi
    rm -rf -- "$VENV"
    "$BASE/bin/python" -m venv --without-pip "$VENV"
    touch -- "$VENV/COLCON_IGNORE"
    join_base
    if [[ -n ${FUS3DMAPS_TORCH_INDEX_URL:-} ]]; then
        pip_install --index-url "$FUS3DMAPS_TORCH_INDEX_URL" torch torchvision
    fi
    pip_install -r <(printf '%s\n' "$requirements")
    # Fails here, with its own words, where torchvision is another torch's, or where ROS is not found.
    "$VENV/bin/python" -c 'import open_clip, rclpy, timm, torchvision, fus3dmaps_core, fus3dmaps_msgs'
}

lock() { if command -v flock >/dev/null; then flock "$@" 9; fi; }
is_made() { [[ -f $STAMP && $(<"$STAMP") == "$digest" ]]; }

requirements=$(list_requirements)
# The stamp of the base's dependencies says which ones, and by which Python; a base made anew from the same ones serves as well.
digest=$(printf '%s\n' "$requirements" "$VENV" "$(<"$BASE/.fus3dmaps/dependencies")" "${FUS3DMAPS_TORCH_INDEX_URL:-}" |
    cat -- "${BASH_SOURCE[0]}" "$ROOT/constraints-models.txt" - | sha256sum)
# Runs share the environment; one that makes it waits until no other is under way, and others wait for it.
mkdir -p -- "$ROOT/build"
exec 9>"$ROOT/build/models.lock"
lock -s
if ! is_made; then
    lock -x
    if ! is_made; then
        started=$SECONDS
        make_environment
        printf '%s\n' "$digest" >"$STAMP"
        printf 'models: environment made in %d s: %s\n' $((SECONDS - started)) "$VENV" >&2
    fi
    lock -s
fi

[[ ${1:-} != --environment-only ]] || exit 0
export PATH=$VENV/bin:$BASE/bin:$PATH
cd -- "$ROOT"
(($#)) || set -- -q
exec python -m pytest test/models "$@"
