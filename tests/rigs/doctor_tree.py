"""A tree of a Raspberry Pi's own files, and a check of `fishctl doctor` on it."""

import contextlib
import os
from collections.abc import Callable, Iterator
from pathlib import Path

from fishd.cli.doctor import checks
from fishd.cli.doctor.base import Context
from fishd.config import load

Examine = Callable[..., tuple[str, str, str]]
"""Makes a check with these overrides: level, message and mend; empty where there is none."""


def examiner(root: Path) -> Examine:
    """What makes one check on the tree, for robot pi."""

    def make(name: str, *overrides: str) -> tuple[str, str, str]:
        settings = ["robot=pi", f"state_folder={root}/state", *overrides]
        context = Context(load(None, settings), None, f"ipc://{root}/nobody", root)
        result = next(
            (check.function(context) for check in checks(context) if check.name == name), None
        )
        if result is None:
            return "", "", ""
        assert bool(result.mend) == (result.level in ("warning", "FAIL"))
        return tuple(result)

    return make


def put(root: Path, path: str, content: str | bytes = "") -> Path:
    file = root / path
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(content.encode() if isinstance(content, str) else content)
    return file


@contextlib.contextmanager
def unprivileged() -> Iterator[None]:
    """As somebody whom permissions bind: for root user 65534, without groups."""
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
