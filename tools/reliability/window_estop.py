"""Emergency stops from pages while others attack `fishd-window`, its disk fails, or fishd is dead.

Presses come alternately from this machine and from a paired device at an address of its network,
each over a new connection. The attacks come from both addresses. Needs root, for the disks.
"""

import asyncio
import multiprocessing
import tempfile
import time
from argparse import Namespace
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

from msgspec import Struct

from common.daemon import TIMEOUT_S, Fishd, list_children, virtual_pi
from common.report import Options, Report, progress, table
from fishd.window.devices import Devices
from reliability.window import Window, memory
from reliability.window_attacks import (
    DISK_TROUBLES,
    NETWORK_ATTACKS,
    Target,
    mounted,
    own_address,
    pair,
    press,
    unsee,
)

MAX_PRESS_S = 0.2
"""Longest time until an emergency stop must be answered [s]."""
MAX_MEGABYTES = 90.0
"""Largest resident memory of the window [MB]."""
MIN_TROUBLE_S = 6.0
"""Shortest time for which a disk stalls [s]."""
PRESS_PERIOD_S = 0.05
WARM_UP_S = 2.0
"""Time from the start of an attack to the first press [s]."""
DEAD_PRESSES = 60
"""Number of presses at the same time while fishd is dead."""
HISTORY_S = 10.0
"""Time for which the window gathers ticks before the first attack [s]."""


class Outcome(Struct):
    """Emergency stops under one attack."""

    what: str
    presses: int
    answered: int
    """Number that fishd carried out and the window confirmed."""
    slowest: float
    """Longest time until an answer [s]."""
    megabytes: float
    """Largest resident memory of the window."""
    processes: int = 0
    """Largest number of programs that ran as a last resort at a time."""

    @property
    def is_kept(self) -> bool:
        """Whether the promise was kept."""
        return self.answered == self.presses and self.megabytes <= MAX_MEGABYTES


OPTIONS: Options = {
    "--number": {"type": int, "default": 100, "help": "of presses per attack; default 100"},
}


def measure(options: Namespace) -> Report:
    """Press under each attack in turn, under all together, and with a dead fishd; 3 minutes."""
    outcomes = []
    with tempfile.TemporaryDirectory() as place, mounted(Path(place)), ExitStack() as stack:
        folder = Path(place)
        fishd = stack.enter_context(Fishd("start.controller=hold"))
        window = stack.enter_context(Window(fishd.endpoint, place, listen="0.0.0.0:0"))
        fishd.next_tick(TIMEOUT_S)
        token = Devices(folder).invite("drive")
        tablet = asyncio.run(pair(own_address(), window.port, token))
        targets = (Target("127.0.0.1", window.port), tablet)
        time.sleep(HISTORY_S)
        attacks: list[tuple[str, Sequence[str], Sequence[str]]] = [
            ("no attack", (), ()),
            *((name, (name,), ()) for name in NETWORK_ATTACKS),
            *((name, (), (name,)) for name in DISK_TROUBLES),
            ("all of these together", tuple(NETWORK_ATTACKS), tuple(DISK_TROUBLES)),
        ]
        for what, network, disk in attacks:
            unsee(folder)
            with ExitStack() as running:
                for name in disk:
                    running.enter_context(DISK_TROUBLES[name](folder))
                running.enter_context(attacked(network, targets))
                outcome = press_all(what, targets, options.number, window.pid)
            outcomes.append(outcome)
            progress(describe(outcome))
    outcomes.append(try_dead_fishd())
    progress(describe(outcomes[-1]))
    head = "attack | E-stops answered | slowest [ms] | memory [MB]"
    rows = [
        [o.what, f"{o.answered} of {o.presses}", f"{1e3 * o.slowest:.0f}", f"{o.megabytes:.0f}"]
        for o in outcomes
    ]
    is_slow = any(o.slowest > MAX_PRESS_S for o in outcomes[:-1])
    broken = is_slow or not all(o.is_kept for o in outcomes) or outcomes[-1].processes > 1
    text = (
        f"{table(head, rows)}\n\nWith fishd dead, at most {outcomes[-1].processes} fishctl ran "
        "at a time."
    )
    attacked = outcomes[:-1]
    result = (
        f"{sum(o.answered for o in attacked)} of {sum(o.presses for o in attacked)} answered; "
        f"slowest {1e3 * max(o.slowest for o in attacked):.0f} ms, of each attack alone "
        f"{1e3 * max(o.slowest for o in attacked[:-1]):.0f} ms; at most "
        f"{max(o.megabytes for o in outcomes):.0f} MB; {outcomes[-1].processes} last resort at a "
        "time"
    )
    return Report({"reliability window-estop": text}, outcomes, broken=broken, number=result)
