"""Steps of the unix clock, forward and back, during every verb that lasts.

fishd and the verb share a unix clock that is set at random instants, by up to 20 years and also to
before 1970. Afterwards each recording must have the length that its ticks count, on an axis that
never runs back, and the verb must have done its work. Recordings that began under many wrong clocks
must be listed in their true order, and a full black box must remove the oldest of them.
"""

import json
import os
import pty
import random
import tempfile
import threading
import time
from argparse import Namespace
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from itertools import pairwise
from pathlib import Path

from msgspec import Struct

from common.daemon import Fishd
from common.processes import FISHCTL, Process, call, wait_until
from common.report import JOBS, Options, Report, progress, run_cases, table
from common.wall_clock import WallClock
from fishd.core.errors import RecordingError
from fishd.recording import Run, open_run

_TRAINING = """
evaluation: {every: 0}
ppo: {n_steps: 64, batch_size: 64}
"""
VERBS: dict[str, tuple[str, float]] = {
    "record": ("record --for 15 run", 11.0),
    "black box": ("record --black-box --for 15", 11.0),
    "watch": ("watch --for 20", 14.0),
    "measure": ("measure swing --on live --for 21", 17.0),
    "sweep": ("sweep square --frequency 1,1.5 --on live --for 21", 36.0),
    "optimise": ("optimise square --frequency : --on live --budget 90", 26.0),
    "compare": ("compare swing sine --on live --for 21 --runs 1", 36.0),
    "identify": ("identify --experiment --on live --for 40", 34.0),
    "adapt": ("adapt --on live --budget 150 --steps 640", 130.0),
    "learn": ("learn ppo --on live --steps 256 --settings training.yaml", 14.0),
}
"""Command line of each verb, and the time during which the clock is set [s]."""
RECORDING_VERBS = tuple(verb for verb in VERBS if verb not in ("watch", "learn"))
START_S = 2.0
"""Time from the start of a verb, or of its recording, to the first step of the clock [s]."""
INSTANTS = 20
"""Number of steps of the clock during each verb, and of recordings in the trial of the order."""
MIN_PAUSE_S = 0.3
"""Shortest time between two steps of the clock [s]."""
YEARS_S = 20 * 365 * 86400.0
"""Largest amount by which the clock is wrong [s]."""
TIMEOUT_S = 900.0
"""Time after which a verb counts as hung [s]."""
MAX_ERROR_S = 0.15
"""Largest error of a length: a tick may be late by three periods [s]."""
RESERVE_BYTES = 12 * 10**6
"""Size of the older files of a black box of 10 MB [bytes]."""

OPTIONS: Options = {
    **JOBS,
    "--only": {"nargs": "+", "choices": [*VERBS, "order"], "help": "of all verbs"},
    "--seed": {"type": int, "default": 1, "help": "of the instants and the steps"},
}


class Outcome(Struct):
    """Result of the trial of a verb."""

    verb: str
    steps: int = 0
    """Number of times that the clock was set."""
    listed: int = 0
    """Number of steps that its recordings list."""
    recordings: int = 0
    seconds: float = 0.0
    """Length of its recordings [s]."""
    error: float = 0.0
    """Largest error of a length [s]."""
    mistakes: list[str] = []


def measure(options: Namespace) -> Report:
    """Try each verb; broken where a length, an axis, an order or an end is wrong."""
    names = options.only or [*VERBS, "order"]
    outcomes = run_cases(partial(_try, seed=options.seed), names, options.jobs)
    rows = [
        (
            outcome.verb,
            str(outcome.steps),
            str(outcome.recordings),
            f"{outcome.seconds:.0f} s",
            f"{outcome.error * 1e3:.0f} ms",
            f"{outcome.listed}",
            "; ".join(outcome.mistakes) or "–",
        )
        for outcome in outcomes
    ]
    head = "verb | steps | recordings | length | largest error | steps listed | mistakes"
    wrong = sum(len(outcome.mistakes) for outcome in outcomes)
    result = (
        f"{wrong} mistakes after {sum(outcome.steps for outcome in outcomes)} steps; lengths of "
        f"{sum(outcome.recordings for outcome in outcomes)} recordings right within "
        f"{max(outcome.error for outcome in outcomes) * 1e3:.0f} ms"
    )
    sections = {"reliability clock_steps": table(head, rows)}
    return Report(sections, outcomes, broken=wrong > 0, number=result)


def _try(name: str, seed: int) -> Outcome:
    outcome, chance = Outcome(name), random.Random(f"{seed} {name}")
    with tempfile.TemporaryDirectory(prefix="fishd-clocks-") as place:
        folder = Path(place)
        (_try_order if name == "order" else _try_verb)(outcome, chance, folder)
    progress(name, f"{outcome.steps} steps", "; ".join(outcome.mistakes) or "right")
    return outcome


def _try_verb(outcome: Outcome, chance: random.Random, folder: Path) -> None:
    command, seconds = VERBS[outcome.verb]
    (folder / "training.yaml").write_text(_TRAINING, encoding="utf-8")
    clock = WallClock(folder / "clock")
    environment = {**os.environ, **clock.environment, "FISHD_RUNS": str(folder / "runs")}
    with Fishd("control.lease=5", environment=clock.environment) as fishd:
        fishd.next_tick()
        words = [*command.split(), "--endpoint", fishd.endpoint]
        with (
            _terminal() as terminal,
            (folder / "errors").open("w") as errors,
            Process(
                FISHCTL,
                *words,
                stdin=terminal,
                stdout=terminal,
                stderr=errors,
                env=environment,
                cwd=folder,
            ) as verb,
        ):
            if outcome.verb in RECORDING_VERBS:
                wait_until(lambda: any((folder / "runs").rglob("*.part")) or not verb.runs)
            time.sleep(START_S)
            outcome.steps = _set_at_random(clock, chance, seconds, verb)
            status, _, _ = verb.finish(TIMEOUT_S)
    lines = (folder / "errors").read_text(encoding="utf-8")
    log = fishd.log.read_text(encoding="utf-8") if fishd.log.exists() else ""
    if status or "Traceback" in lines + log:
        outcome.mistakes.append(f"status {status}: {lines[-300:].strip()}")
    paths = sorted((folder / "runs").rglob("*.mcap*"))
    for path in paths:
        try:
            _check(open_run(path), outcome)
        except RecordingError as error:
            outcome.mistakes.append(str(error))
    if not paths and outcome.verb in RECORDING_VERBS:
        outcome.mistakes.append("it left no recording")
    if outcome.verb in ("record", "black box", "measure") and outcome.listed != outcome.steps:
        outcome.mistakes.append("a step is not listed")
    for path in paths[:1]:
        drawn = call(FISHCTL, "plot", path, "--to", folder, env=environment)
        if drawn.returncode:
            outcome.mistakes.append(f"plot: {drawn.stderr.strip()[-200:]}")


@contextmanager
def _terminal() -> Iterator[int]:
    """Yield a terminal whose output is dropped."""
    main, other = pty.openpty()

    def drain() -> None:
        try:
            while os.read(main, 2**16):
                pass
        except OSError:  # its other end was closed
            return

    threading.Thread(target=drain, daemon=True).start()
    try:
        yield other
    finally:
        os.close(other)


def _set_at_random(clock: WallClock, chance: random.Random, seconds: float, verb: Process) -> int:
    """Set the clock at random instants, forward and back, while a verb runs; return how often."""
    span = seconds - INSTANTS * MIN_PAUSE_S
    begin, count, ahead = time.monotonic(), 0, 0.0
    for index, instant in enumerate(sorted(chance.uniform(0.0, span) for _ in range(INSTANTS))):
        time.sleep(max(0.0, begin + instant + index * MIN_PAUSE_S - time.monotonic()))
        if not verb.runs:
            break
        size = chance.choice((0.3, 30.0, 3600.0, YEARS_S)) * chance.uniform(0.6, 1.0)
        ahead = (-1.0) ** index * size - (time.time() + size) * (index == INSTANTS // 2)
        clock.set(ahead)
        count += 1
    return count


def _check(run: Run, outcome: Outcome) -> None:
    """Compare the length of a recording with its ticks, and look for times that run back."""
    ticks, times = run.ticks, run.times_of("tick")
    outcome.recordings += 1
    if not ticks:
        return
    first, last = ticks[0], ticks[-1]
    slots = last.seq - first.seq + last.missed_slots - first.missed_slots
    truth = slots * run.config.tick
    outcome.seconds += truth
    outcome.error = max(outcome.error, abs(run.summary.duration - truth))
    outcome.listed += len(run.summary.clock_steps)
    logged = [entry.log_time for entry in run.entries if entry.topic == "tick"]
    if outcome.error > MAX_ERROR_S:
        outcome.mistakes.append(f"{run.name}: {run.summary.duration:.1f} s, not {truth:.1f} s")
    if any(later < earlier for column in (times, logged) for earlier, later in pairwise(column)):
        outcome.mistakes.append(f"{run.name}: time runs back")
    if not all(-3.0 <= moment <= truth + 3.0 for moment in run.times):
        outcome.mistakes.append(f"{run.name}: a message is outside of its length")


def _try_order(outcome: Outcome, chance: random.Random, folder: Path) -> None:
    """Record under many wrong clocks, and give the files wrong times."""
    clock = WallClock(folder / "clock")
    runs = folder / "runs"
    environment = {**os.environ, **clock.environment, "FISHD_RUNS": str(runs)}
    names = [f"{chance.getrandbits(32):08x}" for _ in range(INSTANTS)]
    with Fishd(environment=clock.environment) as fishd:
        fishd.next_tick()

        def record(*words: str) -> None:
            command = (FISHCTL, "record", *words, "--for", "0.4", "--endpoint", fishd.endpoint)
            done = call(*command, env=environment)
            if done.returncode:
                outcome.mistakes.append(done.stderr.strip()[-200:])
            for path in runs.iterdir():
                moment = chance.uniform(-YEARS_S, YEARS_S)
                os.utime(path, (moment, moment))

        for name in names:
            clock.set(chance.uniform(-time.time() - YEARS_S, YEARS_S))
            outcome.steps += 1
            record(name)
        listed = json.loads(call(FISHCTL, "runs", "--json", env=environment).stdout)
        if [run["name"] for run in listed] != names:
            outcome.mistakes.append("runs lists another order")
        outcome.recordings = len(listed)
        for name in names:
            (runs / f"{name}.mcap").rename(runs / f"blackbox-{name}.mcap")
        size = RESERVE_BYTES // len(names)
        for path in runs.glob("blackbox-*"):
            with path.open("ab") as file:  # bytes after the end of a recording are not read
                file.truncate(size)
        record("--black-box", "--keep", "10MB")
    kept = {path.stem.removeprefix("blackbox-") for path in runs.glob("blackbox-*.mcap")}
    left = [name in kept for name in names]
    if left != sorted(left) or all(left) or not any(left):
        outcome.mistakes.append("the black box removed others than the oldest")
