"""Exclusive use of the robot's parts by one fishd.

Two programs on one bus would take each other's samples, without an error. The claims are names in
the kernel, so they are the same for all users and environments.
"""

import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import NamedTuple

from fishd.core.errors import StartupError
from fishd.core.process.kernel_names import Holder, NameTaken, claimed, find_holder
from fishd.hardware.driver import Claim

MAX_ATTEMPTS, RETRY_PAUSE_S = 50, 0.02
"""Attempts to claim a part, which a fishd that ends may still hold; pause between them [s]."""


class Part(NamedTuple):
    """Part of the robot that at most one fishd may drive."""

    name: str
    """Name in the kernel that is claimed."""
    what: str
    """Name in messages."""
    key: str
    """Configuration key with which the user chooses another one."""


def parts_of_pi(claims: Mapping[str, Iterable[Claim]]) -> tuple[Part, ...]:
    """Return the parts that robot pi drives: what its drivers claim, by section."""
    parts: dict[str, Part] = {}
    for section, section_claims in claims.items():
        for claim in section_claims:
            name = f"drives/{claim.name}"
            parts.setdefault(name, Part(name, claim.what, f"{section}.{claim.key}"))
    return tuple(parts.values())


def parts_of_virtual_pi(socket: Path) -> tuple[Part, ...]:
    """Return the part that robot virtual-pi drives: the virtual Pi that listens on `socket`."""
    name = f"drives/virtual-pi{socket.resolve()}"  # a socket may have several names
    return (Part(name, f"the virtual Pi on {socket}", "virtual_pi.socket"),)


@contextmanager
def claim_parts(parts: Iterable[Part]) -> Iterator[None]:
    """Claim these parts within the context.

    Raises `StartupError`, which names the other process, if one already drives a part.
    """
    with ExitStack() as stack:
        for part in parts:
            _claim(part, stack)
        yield


def describe_owner(parts: Iterable[Part]) -> str | None:
    """Return a line that names the fishd that drives one of these parts; None if none does."""
    for part in parts:
        if holder := find_holder(part.name):
            return f"a fishd (pid {holder}) drives {part.what}"
    return None


def find_owner(parts: Iterable[Part]) -> Holder | None:
    """Return the fishd that drives one of these parts; None if none does."""
    return next(filter(None, (find_holder(part.name) for part in parts)), None)


def _claim(part: Part, stack: ExitStack) -> None:
    for attempt in range(1, MAX_ATTEMPTS + 1):
        try:
            stack.enter_context(claimed(part.name))
            return
        except NameTaken as taken:
            if attempt == MAX_ATTEMPTS:
                raise StartupError(
                    f"another fishd (pid {taken.holder}) drives {part.what}; end it, or give this "
                    f"one another {part.key}"
                ) from None
        time.sleep(RETRY_PAUSE_S)
