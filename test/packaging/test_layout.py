"""The house rules: who may import whom, how many rooms a floor has, and how long a file may be."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import pytest
from import_graph import ImportGraph

PACKAGES = ("fus3dmaps_core", "fus3dmaps_lab", "fus3dmaps_ros")
TABLE = "FLOORS in test/packaging/test_layout.py"

# From the ground up. A room is a folder or a module, and a module belongs to the longest of these names that its own begins
# with. It imports what is in its room and below, never what is above or beside it. A module at a package's root need not be
# named: it stands on the ground, where all rooms may use it, as long as it imports only what is there as well; otherwise it
# puts rooms together, and stands above all of them. The package's own name is its API, on top of both.
FLOORS = (
    ("fus3dmaps_core.errors",),
    ("fus3dmaps_core.frame", "fus3dmaps_core.masks"),
    ("fus3dmaps_core.config",),
    ("fus3dmaps_core.geometry", "fus3dmaps_core.voxel_map.rows"),
    ("fus3dmaps_core.messages", "fus3dmaps_core.encoders", "fus3dmaps_core.voxel_map.kernels"),
    ("fus3dmaps_core.recordings", "fus3dmaps_core.runtimes", "fus3dmaps_core.voxel_map.layers"),
    ("fus3dmaps_core.sources", "fus3dmaps_core.segmenters", "fus3dmaps_core.voxel_map"),
    ("fus3dmaps_core.answers", "fus3dmaps_core.health"),
    ("fus3dmaps_core.saved_maps",),
    ("fus3dmaps_core",),
    ("fus3dmaps_lab.datasets", "fus3dmaps_lab.simulation"),
    ("fus3dmaps_lab.evaluation",),
    ("fus3dmaps_lab",),
    ("fus3dmaps_ros.node",),
    ("fus3dmaps_ros.topics",),
    ("fus3dmaps_ros.services", "fus3dmaps_ros.reporting"),
    ("fus3dmaps_ros",),
    ("fus3dmaps_ros.commands",),
)
GROUND_FLOORS = 3
FLOOR_OF = {room: floor for floor, rooms in enumerate(FLOORS) for room in rooms}

MAX_ROOT_MODULES = 12
MAX_LINES = 450
MAX_LINES_OF_TESTS = 500


def is_within(name: str, room: str) -> bool:
    return name == room or name.startswith(f"{room}.")


class House:
    """Where the modules of a source tree stand."""

    def __init__(self, graph: ImportGraph) -> None:
        self._imports: dict[str, list[str]] = {}
        for found in graph.imports:
            self._imports.setdefault(found.importer, []).append(found.imported)

    @staticmethod
    def room(module: str) -> str:
        named = max((room for room in FLOOR_OF if is_within(module, room)), key=len)
        return module if named in PACKAGES else named

    def floor(self, module: str, visited: tuple[str, ...] = ()) -> float:
        room = self.room(module)
        if room in FLOOR_OF:
            return FLOOR_OF[room]
        package, visited = room.partition(".")[0], (*visited, module)
        own = {name for name in self._imports.get(module, []) if is_within(name, package)} - {package, *visited}
        first = min(floor for name, floor in FLOOR_OF.items() if is_within(name, package))
        below = max((self.floor(name, visited) for name in own), default=first - 1)
        joins_rooms = below >= max(first, GROUND_FLOORS)
        return (max(below, FLOOR_OF[package] - 1) if joins_rooms else below) + 0.01


def upward_imports(graph: ImportGraph) -> list[str]:
    """The imports that do not go down, and those of the laboratory by anything but commands, a line each."""
    house, problems = House(graph), []
    for found in graph.imports:
        importer, imported = house.room(found.importer), house.room(found.imported)
        what = f"{found.where}: {found.importer} must not import {found.imported}"
        if is_within(imported, "fus3dmaps_lab") and is_within(importer, "fus3dmaps_ros"):
            if importer != "fus3dmaps_ros.commands":
                problems.append(f"{what}: of fus3dmaps_ros only commands/ knows the laboratory")
        elif importer != imported and house.floor(found.importer) <= house.floor(found.imported):
            problems.append(f"{what}: {imported} is not below {importer}, see {TABLE}")
    return problems


def unknown_rooms(root: Path) -> list[str]:
    """Folders of modules that the table does not place, a line each."""
    folders = (path.parent for package in PACKAGES for path in sorted((root / package).glob("*/**/*.py")))
    rooms = {".".join(folder.relative_to(root).parts[:2]) for folder in folders}
    return [f"{room} is on no floor: add it to {TABLE}" for room in sorted(rooms - FLOOR_OF.keys())]


def python_files(root: Path) -> Iterator[Path]:
    for folder in (*PACKAGES, "launch", "scripts", "test"):
        yield from sorted((root / folder).rglob("*.py"))


def long_files(root: Path) -> list[str]:
    problems = []
    for path in python_files(root):
        name, lines = path.relative_to(root), len(path.read_text().splitlines())
        if lines > (MAX_LINES_OF_TESTS if name.parts[0] == "test" else MAX_LINES):
            problems.append(f"{name} has {lines} lines: give its second idea a file of its own")
    return problems


@pytest.fixture(scope="module")
def graph(root) -> ImportGraph:
    return ImportGraph(root, PACKAGES)


def test_imports_go_down_the_floors(graph) -> None:
    assert upward_imports(graph) == []


def test_no_imports_go_in_circles(graph) -> None:
    assert " -> ".join(graph.cycle()) == ""


def test_every_module_that_is_named_exists(graph, root) -> None:
    assert graph.missing() == []
    overrides = tomllib.loads((root / "pyproject.toml").read_text())["tool"]["mypy"]["overrides"]
    named = {name for override in overrides for name in override["module"] if name.partition(".")[0] in PACKAGES}
    assert {name for name in named if name.removesuffix(".*") not in graph.modules} == set()


def test_every_folder_has_a_floor_and_every_floor_its_folders(graph, root) -> None:
    assert unknown_rooms(root) == []
    assert [room for room in FLOOR_OF if room not in graph.modules] == []


def test_few_modules_lie_at_the_root_of_the_core(root) -> None:
    modules = {path.name for path in (root / "fus3dmaps_core").glob("*.py")} - {"__init__.py"}
    assert len(modules) <= MAX_ROOT_MODULES, f"give some of these a room: {', '.join(sorted(modules))}"


def test_files_are_short(root) -> None:
    assert long_files(root) == []


def test_no_folder_hides_the_builtin_map(root) -> None:
    assert [path for path in python_files(root) if "map" in path.relative_to(root).parts] == []


def test_tests_lie_in_the_rooms_of_what_they_test(root) -> None:
    for package in PACKAGES:
        tests = root / "test" / package.removeprefix("fus3dmaps_")
        folders = {path.parent.relative_to(tests) for path in tests.rglob("test_*.py")}
        assert [folder for folder in folders if not (root / package / folder).is_dir()] == []


# --- that the rules find what breaks them, in trees that are made up --------------------------------------------------


def tree(folder: Path, **sources: str) -> ImportGraph:
    """A source tree with every package and room, and these sources by module name with ``__`` for dots."""
    for room in FLOOR_OF:
        (folder / Path(*room.split("."))).mkdir(parents=True, exist_ok=True)
    for package in PACKAGES:
        for directory in (folder / package, *(path for path in (folder / package).rglob("*") if path.is_dir())):
            (directory / "__init__.py").touch()
    for name, source in sources.items():
        path = folder / Path(*name.split("__")).with_suffix(".py")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(source)
    return ImportGraph(folder, PACKAGES)


LAZY = "def f():\n    from fus3dmaps_core import pipeline\n"
TYPES = "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    import fus3dmaps_core.pipeline\n"
REGISTRY = 'from importlib import import_module\nNAMES = {{"a": "{}"}}\n'
LITERAL = 'import importlib\nimportlib.import_module("..pipeline", __package__)\n'


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("fus3dmaps_core__encoders__a", "import fus3dmaps_core.pipeline"),
        ("fus3dmaps_core__encoders__a", "from fus3dmaps_core.pipeline import Pipeline"),
        ("fus3dmaps_core__encoders__a", "from fus3dmaps_core import pipeline"),
        ("fus3dmaps_core__encoders__a", "from fus3dmaps_core import Pipeline"),
        ("fus3dmaps_core__encoders__a", "from .. import pipeline"),
        ("fus3dmaps_core__encoders__deeper__a", "from ...pipeline import Pipeline"),
        ("fus3dmaps_core__encoders__a", LAZY),
        ("fus3dmaps_core__encoders__a", TYPES),
        ("fus3dmaps_core__encoders__registry", REGISTRY.format("fus3dmaps_core.pipeline")),
        ("fus3dmaps_core__encoders__registry", REGISTRY.format("fus3dmaps_core.pipeline:Pipeline")),
        ("fus3dmaps_core__encoders__registry", REGISTRY.format("fus3dmaps_core.pipeline.Pipeline")),
        ("fus3dmaps_core__encoders__registry", LITERAL),
        ("fus3dmaps_core__encoders__a", "from fus3dmaps_core import messages"),
        ("fus3dmaps_core__voxel_map__rows__a", "from fus3dmaps_core.voxel_map import kernels"),
        ("fus3dmaps_core__voxel_map__layers__a", "import fus3dmaps_core.voxel_map"),
        ("fus3dmaps_core__pipeline", "import fus3dmaps_lab.datasets"),
        ("fus3dmaps_core__pipeline", "import fus3dmaps_ros"),
        ("fus3dmaps_core__pipeline", "from fus3dmaps_ros.a_constant import X"),
        ("fus3dmaps_core__answers__a", "import fus3dmaps_core.pipeline"),
        ("fus3dmaps_lab__evaluation__a", "import fus3dmaps_ros.commands"),
        ("fus3dmaps_ros__topics__a", "from fus3dmaps_ros import mapper_node"),
        ("fus3dmaps_ros__mapper_node", "import fus3dmaps_lab"),
    ],
)
def test_an_import_that_goes_up_is_found(tmp_path, module, source) -> None:
    above = {
        "fus3dmaps_core__pipeline": "import fus3dmaps_core.segmenters",
        "fus3dmaps_ros__mapper_node": "import fus3dmaps_ros.node, fus3dmaps_core.pipeline",
        "fus3dmaps_ros__a_constant": "X = 1",
    }
    (problem,) = upward_imports(tree(tmp_path, **{**above, module: source}))
    assert f"{module.replace('__', '.')} must not import fus3dmaps_" in problem
    assert problem.startswith(module.replace("__", "/") + ".py:")


def test_imports_that_go_down_are_no_violation(tmp_path) -> None:
    graph = tree(
        tmp_path,
        fus3dmaps_core__frame="from . import errors",
        fus3dmaps_core__voxel_map__a="from .layers import b; from .rows import c",
        fus3dmaps_core__a_count="import numpy, fus3dmaps_core.config",
        fus3dmaps_core__geometry__a="import fus3dmaps_core.a_count",
        fus3dmaps_core__a_new_step="import fus3dmaps_core.voxel_map.a, fus3dmaps_core.a_count",
        fus3dmaps_core__offline="import fus3dmaps_core.a_new_step",
        fus3dmaps_lab__evaluation__a="from fus3dmaps_core import offline; from fus3dmaps_lab import datasets",
        fus3dmaps_ros__commands__a="import fus3dmaps_lab.evaluation.a",
        fus3dmaps_core__messages__a='from importlib import import_module\nimport_module(f"{package}.msg")',
        # Text alone imports nothing, where nothing loads modules by name.
        fus3dmaps_core__errors='TEXT = "fus3dmaps_core.offline"',
    )
    assert upward_imports(graph) == []
    assert graph.cycle() == []
    assert graph.missing() == []


def test_a_circle_is_named_in_order(tmp_path) -> None:
    graph = tree(
        tmp_path,
        fus3dmaps_core__pipeline="import fus3dmaps_core.offline",
        fus3dmaps_core__offline=REGISTRY.format("fus3dmaps_core.api"),
        fus3dmaps_core__api="def f():\n    from fus3dmaps_core.pipeline import Pipeline",
    )
    circle = graph.cycle()
    assert circle[0] == circle[-1]
    assert {*pairwise(circle)} == {
        ("fus3dmaps_core.pipeline", "fus3dmaps_core.offline"),
        ("fus3dmaps_core.offline", "fus3dmaps_core.api"),
        ("fus3dmaps_core.api", "fus3dmaps_core.pipeline"),
    }


def test_names_of_modules_that_are_gone_are_found(tmp_path) -> None:
    graph = tree(tmp_path, fus3dmaps_core__encoders__registry=REGISTRY.format("fus3dmaps_core.encoders.gone.away"))
    assert graph.missing() == ["fus3dmaps_core/encoders/registry.py:2: there is no module fus3dmaps_core.encoders.gone.away"]


def test_a_folder_without_a_floor_and_a_long_file_are_found(tmp_path) -> None:
    tree(tmp_path, fus3dmaps_core__attic__box="\n" * 451)
    assert unknown_rooms(tmp_path) == [f"fus3dmaps_core.attic is on no floor: add it to {TABLE}"]
    assert long_files(tmp_path) == ["fus3dmaps_core/attic/box.py has 451 lines: give its second idea a file of its own"]
