"""Which module of a source tree imports which, read from the sources: nothing is imported."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from dataclasses import dataclass
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

# What loads modules by name: where one of these is named, text that names a module counts as an import of it.
_LOADERS = {"import_module", "__import__"}
_MODULE_PATH = re.compile(r"([A-Za-z_]\w*(?:\.[A-Za-z_]\w*)+)(?::\w+)?")


@dataclass(frozen=True)
class Import:
    """An import of one own module by another.

    Attributes:
        importer: Name of the module that imports.
        imported: Name of the module that is imported; it may not exist.
        where: File and line, as an editor opens them.
    """

    importer: str
    imported: str
    where: str


class ImportGraph:
    """All imports between the modules of some packages.

    An import counts wherever it stands: at the top, inside a function, and under ``TYPE_CHECKING`` too, because a reader who
    wants to know what a name means has to follow it all the same. ``from package import module`` is an import of the module.

    Attributes:
        modules: Path of every module by its name; a package is the module of its ``__init__.py``.
        imports: The imports, in the order of modules and lines.
    """

    def __init__(self, root: Path, packages: tuple[str, ...]) -> None:
        """Read every file of the packages that lie in a folder."""
        self._packages = packages
        self._root = root
        paths = [path for name in packages for path in sorted((root / name).rglob("*.py"))]
        self.modules = {_name(path.relative_to(root)): path for path in paths}
        self.imports = [found for name, path in self.modules.items() for found in self._read(name, path)]

    def missing(self) -> list[str]:
        """The imports of modules that do not exist, a line each."""
        return [f"{i.where}: there is no module {i.imported}" for i in self.imports if i.imported not in self.modules]

    def cycle(self) -> list[str]:
        """Names along one circle of imports, the first one again at the end; empty if there is none."""
        neighbours: dict[str, set[str]] = {name: set() for name in self.modules}
        for found in self.imports:
            neighbours[found.importer].add(found.imported)
        try:
            TopologicalSorter(neighbours).prepare()
        except CycleError as error:
            return list(reversed(error.args[1]))
        return []

    def _read(self, importer: str, path: Path) -> Iterator[Import]:
        tree = ast.parse(path.read_text(), str(path))
        package = importer if path.name == "__init__.py" else importer.rpartition(".")[0]
        loads_by_name = any(_names(node) & _LOADERS for node in ast.walk(tree))
        pieces = {piece for node in ast.walk(tree) if isinstance(node, ast.JoinedStr) for piece in node.values}
        for node in ast.walk(tree):
            if isinstance(node, ast.Import):
                targets = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                targets = self._from(node, package)
            elif isinstance(node, ast.Constant) and isinstance(node.value, str) and loads_by_name and node not in pieces:
                targets = self._text(node.value, package)
            else:
                continue
            where = f"{path.relative_to(self._root)}:{getattr(node, 'lineno', 1)}"
            yield from (Import(importer, target, where) for target in targets if target.partition(".")[0] in self._packages)

    def _from(self, node: ast.ImportFrom, package: str) -> list[str]:
        base = _absolute(node.level, node.module or "", package)
        names = [f"{base}.{alias.name}" for alias in node.names]
        return [name if name in self.modules else base for name in names]

    def _text(self, text: str, package: str) -> list[str]:
        """The module that a text names: ``package.module``, with or without an attribute, or ``.module``."""
        if text.startswith("."):  # More often the end of a file's name than a module.
            name = _absolute(len(text) - len(text.lstrip(".")), text.lstrip("."), package)
            return [name] if name in self.modules else []
        match = _MODULE_PATH.fullmatch(text)
        if match is None:
            return []
        name, parent = match[1], match[1].rpartition(".")[0]
        return [parent if name not in self.modules and parent in self.modules else name]


def _absolute(level: int, name: str, package: str) -> str:
    """A module's full name, from the dots before it, the rest, and the package of who imports it."""
    parts = package.split(".")
    return ".".join([*(parts[: len(parts) - level + 1] if level else ()), *([name] if name else ())])


def _names(node: ast.AST) -> set[str]:
    """What a node of a syntax tree calls by name."""
    if isinstance(node, ast.ImportFrom):
        return {alias.name for alias in node.names}
    if isinstance(node, ast.Attribute):
        return {node.attr}
    return {node.id} if isinstance(node, ast.Name) else set()


def _name(path: Path) -> str:
    parts = path.with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
