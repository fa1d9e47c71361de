"""The environment of the models: the pinned releases of its own, over the base environment that it leaves as it is."""

from __future__ import annotations

import importlib.metadata
import sys
import sysconfig
from importlib.util import find_spec
from pathlib import Path

import pytest
import rclpy
from packaging.utils import canonicalize_name
from packaging.version import Version
from rclpy.context import Context

ROOT = Path(__file__).resolve().parents[2]
OWN = Path(sysconfig.get_paths()["purelib"])
BASE = ROOT / ".venv"


def read_pins(name: str) -> dict[str, str]:
    lines = (ROOT / name).read_text().splitlines()
    return dict(line.split("==") for line in lines if not line.startswith("#"))


def test_what_it_has_of_its_own_is_pinned_and_not_what_the_base_has():
    pins = read_pins("constraints.txt") | read_pins("constraints-models.txt")
    own = {canonicalize_name(package.name): package.version for package in importlib.metadata.distributions(path=[str(OWN)])}
    assert {"torch", "torchvision", "timm", "open-clip-torch", "onnx", "onnxruntime"} <= own.keys()
    assert {name: Version(version).public for name, version in own.items()} == {name: pins[name] for name in own}
    base = str(BASE / OWN.relative_to(sys.prefix))
    for name, version in own.items():
        assert version not in {package.version for package in importlib.metadata.distributions(name=name, path=[base])}


@pytest.mark.parametrize("module", ["numpy", "cv2", "numba", "transformers", "rclpy", "fus3dmaps_msgs"])
def test_the_rest_is_the_bases(module):
    origin = find_spec(module).origin
    assert Path(origin).is_relative_to(BASE)


def test_ros_starts():
    context = Context()
    rclpy.init(args=[], context=context)
    rclpy.create_node("somebody", context=context).destroy_node()
    rclpy.shutdown(context=context)
