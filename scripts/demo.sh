#!/usr/bin/env bash
# Sets up, then maps a recording through a live ROS 2 node and asks it for things in words. Pictures go to out/demo/.
#   scripts/demo.sh                                a furnished room that it records itself
#   scripts/demo.sh RECORDING [PROMPT ...]         a rosbag2 directory or MCAP file
set -euo pipefail

ROOT=$(cd -- "$(dirname -- "${BASH_SOURCE[0]}")/.." && pwd -P)
bash "$ROOT/scripts/setup.sh"

# A ROS set-up in the calling shell must not reach into the environment.
unset PYTHONPATH PYTHONHOME AMENT_PREFIX_PATH CMAKE_PREFIX_PATH RMW_IMPLEMENTATION ROS_DISCOVERY_SERVER ROS_LOCALHOST_ONLY
if [[ -n ${_ROS_WHEELS_BOOTSTRAP_COMPLETE:-} ]]; then
    unset _ROS_WHEELS_BOOTSTRAP_COMPLETE LD_LIBRARY_PATH
fi
exec "$ROOT/.venv/bin/fus3dmaps" demo --out "$ROOT/out/demo" "$@"
