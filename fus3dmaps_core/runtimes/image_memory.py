"""Images too large for memory: the error names the parameters of their size, whichever library ran out of memory."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch

from fus3dmaps_core.encoders.batching import free_cached_memory
from fus3dmaps_core.errors import EncoderError

# What libraries say that have no exception of their own for it: torch on the host, OpenCV and ONNX Runtime; the last three,
# of torch and numpy, are of sizes beyond any memory.
_SAID = (
    "can't allocate memory",
    "failed to allocate ",
    "bad_alloc",
    "storage size calculation overflowed",
    "maximum allowed dimension exceeded",
    "array is too big",
)


@contextmanager
def naming_image_size(trio: str, height: int, width: int) -> Iterator[None]:
    """Turn lack of memory inside, on the host or a device, into a refusal that names the size of the images.

    Args:
        trio: Name of the encoders, for the message.
        height: Height of the images that they are made ready for, pixels.
        width: Their width, pixels.

    Raises:
        EncoderError: Memory ran out; cached memory of a GPU was given back.
    """
    cause: str | None = None
    try:
        yield
    except Exception as error:  # Also refusals of others that go back to it, such as the compiler's.
        cause = _lack_of_memory(error)
        if cause is None:
            raise
    if cause is not None:  # After the except clause: its exception holds the frames, and those what they had allocated.
        free_cached_memory()
        raise EncoderError(
            f"parameters 'image.width', 'image.height': encoder '{trio}' cannot be made ready for images of {width} x "
            f"{height} pixels, they do not fit into memory ({cause}); make them smaller"
        )


def _lack_of_memory(error: BaseException | None) -> str | None:
    """Find the words with which an error, or one that led to it, says that memory ran out; None without one."""
    found = None
    while error is not None:
        text = str(error).strip()
        starts = [start for start in map(text.lower().find, _SAID) if start >= 0]
        if starts or isinstance(error, (MemoryError, torch.OutOfMemoryError)):
            said = text[min(starts, default=0) :] or type(error).__name__  # Before it is where in the library it was.
            found = said.splitlines()[0].rstrip(".;: ")
        error = error.__cause__ or error.__context__
    return found
