#!/bin/bash
# Runs a command in the environment of ROS and of fus3dmaps.
set -e
# shellcheck disable=SC1090  (the images name them)
. "$ROS_SETUP"
. "$FUS3DMAPS_SETUP"
exec "$@"
