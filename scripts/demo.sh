#!/usr/bin/env bash
# Sets up, then maps a recording through a live ROS 2 node and asks it for things in words. Pictures go to out/demo/.
#   scripts/demo.sh                                a furnished room that it records itself
#   scripts/demo.sh RECORDING [PROMPT ...]         a rosbag2 directory or MCAP file
set -euo pipefail

ROOT=$(cd -- "$(dirname -- "${BASH_SOURCE[0]}")/.." && pwd -P)
bash "$ROOT/scripts/setup.sh"

source "$ROOT/scripts/isolate.sh"
exec "$ROOT/.venv/bin/fus3dmaps" demo --out "$ROOT/out/demo" "$@"
