"""Emergency stops while files of fishd's sockets are removed, and from other environments.

A real fishd swims. At a random instant its sockets, their folder, or the folder of the login
session are removed or replaced, and `fishctl estop` is run at a random time up to 1.5 s later. The
trials run in a network of their own, so that no other fishd of this machine is found or stopped.
"""

import ctypes
import os
import random
import shutil
import tempfile
import time
from argparse import Namespace
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from msgspec import Struct

from common.processes import FISHCTL, FISHD, PATIENCE, Process, call, sets
from common.report import Options, Report, progress, table
from fishd.core import local_daemons

MAX_DELAY_S = 1.5
"""Longest time from the event to the emergency stop [s]."""
MAX_AGE_S = 0.5
"""Longest time from the first tick to the event [s]; checks of the files have this period."""
MAX_GONE_S = 1.0
"""Time within which the sockets must exist again [s]."""
CLONE_NEWUSER, CLONE_NEWNET = 0x10000000, 0x40000000


class Attempt(Struct):
    """One emergency stop, and what came of it."""

    event: str
    delay: float
    """Time from the event to the start of `fishctl estop` [s]."""
    stopped: bool
    """Whether it was confirmed, and fishd was in mode estop afterwards."""
    seconds: float
    """Time that `fishctl estop` took, with the start of Python [s]."""
    way: str
    restored: float | None
    """Time until clients found the sockets again [s]; None if they were not to be found."""
    said: bool
    """Whether the log names what had happened."""


def remove_folder(session: Path) -> None:
    """Remove the folder of the sockets."""
    shutil.rmtree(session / "fishd")


def remove_sockets(session: Path) -> None:
    """Remove the sockets alone."""
    for path in (session / "fishd").glob("control*"):
        path.unlink()


def remove_and_create_folder(session: Path) -> None:
    """Remove the folder, and create it again without sockets."""
    shutil.rmtree(session / "fishd")
    (session / "fishd").mkdir(mode=0o700)


def replace_folder_by_file(session: Path) -> None:
    """Put a file in the place of the folder, which then cannot be created."""
    shutil.rmtree(session / "fishd")
    (session / "fishd").touch()


def log_out(session: Path) -> None:
    """Remove the folder of the login session, which only root may create."""
    shutil.rmtree(session)


def do_nothing(_: Path) -> None:
    """Change nothing."""


EVENTS: dict[str, tuple[Callable[[Path], None], bool]] = {
    "the folder of the sockets is removed": (remove_folder, False),
    "the sockets are removed, the folder stays": (remove_sockets, False),
    "the folder is removed and created by another program": (remove_and_create_folder, False),
    "a file replaces the folder": (replace_folder_by_file, False),
    "a logout removes the folder of the session": (log_out, False),
    "the stop comes from cron, without XDG_RUNTIME_DIR": (do_nothing, True),
    "a logout, and the stop comes from cron": (log_out, True),
}
"""Function that makes an event happen, and whether the stop comes from cron."""


def isolate() -> None:
    """Move this process into a network of its own; raise OSError."""
    user = os.geteuid()
    flags = CLONE_NEWNET | (CLONE_NEWUSER if user else 0)
    if ctypes.CDLL(None, use_errno=True).unshare(flags):
        raise OSError(ctypes.get_errno(), "this trial needs a network of its own: run it as root")
    if user:
        Path("/proc/self/uid_map").write_text(f"{user} {user} 1")


def attempt(event: str, age: float, delay: float) -> Attempt:
    """Start a fishd that swims, let the event happen, and stop the fish.

    age, delay: times from the start of fishd to the event, and from there to the stop [s]
    """
    make, from_cron = EVENTS[event]
    with tempfile.TemporaryDirectory(prefix="fishd-") as name:
        session = Path(name) / "session"
        session.mkdir()
        fallback = Path(f"/tmp/fishd-{os.geteuid()}")
        login = {**os.environ, "XDG_RUNTIME_DIR": str(session)}
        for variable in ("FISHD_ENDPOINT", "RUNTIME_DIRECTORY"):
            login.pop(variable, None)
        cron = {key: value for key, value in login.items() if key != "XDG_RUNTIME_DIR"}
        settings = sets("start.controller=swing", f"telemetry.address=ipc://{name}/telemetry")
        log = Path(name) / "log"
        with (
            log.open("wb") as output,
            Process(
                FISHD, "--no-print-status", *settings, env=login, stdout=output, stderr=output
            ) as fishd,
        ):
            await_true((session / "fishd" / "control.estop").exists)
            time.sleep(age)
            make(session)
            begun = time.monotonic()
            restored = None
            while (now := time.monotonic()) < begun + delay:
                found = [place / "control" for place in (session / "fishd", fallback)]
                if restored is None and any(path.is_socket() for path in found):
                    restored = now - begun
                time.sleep(0.005)
            started = time.monotonic()
            done = call(FISHCTL, "estop", env=cron if from_cron else login)
            seconds = time.monotonic() - started
            own = local_daemons.find_own()
            mode = str(local_daemons.ask(own, b'{"v": 2, "op": "status"}', PATIENCE))
            with suppress(IndexError):
                done.stdout = done.stdout.split("stopped through: ")[1].partition(";")[0]
            fishd.end_or_kill(PATIENCE)
        said = make is do_nothing or "sockets" in log.read_text() or restored is None
        return Attempt(
            event,
            delay,
            done.returncode == 0 and '"mode":"estop"' in mode,
            seconds,
            done.stdout.strip().partition(",")[0].partition(":")[0],
            restored,
            said,
        )


def await_true(true: Callable[[], bool]) -> None:
    """Wait for a condition; raise SystemExit if it does not hold in time."""
    deadline = time.monotonic() + PATIENCE
    while not true():
        if time.monotonic() > deadline:
            raise SystemExit("fishd did not start")
        time.sleep(0.01)


OPTIONS: Options = {
    "--number": {"type": int, "default": 20, "help": "of emergency stops for each event; 20"},
    "--seed": {"type": int, "default": 1, "help": "default 1"},
}


def measure(options: Namespace) -> Report:
    """Stop fish; five minutes."""
    isolate()
    chance = random.Random(options.seed)
    attempts = list[Attempt]()
    for event in EVENTS:
        for number in range(options.number):
            age, delay = chance.uniform(0.0, MAX_AGE_S), chance.uniform(0.0, MAX_DELAY_S)
            attempts.append(attempt(event, age, delay))
            progress(f"{event} {number + 1}", f"{attempts[-1]}")
    rows, broken = [], False
    for event in EVENTS:
        own = [each for each in attempts if each.event == event]
        late = [each.restored for each in own if each.delay > MAX_GONE_S]
        never = event == "a file replaces the folder"
        in_time = never or all(wait is not None and wait <= MAX_GONE_S for wait in late)
        lost = sum(not each.stopped for each in own)
        broken |= lost > 0 or not in_time or not all(each.said for each in own)
        waits = [each.restored for each in own if each.restored is not None]
        ways = sorted({each.way for each in own})
        rows.append(
            [
                event,
                f"{len(own) - lost} of {len(own)}",
                f"{max(each.seconds for each in own):.2f}",
                f"{max(waits):.2f}" if waits and not never else "–",
                ", ".join(ways),
            ]
        )
    head = "what happens | stops confirmed | slowest [s] | sockets again after [s] | ways"
    text = f"{table(head, rows)}\n\nSeed {options.seed}."
    gone = [each.restored for each in attempts if each.restored and each.delay > MAX_GONE_S]
    result = (
        f"{sum(each.stopped for each in attempts)} of {len(attempts)} confirmed; sockets again "
        f"within {max(gone):.2f} s"
    )
    return Report({"reliability reach": text}, attempts, broken=broken, number=result)
