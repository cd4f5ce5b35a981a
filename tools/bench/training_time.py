"""Duration of `fishctl learn ppo` with its defaults, for `learning time`."""

import math
import resource
import subprocess
import sys
import tempfile
import time
from argparse import Namespace
from pathlib import Path
from typing import NamedTuple

from common.machine import machine_in_short
from common.report import progress, spread, table
from fishd.learning.run_folder.tables import best_so_far, read_evaluations

GOOD_RELATIVE_THRUST = 0.97
FIRST_SEED = 3000
"""No setting was chosen with this seed or the following ones."""


class Timing(NamedTuple):
    """Times of one training, from the start of its process to its end."""

    to_enough: float
    """Time until an evaluation has a relative thrust of `GOOD_RELATIVE_THRUST`; infinite without
    one [s]."""
    total: float
    """[s]"""
    processor: float
    """Processor time [s]."""
    steps: int
    """Number of control steps of the training."""
    best: float
    """Relative thrust of the best policy."""


def training_time(options: Namespace) -> str:
    """Return the table of times of trainings, one process after the other."""
    runs = [_timed(seed) for seed in range(FIRST_SEED, FIRST_SEED + options.seeds)]
    heads = (
        "default settings | time until 97 % is reached (s) | time until the run ends (s) "
        "| processor time (s) | steps | best policy (%)"
    )
    row = [
        f"{len(runs)} seeds, {FIRST_SEED} to {FIRST_SEED + len(runs) - 1}",
        spread([run.to_enough for run in runs], 1.0, 1).replace("inf", "never"),
        spread([run.total for run in runs], 1.0, 1),
        spread([run.processor for run in runs], 1.0, 1),
        spread([float(run.steps) for run in runs], 1.0, 0),
        spread([run.best for run in runs]),
    ]
    return f"Whole processes, on {machine_in_short()}:\n\n{table(heads, [row])}"


def _timed(seed: int) -> Timing:
    fishctl = Path(sys.executable).with_name("fishctl")
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) / "run"
        command = [fishctl, "learn", "ppo", "--seed", str(seed), "--folder", folder]
        before, begun = _processor_time(), time.perf_counter()
        shown = []
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as training:
            assert training.stdout
            for line in training.stdout:
                if " in the tank" in line:
                    shown.append(time.perf_counter() - begun)
        if training.returncode:
            raise subprocess.CalledProcessError(training.returncode, command)
        total = time.perf_counter() - begun
        evaluations = read_evaluations(folder)
    best = best_so_far(evaluations)
    reached = (when for when, share in zip(shown, best) if share >= GOOD_RELATIVE_THRUST)  # noqa: B905
    timing = Timing(
        to_enough=next(reached, math.inf),
        total=total,
        processor=_processor_time() - before,
        steps=evaluations[-1].steps,
        best=best[-1],
    )
    progress(f"seed {seed}: {timing}")
    return timing


def _processor_time() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime
