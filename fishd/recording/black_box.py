"""The black box: a rotation of recordings, in which new ones replace the oldest."""

import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from fishd.core.errors import RecordingError
from fishd.recording.folder import list_recordings, open_new
from fishd.recording.part_file import PART_SUFFIX, is_being_written
from fishd.recording.recorder import MIN_FREE_BYTES
from fishd.recording.recover import RECOVERING_SUFFIX, recover
from fishd.recording.writer import RunWriter

FILE_PREFIX = "blackbox-"
"""Prefix of the names of its files; no other files are ever removed."""
MAX_FILE_AGE_S = 3600.0
"""Maximum duration of a file [s]."""
MAX_FILE_FRACTION = 1 / 8
"""Maximum size of a file, as a fraction of the total, so that little is lost with the oldest."""


class BlackBox:
    """Rotation of recordings in a folder, whose total size is limited."""

    def __init__(self, folder: Path, keep: int, open_writer: Callable[[Path], RunWriter]) -> None:
        """
        keep: maximum total size of its files, the current one included [bytes]
        open_writer: begins a recording with this path
        """
        self._folder, self._keep, self._open_writer = folder, keep, open_writer
        self._opened = 0.0

    def open(self) -> RunWriter:
        """Begin a file; recover first those that were interrupted, for example by a power cut."""
        for copy in self._folder.glob(f"{FILE_PREFIX}*{RECOVERING_SUFFIX}"):
            if not is_being_written(copy):  # left by a kill
                with suppress(OSError):
                    copy.unlink()
        self._make_room(0)
        for path in self._list_own_files():
            if path.name.endswith(PART_SUFFIX) and not is_being_written(path):
                # A file that cannot be recovered is removed as the oldest.
                with suppress(RecordingError):
                    recover(path)
        self._opened = time.monotonic()
        return open_new(self._folder, self._open_writer, FILE_PREFIX)

    def due(self, writer: RunWriter) -> bool:
        """Return whether to begin the next file."""
        self._make_room(2 * MIN_FREE_BYTES - writer.free())
        is_too_long = time.monotonic() - self._opened >= MAX_FILE_AGE_S
        return is_too_long or writer.size >= self._keep * MAX_FILE_FRACTION

    def _make_room(self, missing: int) -> None:
        """Remove the oldest files if the total is too large, or the disk is almost full.

        missing: space that the disk lacks [bytes]
        """
        sizes = {}
        for path in self._list_own_files():
            with suppress(OSError):
                sizes[path] = path.stat().st_size
        excess = max(missing, sum(sizes.values()) - round(self._keep * (1 - MAX_FILE_FRACTION)))
        for path, size in sizes.items():
            if excess <= 0:
                return
            if not is_being_written(path):
                with suppress(OSError):
                    path.unlink()
                    excess -= size

    def _list_own_files(self) -> list[Path]:
        return list_recordings(self._folder, FILE_PREFIX)
