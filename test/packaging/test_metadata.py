"""setup.py, package.xml and the code agree with one another."""

from __future__ import annotations

import ast
import importlib.metadata
import sys
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import fus3dmaps_core

OWN = {"fus3dmaps_core", "fus3dmaps_lab", "fus3dmaps_ros"}


def imported_modules(folder: Path) -> dict[str, Path]:
    """Top-level modules from outside the standard library and this package, each with a file that imports it."""
    found: dict[str, Path] = {}
    for path in folder.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
                names = [node.module]
            else:
                continue
            found.update({name.partition(".")[0]: path for name in names})
    return {name: path for name, path in found.items() if name not in OWN | sys.stdlib_module_names}


def declared_distributions(distribution) -> set[str]:
    extras = [line for extra in ("lite", "evaluation", "models") for line in distribution.extras_require[extra]]
    lines = distribution.install_requires + extras
    return {canonicalize_name(Requirement(line).name) for line in lines}


def exec_depends(manifest) -> set[str]:
    return {dependency.name for dependency in manifest.exec_depends}


def undeclared(modules: dict[str, Path], distributions: set[str]) -> dict[str, Path]:
    providers = importlib.metadata.packages_distributions()
    return {
        name: path
        for name, path in modules.items()
        if not {canonicalize_name(provider) for provider in providers.get(name, [])} & distributions
    }


def test_names_and_versions_agree(distribution, manifest, interface_manifest):
    assert manifest.name == distribution.get_name() == "fus3dmaps_ros"
    assert interface_manifest.name == "fus3dmaps_msgs"
    versions = {manifest.version, interface_manifest.version, distribution.get_version(), fus3dmaps_core.__version__}
    assert len(versions) == 1
    assert importlib.metadata.version("fus3dmaps_ros") in versions
    assert manifest.licenses == interface_manifest.licenses == [distribution.get_license()]


@pytest.mark.parametrize("which", ["manifest", "interface_manifest"])
def test_package_xml_is_valid_format_3(which, request):
    package = request.getfixturevalue(which)
    warnings: list[str] = []
    package.validate(warnings=warnings)
    assert warnings == []
    assert package.package_format == 3


def test_build_types(manifest, interface_manifest):
    assert manifest.get_build_type() == "ament_python"
    assert interface_manifest.get_build_type() == "ament_cmake"
    assert [group.name for group in interface_manifest.member_of_groups] == ["rosidl_interface_packages"]


@pytest.mark.parametrize("package", ["fus3dmaps_core", "fus3dmaps_lab"])
def test_core_and_laboratory_import_only_declared_packages_and_no_ros(root, distribution, manifest, package):
    modules = imported_modules(root / package)
    assert undeclared(modules, declared_distributions(distribution)) == {}
    assert modules.keys() & exec_depends(manifest) == set()


def test_ros_package_and_launch_files_import_only_declared_packages(root, distribution, manifest):
    modules = imported_modules(root / "fus3dmaps_ros") | imported_modules(root / "launch")
    from_pip = {name: path for name, path in modules.items() if name not in exec_depends(manifest)}
    assert undeclared(from_pip, declared_distributions(distribution)) == {}


def test_data_files_exist_and_keep_their_folders(root, distribution):
    installed = {f"{folder}/{Path(path).name}": path for folder, paths in distribution.data_files for path in paths}
    assert all((root / path).is_file() for path in installed.values())
    assert installed["share/ament_index/resource_index/packages/fus3dmaps_ros"] == "resource/fus3dmaps_ros"
    assert installed["share/fus3dmaps_ros/package.xml"] == "package.xml"
    expected = [*(root / "launch").rglob("*.py"), *(path for path in (root / "config").rglob("*") if path.is_file())]
    for path in expected:
        relative = path.relative_to(root).as_posix()
        assert installed[f"share/fus3dmaps_ros/{relative}"] == relative


def test_every_package_folder_and_data_file_is_packaged(root, distribution):
    packages = set(distribution.packages)
    for name in OWN:
        folders = {path.parent for path in (root / name).rglob("*.py")}
        assert {".".join(folder.relative_to(root).parts) for folder in folders} <= packages
        patterns = distribution.package_data[name]
        inside = (path for path in (root / name).rglob("*") if path.is_file() and "__pycache__" not in path.parts)
        data = [path for path in inside if path.suffix != ".py"]
        assert [path for path in data if not any(path.relative_to(root / name).match(pattern) for pattern in patterns)] == []


def test_commands_point_at_functions_that_exist(root, distribution):
    for line in distribution.entry_points["console_scripts"]:
        module, _, function = line.partition("=")[2].strip().partition(":")
        tree = ast.parse((root / Path(*module.split("."))).with_suffix(".py").read_text())
        assert function in {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}, line


def test_colcon_is_told_of_both_packages(root):
    defaults = yaml.safe_load((root / "colcon_defaults.yaml").read_text())
    for verb in ("build", "list", "test"):
        assert {(root / path / "package.xml").is_file() for path in defaults[verb]["base-paths"]} == {True}
        assert len(defaults[verb]["base-paths"]) == 2
