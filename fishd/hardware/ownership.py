"""Exclusive use of the robot's parts by one fishd.

Two programs on one bus would take each other's samples, without an error.
"""

import logging
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import NamedTuple

from fishd.core.errors import StartupError
from fishd.core.process.lockfile import LockHeld, find_lock_holder, lock_path, locked
from fishd.core.process.runtime_folder import runtime_folder
from fishd.core.process.unix_sockets import find_trust_problem
from fishd.hardware.driver import Claim

log = logging.getLogger(__name__)

FOLDER = Path("/run/fishd-locks")
"""Folder of the lock files, by the Debian package: only root and the group fishd may enter.

In another folder any user could hold a lock, or create its file, and so keep fishd from starting.
"""
MAX_ATTEMPTS, RETRY_PAUSE_S = 50, 0.02
"""Attempts to claim a part, which another process may hold briefly; pause between them [s]."""


class Part(NamedTuple):
    """Part of the robot that at most one fishd may drive."""

    path: Path
    """Path that is claimed; its lock file is beside it."""
    what: str
    """Name in messages."""
    key: str
    """Configuration key with which the user chooses another one."""


def lock_folder() -> Path:
    """Return the folder shared by all users of the hardware if it exists, else one of this user."""
    return FOLDER if FOLDER.is_dir() else Path(runtime_folder())


def parts_of_pi(claims: Mapping[str, Iterable[Claim]]) -> tuple[Part, ...]:
    """Return the parts that robot pi drives: what its drivers claim, by section."""
    folder = lock_folder()
    parts: dict[Path, Part] = {}
    for section, section_claims in claims.items():
        for claim in section_claims:
            path = folder / f"fishd-{claim.name.replace('/', '_')}"
            parts.setdefault(path, Part(path, claim.what, f"{section}.{claim.key}"))
    return tuple(parts.values())


def parts_of_virtual_pi(socket: Path) -> tuple[Part, ...]:
    """Return the part that robot virtual-pi drives: the virtual Pi that listens on `socket`."""
    real = socket.resolve()  # a socket may have several names
    path = real.with_name(f"{real.name}.fishd")
    return (Part(path, f"the virtual Pi on {socket}", "virtual_pi.socket"),)


@contextmanager
def claim_parts(parts: Iterable[Part]) -> Iterator[None]:
    """Claim these parts within the context.

    Raises `StartupError`, which names the other process, if one already drives a part. A lock file
    that cannot be created is only logged.
    """
    with ExitStack() as stack:
        for part in parts:
            try:
                if part.path.parent == Path(runtime_folder()):
                    _make_private(part.path.parent)
                _claim(part, stack)
            except OSError as error:
                if isinstance(error, PermissionError) and part.path.parent == FOLDER:
                    raise StartupError(
                        f"{lock_path(part.path)}: {error.strerror}, so whether another fishd "
                        f"drives {part.what} is not known; join the group of {FOLDER} "
                        "('sudo usermod -aG fishd USER'), log in again, then try again"
                    ) from None
                log.warning(
                    "%s: cannot be used: %s; nothing keeps a second fishd from driving %s",
                    lock_path(part.path),
                    error.strerror,
                    part.what,
                )
        yield


def describe_owner(parts: Iterable[Part]) -> str:
    """Return a line that names the fishd that drives one of these parts; empty if none is known."""
    for part in parts:
        if pid := find_lock_holder(part.path):
            return f"a fishd (pid {pid}) drives {part.what}"
    return ""


def find_owner_pid(parts: Iterable[Part]) -> str:
    """Return the pid of a fishd that drives one of these parts; empty if none is known."""
    return next(filter(None, (find_lock_holder(part.path) for part in parts)), "")


def _make_private(folder: Path) -> None:
    """Create the folder of this user; raise `StartupError` if another user may write to it."""
    folder.mkdir(mode=0o700, exist_ok=True)
    if why := find_trust_problem(folder / "fishd"):
        raise StartupError(f"lock files are not safe: {why}; remove that folder")


def _claim(part: Part, stack: ExitStack) -> None:
    for attempt in range(1, MAX_ATTEMPTS + 1):
        try:
            stack.enter_context(locked(part.path, shared=True))
            return
        except LockHeld as taken:
            if attempt == MAX_ATTEMPTS:
                raise StartupError(
                    f"another fishd (pid {taken.pid}) drives {part.what}; end it, or give this "
                    f"one another {part.key}"
                ) from None
        time.sleep(RETRY_PAUSE_S)
