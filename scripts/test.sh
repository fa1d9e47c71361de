#!/usr/bin/env bash
# Sets up, then checks style and types and runs every test; those that need the extra "models" in an environment of their own
# (scripts/test_models.sh), which is made once. With arguments only pytest runs, in the base environment, and gets them:
#   scripts/test.sh                       everything
#   scripts/test.sh test/core -k voxel    some tests
set -euo pipefail

ROOT=$(cd -- "$(dirname -- "${BASH_SOURCE[0]}")/.." && pwd -P)
bash "$ROOT/scripts/setup.sh"

source "$ROOT/scripts/isolate.sh"
# Domains above 101 collide with the ports that Linux hands out; 0 is where everybody else is.
export ROS_DOMAIN_ID=${FUS3DMAPS_TEST_DOMAIN_ID:-$((1 + RANDOM % 101))}
export ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST
export PATH=$ROOT/.venv/bin:$PATH

# A relative path among the arguments is the caller's.
(($# == 0)) || exec python -m pytest --rootdir "$ROOT" -c "$ROOT/pyproject.toml" "$@"

cd -- "$ROOT"
failed=()
check() { # title, command...
    local title=$1
    shift
    printf '\n--- %s\n' "$title"
    "$@" || failed+=("$title")
}
check "ruff check" ruff check
check "ruff format" ruff format --check
check "mypy" mypy
check "pytest" python -m pytest -q --durations=5
check "pytest, extra models" bash scripts/test_models.sh -q --durations=5
if ((${#failed[@]})); then
    printf -v list '%s, ' "${failed[@]}"
    printf 'failed: %s\n' "${list%, }" >&2
    exit 1
fi
