"""Running numbers of recordings and experiments, which give their order.

Neither a modification time nor a date decides: both follow the unix clock, which may be wrong.
"""

from pathlib import Path

from fishd.core.errors import RecordingError
from fishd.recording.mcap_file import read_first_metadata
from fishd.recording.part_file import PART_SUFFIX, SUFFIX

MAX_DIGITS = 18
"""Maximum number of digits of a running number."""


def list_files(folder: Path, prefix: str = "") -> list[Path]:
    """Return the recordings of a folder, finished or not; raise `RecordingError`.

    prefix: beginning of their names
    """
    try:
        ending = (
            path
            for path in folder.iterdir()
            if path.name.startswith(prefix) and path.name.endswith((SUFFIX, SUFFIX + PART_SUFFIX))
        )
        return [path for path in ending if path.is_file()]  # reading a pipe would never end
    except FileNotFoundError:
        return []
    except OSError as error:
        raise RecordingError(f"{folder} cannot be read: {error.strerror}") from None


def next_recording_number(folder: Path) -> int:
    """Return a number above those of all recordings in a folder, for one that begins now."""
    try:
        return max(map(read_number, list_files(folder)), default=0) + 1
    except RecordingError:
        return 1


def read_number(path: Path) -> int:
    """Return the number of a recording; 0 for an older one, or if its beginning is damaged."""
    try:
        digits = read_first_metadata(path).get("number", "")
    except RecordingError:
        return 0
    is_number = digits.isdigit() and digits.isascii() and len(digits) <= MAX_DIGITS
    return int(digits) if is_number else 0
