"""Files that are read cannot run code: nothing unpickles, and what could is told not to.

ruff's S301 and S302 find ``pickle.load`` and ``marshal.load``; that numpy and torch unpickle unless told otherwise is looked
for here. A line that has to unpickle what this package itself has written says so, and why, after ``noqa: S301``.
"""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

FOLDERS = ("fus3dmaps_core", "fus3dmaps_lab", "fus3dmaps_ros", "launch", "scripts")
UNPICKLERS = {"dill", "joblib", "cloudpickle", "shelve", "marshal"}
HARMLESS_OF_PICKLE = {"UnpicklingError", "PickleError", "PROTO"}
# What has to be given to each call whose name ends like this.
REQUIRED = {
    "torch.load": ("weights_only", True),
    "np.load": ("allow_pickle", False),
    "np.save": ("allow_pickle", False),
    "format.read_array": ("allow_pickle", False),
}


def unsafe_reads(path: Path) -> list[str]:
    """Lines of a file that may unpickle, with the reason."""
    found, text = [], path.read_text()
    excused = {number for number, line in enumerate(text.splitlines(), start=1) if "noqa: S301" in line}
    for node in ast.walk(ast.parse(text)):
        line = getattr(node, "lineno", 0)
        where = f"{path.name}:{line}"
        if line in excused:
            continue
        if isinstance(node, ast.Call):
            name = ast.unparse(node.func)
            given = {keyword.arg: ast.unparse(keyword.value) for keyword in node.keywords}
            for end, (option, value) in REQUIRED.items():
                if f".{name}".endswith(f".{end}") and given.get(option) != str(value):
                    found.append(f"{where}: {name} without {option}={value}")
        elif isinstance(node, ast.Attribute) and ast.unparse(node.value) == "pickle" and node.attr not in HARMLESS_OF_PICKLE:
            found.append(f"{where}: pickle.{node.attr}")
        elif isinstance(node, ast.Import):
            found += [f"{where}: import {alias.name}" for alias in node.names if alias.name.partition(".")[0] in UNPICKLERS]
        elif isinstance(node, ast.ImportFrom) and (node.module or "").partition(".")[0] in UNPICKLERS | {"pickle"}:
            found.append(f"{where}: from {node.module} import")
    return found


def test_no_file_that_is_read_can_run_code(root) -> None:
    paths = [path for folder in FOLDERS for path in sorted((root / folder).rglob("*.py"))]
    assert len(paths) > 200
    assert [problem for path in paths for problem in unsafe_reads(path)] == []


@pytest.mark.parametrize(
    "source",
    [
        "torch.load(path)",
        "torch.load(path, weights_only=False)",
        "np.load(path)",
        "np.load(path, allow_pickle=True)",
        "np.lib.format.read_array(file)",
        "pickle.loads(data)",
        "from pickle import loads",
        "import joblib",
        "from joblib import load",
    ],
)
def test_what_may_unpickle_is_found(tmp_path, source) -> None:
    path = tmp_path / "reader.py"
    path.write_text(source)
    assert len(unsafe_reads(path)) == 1


def test_what_cannot_unpickle_is_not_found(tmp_path) -> None:
    path = tmp_path / "reader.py"
    path.write_text(
        "import pickle\nnp.load(path, allow_pickle=False)\ntorch.load(path, weights_only=True)\npickle.UnpicklingError\n"
        "pickle.loads(own)  # noqa: S301  (written by this very package)\n"
    )
    assert unsafe_reads(path) == []
