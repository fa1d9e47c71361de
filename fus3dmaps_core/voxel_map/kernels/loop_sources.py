"""The source files that the compiled loops are made of.

A loop contains what it calls and every constant that it names, also those of other files. So its machine code is out of date
as soon as any of these files changes. The files are found by following the imports of the loops' modules.
"""

from __future__ import annotations

import ast
import hashlib
from collections.abc import Iterator
from functools import cache
from pathlib import Path

_KERNELS = Path(__file__).resolve().parent
_PACKAGE = _KERNELS.parents[1]


@cache
def source_digest() -> str:
    """Return a digest of all files that the loops are made of: it changes with the content of any of them.

    Raises:
        OSError: A file cannot be read.
    """
    digest = hashlib.sha256()
    for path in source_files():
        content = path.read_bytes()
        digest.update(f"{path.relative_to(_PACKAGE)} {len(content)}\n".encode() + content)
    return digest.hexdigest()


def source_files() -> list[Path]:
    """List the modules with loops and all modules of this package that they import, directly or not."""
    waiting = list(_KERNELS.glob("numba_*.py"))
    if not waiting:
        raise FileNotFoundError(f"no sources of compiled loops in '{_KERNELS}'")
    found = set(waiting)
    while waiting:
        for path in _imports(waiting.pop()):
            if path not in found:
                found.add(path)
                waiting.append(path)
    return sorted(found)


def _imports(path: Path) -> Iterator[Path]:
    here = (_PACKAGE.name, *path.relative_to(_PACKAGE).parent.parts)
    for node in ast.walk(ast.parse(path.read_bytes())):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield from _file_of(tuple(alias.name.split(".")))
        elif isinstance(node, ast.ImportFrom):
            base = here[: len(here) + 1 - node.level] if node.level else ()
            module = base + tuple(node.module.split(".") if node.module else ())
            for alias in node.names:
                # The name is a module of its own, or something in the module that it is imported from.
                submodule = list(_file_of((*module, alias.name)))
                yield from submodule or _file_of(module)


def _file_of(module: tuple[str, ...]) -> Iterator[Path]:
    if module[0] != _PACKAGE.name:
        return
    path = _PACKAGE.joinpath(*module[1:])
    for candidate in (path.with_suffix(".py"), path / "__init__.py"):
        if candidate.is_file():
            yield candidate
            return


if __name__ == "__main__":
    print(source_digest())  # noqa: T201  (set-up reads it)
