"""Periodic saving of a map that changes, so that a crash of the machine costs one period at most."""

from __future__ import annotations

import threading
import traceback
from collections.abc import Callable
from typing import Any

from fus3dmaps_core.config.schema import Config
from fus3dmaps_core.errors import StorageError
from fus3dmaps_core.saved_maps.directory import list_maps
from fus3dmaps_ros.node.map_store import save_session
from fus3dmaps_ros.node.session import Session
from fus3dmaps_ros.node.timed_calls import Deadline

NAMES = ("autosave_a", "autosave_b")
"""Names of the maps, which are written in turns: if the newest is damaged, the one before it is left."""

_POLL_S = 0.05


class Autosave:
    """One thread that saves a session's map while the session lasts.

    A save that fails is logged and counted. The map in memory and the last one on disk stay as they are, and the next
    attempt follows after another period.
    """

    def __init__(self, session: Session, read: Callable[[], Config], logger: Any) -> None:
        """Prepare the thread; :meth:`start` runs it.

        Args:
            session: Has the map.
            read: Returns the current configuration: ``node.autosave_period_s`` (0: no saves) and ``node.map_directory``.
            logger: The node's logger.
        """
        self._session = session
        self._read = read
        self._logger = logger
        self._wake = threading.Condition()
        self._stopping = self._saving_last = False
        self._saved_revision = session.worker.revision
        self._succeeded = self._failed = 0
        # Daemon: a disk that hangs must not keep the process from ending. A save that is cut off leaves the last good map.
        self._thread = threading.Thread(target=self._run, name="autosave", daemon=True)

    @property
    def counts(self) -> tuple[int, int]:
        """Saves that succeeded and that failed."""
        return self._succeeded, self._failed

    @property
    def is_due(self) -> bool:
        """Whether the map is saved periodically and has changed since the last successful save."""
        return self._read().node.autosave_period_s > 0 and self._has_changed(self._session.worker.revision)

    def start(self) -> None:
        """Run the thread."""
        self._thread.start()

    def follow(self) -> None:
        """Start the wait anew after the period was changed."""
        with self._wake:
            self._wake.notify()

    def stop(self, timeout_s: float, save: bool = False) -> bool:
        """End the thread as soon as no save is in progress. Can be called again to wait longer; the last ``save`` counts.

        Args:
            timeout_s: How long to wait, seconds.
            save: Whether the thread saves a last time before it ends, if a save is due.

        Returns:
            Whether the thread has ended in time.
        """
        with self._wake:
            self._stopping, self._saving_last = True, save
            self._wake.notify()
        if self._thread.ident is not None:
            self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def save_last(self, timeout_s: float, hurried: Callable[[], bool]) -> bool:
        """Save a last time, if a save is due, and end the thread.

        Args:
            timeout_s: How long to wait, seconds.
            hurried: Called repeatedly; returns whether to stop waiting.

        Returns:
            Whether the thread has ended. Otherwise a save is still in progress; if the process ends now, the map that was
            saved before is left.
        """
        if self.is_due:
            self._logger.info("saving the map; another signal ends at once")
        deadline = Deadline(timeout_s)
        while not self.stop(min(_POLL_S, deadline.remaining_s()), save=True):
            if hurried() or not deadline.remaining_s():
                return False
        return True

    def save_if_changed(self) -> None:
        """Save now, unless the map is empty or has not changed since the last successful save."""
        revision = self._session.worker.revision
        if not self._has_changed(revision):
            return
        try:
            root = self._read().node.map_directory
            path, size_bytes = save_session(self._session, root, _next_name(root))
        except Exception as error:
            self._failed += 1
            details = "" if isinstance(error, StorageError) else f"\n{traceback.format_exc()}"
            self._logger.error(f"automatic save failed: {error}{details}")
            return
        self._saved_revision = revision
        self._succeeded += 1
        self._logger.debug(f"saved '{path}', {size_bytes} bytes")

    def _has_changed(self, revision: int) -> bool:
        return revision != self._saved_revision and self._session.pipeline.semantic_map.voxel_count > 0

    def _run(self) -> None:
        while True:
            with self._wake:
                # A notification means a stop or another period; in both cases the loop starts anew.
                if self._stopping:
                    break
                if self._wake.wait(self._read().node.autosave_period_s or None):
                    continue
            self.save_if_changed()
        if self._saving_last and self.is_due:
            self.save_if_changed()


def _next_name(root: str) -> str:
    """Return the name whose map is missing, or else the older one."""
    newest_first = [name for name in list_maps(root) if name in NAMES]
    return next((name for name in NAMES if name not in newest_first), newest_first[-1] if newest_first else NAMES[0])
