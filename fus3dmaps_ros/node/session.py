"""The session: models, a map and the mapping thread, which the node has from configuration to clean-up."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from fus3dmaps_core.encoders.protocols import TextEncoder
from fus3dmaps_core.errors import MapError
from fus3dmaps_core.pipeline import Pipeline
from fus3dmaps_ros.node.worker import FrameWorker


class SerialTextEncoder:
    """A text encoder for several threads: it lets one at a time into an encoder that need not be thread-safe.

    Attributes:
        space: Name of its trio.
    """

    def __init__(self, encoder: TextEncoder) -> None:
        """Wrap an encoder."""
        self._encoder, self.space = encoder, encoder.space
        self._lock = threading.Lock()

    def encode_text(self, prompts: Sequence[str]) -> NDArray[np.float32]:
        """Encode prompts as the wrapped encoder does, after waiting for other threads."""
        with self._lock:
            return self._encoder.encode_text(prompts)


@dataclass(frozen=True)
class Session:
    """Models, map and mapping thread.

    Attributes:
        pipeline: The map and the models that describe images.
        worker: The mapping thread, which feeds the pipeline.
        text: The pipeline's text encoder, safe to use in any thread.
    """

    pipeline: Pipeline
    worker: FrameWorker
    text: SerialTextEncoder = field(init=False)

    def __post_init__(self) -> None:
        """Wrap the text encoder."""
        object.__setattr__(self, "text", SerialTextEncoder(self.pipeline.trio.text))


class SessionHolder:
    """Holder of the current session, which the parts of the node share."""

    def __init__(self) -> None:
        """Start without a session."""
        self._session: Session | None = None

    @property
    def current(self) -> Session | None:
        """The session; None while the node is unconfigured."""
        return self._session

    def replace(self, session: Session | None) -> None:
        """Hold another session, or none."""
        self._session = session

    def require(self) -> Session:
        """Return the session.

        Raises:
            MapError: The node is unconfigured.
        """
        if self._session is None:
            raise MapError("the node is unconfigured and has no map; configure it first")
        return self._session
