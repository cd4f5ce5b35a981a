"""Tree of the system files of a Raspberry Pi, and a check of `fishctl doctor` on it."""

import contextlib
import os
from collections.abc import Callable, Iterator
from pathlib import Path

from fishd.cli.doctor import checks
from fishd.cli.doctor.base import Context
from fishd.config import load

Examine = Callable[..., tuple[str, str, str]]
"""Function that runs a check with overrides; it returns level, message, remedy, or empty texts."""


def examiner(root: Path) -> Examine:
    """Return the function that runs one check on the tree, for robot pi."""

    def make(name: str, *overrides: str) -> tuple[str, str, str]:
        settings = ["robot=pi", f"state_folder={root}/state", *overrides]
        context = Context(load(None, settings), None, f"ipc://{root}/nobody", root)
        found = (check.function(context) for check in checks(context) if check.name == name)
        result = next(found, None)
        if result is None:
            return "", "", ""
        assert bool(result.remedy) == (result.level in ("warning", "FAIL"))
        return tuple(result)

    return make


def put(root: Path, path: str, content: str | bytes = "") -> Path:
    file = root / path
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(content.encode() if isinstance(content, str) else content)
    return file


@contextlib.contextmanager
def unprivileged() -> Iterator[None]:
    """Run as a user without privileges: for root, as user 65534 without groups."""
    if os.geteuid() != 0:
        yield
        return
    groups = os.getgroups()
    os.setgroups([])
    os.setresgid(65534, 65534, 0)
    os.setresuid(65534, 65534, 0)
    try:
        yield
    finally:
        os.setresuid(0, 0, 0)
        os.setresgid(0, 0, 0)
        os.setgroups(groups)
