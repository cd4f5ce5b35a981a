"""Program for `tick`: a naive loop.

python plain_loop.py asyncio|sleep PERIOD SECONDS PRIORITY
"""

import asyncio
import json
import os
import sys
import time


def _asyncio_loop(period: float, count: int) -> list[tuple[float, float]]:
    async def run() -> list[tuple[float, float]]:
        ticks = []
        start = time.monotonic()
        for index in range(1, count + 1):
            deadline = start + index * period
            await asyncio.sleep(deadline - time.monotonic())
            ticks.append((deadline, time.monotonic()))
        return ticks

    return asyncio.run(run())


def _sleep_loop(period: float, count: int) -> list[tuple[float, float]]:
    ticks = []
    now = time.monotonic()
    for _ in range(count):
        deadline = now + period
        time.sleep(period)
        now = time.monotonic()
        ticks.append((deadline, now))
    return ticks


def main(kind: str, period: float, seconds: float, priority: int) -> None:
    """Run one plain loop; print how late its ticks were, and their offsets from whole periods."""
    if priority:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    loop = {"asyncio": _asyncio_loop, "sleep": _sleep_loop}[kind]
    ticks = loop(period, round(seconds / period))
    late = [now - deadline for deadline, now in ticks]
    print(json.dumps((late, [now - k * period for k, (_, now) in enumerate(ticks)])))


if __name__ == "__main__":
    main(sys.argv[1], float(sys.argv[2]), float(sys.argv[3]), int(sys.argv[4]))
