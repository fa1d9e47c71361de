"""The repository's own descriptions of itself, as the tools that use them read them."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
import setuptools  # noqa: F401  brings distutils where Python no longer has it
from catkin_pkg.package import Package, parse_package
from packaging.utils import canonicalize_name

if TYPE_CHECKING:
    from setuptools import Distribution


@pytest.fixture(scope="session")
def root() -> Path:
    return Path(__file__).resolve().parents[2]


@pytest.fixture(scope="session")
def distribution(root: Path) -> Distribution:
    from distutils.core import run_setup

    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(root)
        return run_setup("setup.py", stop_after="init")


@pytest.fixture(scope="session")
def manifest(root: Path) -> Package:
    return parse_package(root / "package.xml")


@pytest.fixture(scope="session")
def interface_manifest(root: Path) -> Package:
    return parse_package(root / "fus3dmaps_msgs" / "package.xml")


@pytest.fixture(scope="session")
def pins(root: Path) -> dict[str, str]:
    """Release by canonical name, from constraints.txt."""
    return read_pins(root / "constraints.txt")


@pytest.fixture(scope="session")
def pins_of_models(root: Path) -> dict[str, str]:
    """Release by canonical name, from constraints-models.txt."""
    return read_pins(root / "constraints-models.txt")


def read_pins(path: Path) -> dict[str, str]:
    found: dict[str, str] = {}
    for line in path.read_text().splitlines():
        if line.startswith("#"):
            continue
        pin = re.fullmatch(r"([a-z0-9.-]+)==([0-9][0-9a-z.]*)", line)
        assert pin, f"{path.name}: {line!r} pins no single release"
        assert canonicalize_name(pin[1]) not in found, f"{path.name}: {pin[1]} twice"
        found[canonicalize_name(pin[1])] = pin[2]
    return found
