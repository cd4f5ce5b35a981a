"""A tree of a Raspberry Pi's own files, and a check of `fishctl doctor` on it."""

from collections.abc import Callable
from pathlib import Path

from fishd.cli.checks import CHECKS
from fishd.cli.checks.base import Context, Result
from fishd.config import load

Examine = Callable[..., Result | None]


def examiner(root: Path) -> Examine:
    """What makes one check on the tree, for robot pi."""

    def make(name: str, *overrides: str) -> Result | None:
        settings = ["robot=pi", f"state_folder={root}/state", *overrides]
        context = Context(load(None, settings), None, f"ipc://{root}/nobody", root)
        return next(check for check in CHECKS if check.name == name).function(context)

    return make


def put(root: Path, path: str, content: str | bytes = "") -> Path:
    file = root / path
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(content.encode() if isinstance(content, str) else content)
    return file


def level(result: Result | None) -> str:
    assert result is not None
    assert bool(result.mend) == (result.level in ("warning", "FAIL"))
    return result.level
