"""Duration of a sweep, and ticks of swimming that a search needs.

sweep      3 waveforms × 20 frequencies in simulation, by `fishctl sweep`, including its start
search     the frequency of `square` on config/simulated.yaml, sensor drift included
"""

import os
import statistics
import subprocess
import sys
import tempfile
import time
from argparse import Namespace
from functools import lru_cache
from pathlib import Path

import joblib
import numpy as np
from msgspec.structs import replace

from common.report import DOCS, Options, Report, progress, table
from fishd.config import Config, load
from fishd.lab.optimise.search import Range, Search
from fishd.lab.optimise.trials import measure_trials, restrict_to_whole_ticks
from fishd.lab.session import VirtualSession
from fishd.lab.simulation import simulate

DOCUMENT = "how-to/sweeps.md"
FISH = DOCS.parent / "config" / "simulated.yaml"
FREQUENCIES = "0.2:4:0.2"
RANGE = (0.4, 5.0)
"""Range of `--over frequency` with ticks of 50 ms [Hz]."""
GOOD_RELATIVE_THRUST, MIN_IMPROVEMENT, BUDGET_S = 0.97, 0.01, 300.0


def sweep_seconds() -> tuple[float, float]:
    """Return the duration of the command and its processor time of all cores [s]."""
    fishctl = Path(sys.executable).with_name("fishctl")
    with tempfile.TemporaryDirectory() as folder:
        words = ["sweep", "square,sine,triangle", "--frequency", FREQUENCIES, "--config", str(FISH)]
        begun, used = time.perf_counter(), _of_children()
        command = [str(fishctl), *words, "--folder", f"{folder}/run"]
        subprocess.run(command, check=True, capture_output=True)
        return time.perf_counter() - begun, _of_children() - used


def _of_children() -> float:
    cpu_times = os.times()
    return cpu_times.children_user + cpu_times.children_system


@lru_cache(maxsize=1000)
def thrust(frequency: float) -> float:
    """Return the true thrust of a square wave, without noise and drift of the sensor [N]."""
    return simulate(load(FISH), "square", {"frequency": frequency}, 40.0).mean_thrust


def search(config: Config, seed: int) -> tuple[int, int, int, float, bool]:
    """Return the ticks until a proposal is good, until all later ones are, and until the end;
    the share of the best thrust in the end, and whether that proposal's interval has the best."""
    config = replace(config, simulation=replace(config.simulation, seed=seed))
    grid = [0.5 / (ticks * config.tick) for ticks in range(5, 8)]
    frequencies = [*np.arange(1.5, 2.0, 0.02).tolist(), *grid]
    best = max(frequencies, key=thrust)
    search_state = Search([restrict_to_whole_ticks(Range("frequency", *RANGE), config.tick)], seed)
    swum, shares = [], []
    with VirtualSession(config) as rig:
        for trial in measure_trials(rig, "square", {}, search_state, BUDGET_S):
            proposal = search_state.propose()
            swum.append(trial.swum)
            at = round(proposal.parameters["frequency"], 3)
            shares.append(thrust(at) / thrust(best))
            if search_state.is_warm and proposal.improvement <= MIN_IMPROVEMENT:
                break
    good = [share >= GOOD_RELATIVE_THRUST for share in shares]
    first = swum[good.index(True)] if any(good) else sys.maxsize
    last_bad = max((index for index, each in enumerate(good) if not each), default=-1)
    stays = swum[last_bad + 1] if last_bad + 1 < len(swum) else sys.maxsize
    covers = proposal.low["frequency"] <= best <= proposal.high["frequency"]
    return first, stays, swum[-1], shares[-1], covers


OPTIONS: Options = {
    "--seeds": {"type": int, "default": 10, "help": "searches; default 10"},
    "--runs": {"type": int, "default": 3, "help": "sweeps; default 3"},
}


def measure(options: Namespace) -> Report:
    """Return both tables; takes a minute."""
    load_before = os.getloadavg()[0]
    sweeps = []
    for _ in range(options.runs):
        sweeps.append(sweep_seconds())
        progress("sweep", *(f"{seconds:.1f} s" for seconds in sweeps[-1]))
    times, used = zip(*sweeps, strict=True)
    config = load(FISH)
    searches = []
    for seed in range(options.seeds):
        searches.append(search(config, seed))
        progress("search", str(seed), str(searches[-1]))
    first, stays, ends, shares, covers = zip(*searches, strict=True)
    rows = [
        ["ticks until the proposal gives 97 % of the best", *_spread(first)],
        ["ticks until all later proposals give that, too", *_spread(stays)],
        ["ticks until the search ended", *_spread(ends)],
        ["true thrust of the final proposal, % of the best", *_spread(shares, 100.0)],
    ]
    text = table(f"search of the frequency, {len(searches)} seeds | median | range", rows)
    return Report(
        {
            "bench sweep": f"60 points on {joblib.cpu_count()} cores: "
            f"{statistics.median(times):.1f} s (median of {len(times)}; "
            f"{min(times):.1f} – {max(times):.1f} s), start and picture included, for "
            f"{statistics.median(used):.1f} s of computing, begun at a load average of "
            f"{load_before:.1f}.",
            "bench search": f"{text}\n\nThe best frequency was within the interval of "
            f"{sum(covers)} of {len(covers)}.",
        },
        {"sweep": sweeps, "search": searches},
    )


def _spread(values: tuple[float, ...], factor: float = 1.0) -> tuple[str, str]:
    shown = [factor * value for value in values]
    digits = 1 if factor != 1.0 else 0
    low, high = (f"{function(shown):.{digits}f}" for function in (min, max))
    return f"{statistics.median(shown):.{digits}f}", f"{low} – {high}"
