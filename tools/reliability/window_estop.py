"""Emergency stops from pages under attacks on `fishd-window`, with a failing disk, without fishd.

Presses come alternately from this machine and from a paired device at an address of its network,
each over a new connection. The attacks come from both addresses. Needs root, for the disks.
"""

import asyncio
import multiprocessing
import signal
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
MAX_PRESS_WITHOUT_FISHD_S = 2.0
"""The same while fishd is dead or hangs [s]."""
MAX_MEGABYTES = 90.0
"""Largest resident memory of the window [MB]."""
MIN_TROUBLE_S = 6.0
"""Shortest time for which a disk stalls [s]."""
PRESS_PERIOD_S = 0.05
WARM_UP_S = 2.0
"""Time from the start of an attack to the first press [s]."""
PRESSES_WITHOUT_FISHD = 60
"""Number of presses at the same time while fishd is dead or hangs."""
ENDS = {"is dead": signal.SIGKILL, "hangs": signal.SIGSTOP}
"""Signals that end fishd, by what it is then."""
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
    "--only": {"default": "", "help": "rows whose description contains this text"},
}


def measure(options: Namespace) -> Report:
    """Press under each attack in turn, under all together, and without fishd; 3 minutes."""
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
            if options.only not in what:
                continue
            unsee(folder)
            with ExitStack() as running:
                for name in disk:
                    running.enter_context(DISK_TROUBLES[name](folder))
                running.enter_context(attacked(network, targets))
                outcome = press_all(what, targets, options.number, window.pid)
            outcomes.append(outcome)
            progress(describe(outcome))
    tried = list(outcomes)
    for what, number in ENDS.items():
        if options.only in f"fishd {what}":
            outcomes.append(try_without_fishd(what, number))
            progress(describe(outcomes[-1]))
    without = outcomes[len(tried) :]
    head = "attack | E-stops answered | slowest [ms] | memory [MB]"
    rows = [
        [o.what, f"{o.answered} of {o.presses}", f"{1e3 * o.slowest:.0f}", f"{o.megabytes:.0f}"]
        for o in outcomes
    ]
    slowest, slowest_alone, slowest_without = (
        max((outcome.slowest for outcome in some), default=0.0)
        for some in (tried, tried[:-1], without)
    )
    processes = max((outcome.processes for outcome in without), default=0)
    is_slow = slowest > MAX_PRESS_S or slowest_without > MAX_PRESS_WITHOUT_FISHD_S
    broken = is_slow or not all(o.is_kept for o in outcomes) or processes > 1
    text = f"{table(head, rows)}\n\nWithout fishd, at most {processes} fishctl ran at a time."
    result = (
        f"{sum(o.answered for o in outcomes)} of {sum(o.presses for o in outcomes)} answered; "
        f"slowest {1e3 * slowest:.0f} ms, of each attack alone {1e3 * slowest_alone:.0f} ms, "
        f"without fishd {1e3 * slowest_without:.0f} ms; at most "
        f"{max(o.megabytes for o in outcomes):.0f} MB; {processes} last resort at a time"
    )
    return Report({"reliability window_estop": text}, outcomes, broken=broken, number=result)


def describe(outcome: Outcome) -> str:
    """Return a line about an outcome."""
    return (
        f"{outcome.what} | {outcome.answered} of {outcome.presses} | "
        f"{1e3 * outcome.slowest:.0f} ms | {outcome.megabytes:.0f} MB"
    )


@contextmanager
def attacked(names: Sequence[str], targets: Sequence[Target]) -> Iterator[None]:
    """Attack a window at several addresses in other processes."""
    context = multiprocessing.get_context("spawn")
    processes = [
        context.Process(target=_attack, args=(name, target), daemon=True)
        for name in names
        for target in targets
    ]
    for process in processes:
        process.start()
    try:
        if processes:
            time.sleep(WARM_UP_S)
        yield
    finally:
        for process in processes:
            process.kill()
            process.join()


def _attack(name: str, target: Target) -> None:
    async def run() -> None:
        await NETWORK_ATTACKS[name](target, lambda: None)

    asyncio.run(run())


def press_all(what: str, targets: Sequence[Target], number: int, pid: int) -> Outcome:
    """Press one after the other, and for at least as long as a disk stalls."""
    times: list[float | None] = []
    outcome = Outcome(what, number, 0, 0.0, 0.0)

    async def run() -> None:
        period = max(PRESS_PERIOD_S, MIN_TROUBLE_S / number)
        for count in range(number):
            times.append(await press(targets[count % len(targets)]))
            outcome.megabytes = max(outcome.megabytes, memory(pid))
            await asyncio.sleep(period)

    asyncio.run(run())
    answers = [seconds for seconds in times if seconds is not None]
    outcome.answered, outcome.slowest = len(answers), max(answers, default=0.0)
    return outcome


def try_without_fishd(what: str, number: signal.Signals) -> Outcome:
    """Press many times at once while the pulses of a virtual servo are on; number: ends fishd."""
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        _, settings = stack.enter_context(virtual_pi(folder))
        config = folder / "fishd.yaml"
        config.write_text("\n".join(line_of(setting) for setting in settings))
        fishd = stack.enter_context(Fishd(*settings))
        window = stack.enter_context(Window(fishd.endpoint, str(folder), config=str(config)))
        fishd.next_tick(TIMEOUT_S)
        fishd.process.send_signal(number)
        return asyncio.run(press_at_once(what, Target("127.0.0.1", window.port), window.pid))


def line_of(setting: str) -> str:
    """Return a line of YAML for a setting KEY=VALUE."""
    key, _, value = setting.partition("=")
    section, dot, name = key.partition(".")
    return f"{section}: {{{name}: {value}}}" if dot else f"{key}: {value}"


async def press_at_once(what: str, target: Target, pid: int) -> Outcome:
    """Press many times at once, and count the programs that the window starts."""
    count = PRESSES_WITHOUT_FISHD
    outcome = Outcome(f"fishd {what}, {count} presses at once", count, 0, 0.0, 0.0)
    pressing = asyncio.gather(*(press(target) for _ in range(count)))
    while not pressing.done():
        outcome.processes = max(outcome.processes, len(list_children(pid)))
        outcome.megabytes = max(outcome.megabytes, memory(pid))
        await asyncio.sleep(0.02)
    answers = [seconds for seconds in pressing.result() if seconds is not None]
    outcome.answered, outcome.slowest = len(answers), max(answers, default=0.0)
    return outcome
