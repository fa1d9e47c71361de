"""One exception per kind of refusal.

Every message names what was wrong: the topic, file, field or parameter. Whoever raises one of these has changed nothing.
"""


class Fus3dmapsError(Exception):
    """Base of every refusal of this package."""


class ConfigError(Fus3dmapsError):
    """A parameter is unknown, of the wrong type or out of range."""


class FrameError(Fus3dmapsError):
    """A frame, image, camera model or pose cannot be used.

    Attributes:
        reason: Short machine-readable cause (snake_case), under which drops are counted.
    """

    def __init__(self, message: str, *, reason: str = "bad_frame") -> None:
        """Store the message for people and the reason for counters."""
        super().__init__(message)
        self.reason = reason


class MapError(Fus3dmapsError):
    """Arrays handed to the map have the wrong shape, dtype or range; the map is as it was before the call."""


class QueryError(Fus3dmapsError):
    """A query cannot be answered: empty prompt, unknown layer, empty map."""


class EncoderError(Fus3dmapsError):
    """An encoder or segmenter is unknown, not installed, or its weights are missing or altered."""


class RecordingError(Fus3dmapsError):
    """A recording or dataset is missing, unreadable, truncated or lacks a topic."""


class StorageError(Fus3dmapsError):
    """A saved map cannot be written or read, or does not fit the configuration."""


def first_line(error: BaseException) -> str:
    """Return the first line of what an exception says, for a message of one line, and its class where it says nothing."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[0] if lines else type(error).__name__
