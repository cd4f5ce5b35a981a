"""Notes of runs, which can be changed later: a text file beside a recording, or in a folder."""

from pathlib import Path

from fishd.core import files, text
from fishd.recording.part_file import PART_SUFFIX, SUFFIX

NOTE = "note.txt"
"""Name of the note in the folder of an experiment; of a recording, it follows its name."""
MAX_NOTE_CHARACTERS = 1000


def note_path(path: Path) -> Path:
    """Return the file of the note of a recording or of the folder of an experiment."""
    if path.name.endswith((SUFFIX, PART_SUFFIX)):
        name = path.name.removesuffix(PART_SUFFIX).removesuffix(SUFFIX)
        return path.with_name(f"{name}.{NOTE}")
    return path / NOTE


def read_note(path: Path) -> dict[str, str]:
    """Return the changed note of a run as its metadata have it; empty if it was not changed."""
    try:
        content = files.read_text(note_path(path), 4 * MAX_NOTE_CHARACTERS + 2, "a note")
    except files.FileProblem:
        return {}
    return {"note": text.line(content.strip(), MAX_NOTE_CHARACTERS)}
