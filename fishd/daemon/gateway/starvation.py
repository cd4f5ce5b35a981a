"""Check of a process that does not answer: whether it got the processor time for an answer.

On a busy machine a healthy process may wait for a processor for a second. To kill it would lose the
requests that it holds, and its successor would wait as long.
"""

import os
from contextlib import suppress
from typing import NamedTuple

_TICKS_PER_S = os.sysconf("SC_CLK_TCK")


class Thread(NamedTuple):
    """A thread of a process, as its file `stat` in /proc describes it."""

    state: str
    """State: R if it runs or could run, S if it sleeps, D if it waits for a disk, T if stopped."""
    used: float
    """Processor time used since its start [s], in steps of 10 ms."""


def parse_thread(stat: bytes) -> Thread:
    """Return a thread for the content of its file `stat`."""
    fields = stat.rpartition(b")")[2].split()  # the name before it may contain anything
    return Thread(fields[0].decode(), (int(fields[11]) + int(fields[12])) / _TICKS_PER_S)


def read_threads(pid: int) -> list[Thread]:
    """Return the threads of a process, its main thread first; none if it has ended."""
    threads = []
    with suppress(OSError):
        for number in os.listdir(f"/proc/{pid}/task"):  # noqa: PTH208
            with open(f"/proc/{pid}/task/{number}/stat", "rb", 0) as file:  # noqa: PTH123
                threads.append(parse_thread(file.read(1000)))
    return threads


def is_starved(before: list[Thread], now: list[Thread], answer_s: float) -> bool:
    """Return whether a process has lacked the processor time for an answer.

    before, now: its threads when an answer was first missed, and at present
    answer_s: processor time of the main thread that is enough for an answer [s]

    The main thread may wait for another one that lacks processor time.
    """
    return (
        bool(before and now)
        and now[0].state in "RS"
        and now[0].used - before[0].used < answer_s
        and any(thread.state == "R" for thread in now)
    )
