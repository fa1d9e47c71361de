"""RADIO's own code, which describes its networks: a checkout of the user's, or the pinned revision through ``torch.hub``.

Its licence does not allow this package to contain the code.
"""

from __future__ import annotations

import sys
import threading
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import torch

from fus3dmaps_core.encoders.optional_packages import import_optional
from fus3dmaps_core.encoders.radio.published import REPOSITORY, REVISION
from fus3dmaps_core.encoders.weights import check_reachable, local_path
from fus3dmaps_core.errors import EncoderError, first_line

ARCHIVE = f"https://github.com/{REPOSITORY}/archive/{REVISION}.zip"
"""The pinned revision, to be unpacked."""

_FOLDER = "RADIO"  # Of a checkout in the directory that encoder.weights names.
_import_lock = threading.Lock()


def cached_checkout() -> Path:
    """Return where the pinned revision lies, or may be put, in the cache of ``torch.hub``."""
    return Path(torch.hub.get_dir()) / f"{REPOSITORY.replace('/', '_')}_{REVISION}"


def locate_checkout(weights: str) -> Path | None:
    """Find RADIO's code as :func:`find_checkout`, without a download; None where it is not on this machine."""
    directory = local_path(weights)
    candidates = (*((directory / _FOLDER,) if directory else ()), cached_checkout())
    return next((path for path in candidates if (path / "hubconf.py").is_file()), None)


def find_checkout(weights: str, encoder: str) -> Path:
    """Find the directory of RADIO's code, and fetch it if necessary.

    Args:
        weights: ``encoder.weights``. Where it is a directory with a folder ``RADIO``, that is the checkout; otherwise the
            pinned revision is taken from the cache of ``torch.hub``, or fetched into it.
        encoder: Name of the trio, for messages.

    Raises:
        EncoderError: A package is missing, or there is no checkout and none can be fetched; the message says what to
            download from where, and where to put it.
    """
    for package in ("timm", "einops"):
        import_optional(package, encoder)
    found = locate_checkout(weights)
    if found is not None:
        return found
    cached = cached_checkout()
    try:
        check_reachable(ARCHIVE)
        # Fetches the code and imports it; the name of a commit says what is in it, so there is nothing more to trust.
        hub: Any = torch.hub  # Without type hints.
        hub.list(f"{REPOSITORY}:{REVISION}", skip_validation=True, trust_repo=True, verbose=False)
    except Exception as error:  # Whatever the network, the archive or the code that it holds come across.
        first = first_line(error)
        raise EncoderError(
            f"encoder '{encoder}': RADIO's code is not on this machine and cannot be downloaded ({first}); unpack "
            f"{ARCHIVE} so that its hubconf.py lies in '{cached}', or in the folder '{_FOLDER}' of a directory that "
            "'encoder.weights' names"
        ) from None
    return cached


def import_from(checkout: Path, name: str, encoder: str) -> ModuleType:
    """Import a module of RADIO's code.

    Args:
        checkout: Directory as of :func:`find_checkout`.
        name: Dotted name of the module below the checkout.
        encoder: Name of the trio, for messages.

    Raises:
        EncoderError: It cannot be imported, or another checkout or package of the same name was imported before.
    """
    with _import_lock:
        sys.path.insert(0, str(checkout))
        try:
            module = import_module(name)
        except Exception as error:  # Other versions of its packages fail in their own ways.
            raise EncoderError(f"encoder '{encoder}': cannot import '{name}' of '{checkout}': {error}") from None
        finally:
            sys.path.remove(str(checkout))
    if not Path(module.__file__ or "").resolve().is_relative_to(checkout.resolve()):
        raise EncoderError(
            f"encoder '{encoder}': module '{name}' of '{module.__file__}' is in use, that of '{checkout}' cannot be; "
            "start anew"
        )
    return module
