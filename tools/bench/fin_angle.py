"""Errors of the fin angle that is measured in pictures, on films whose fin angle is known.

Each film of the tests is learned from its first 5 s and measured in the next 7 s, and some of them
again with a calibration by a board. The worst of all seeds is shown, and after a slash the goal.
With --faults, a fault begins at 6 s instead.
"""

import sys
import time
import tracemalloc
from argparse import Namespace
from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from common.report import DOCS, JOBS, Options, Report, run_cases, table

sys.path.append(str(DOCS.parent / "tests"))
from rigs.faulty_films import FAULTS, FILMS, fail
from rigs.filmed_board import calibrate
from rigs.filmed_tail import FilmedTail
from rigs.measured_tail import ASKED, ASKED_CALIBRATED, BENT, CASES, find_errors

from fishd.camera.tail.learner import Learner
from fishd.camera.tail.meter import TailMeter

OPTIONS: Options = JOBS | {
    "--seeds": {"type": int, "default": 3, "help": "number of films of each kind"},
    "--faults": {"action": "store_true", "help": "measure films with faults"},
}
FIRST_SEED = 600
"""Seed of the first film with faults; nothing was chosen with these."""


def measure(options: Namespace) -> Report:
    """Return the table."""
    if options.faults:
        return _measure_faults(options)
    cases = [(case, False) for case in CASES] + [(case, True) for case in BENT]
    films = [(*case, seed) for case in cases for seed in range(options.seeds)]
    results = dict(zip(films, run_cases(_measure_film, films, options.jobs), strict=True))

    def cells(case: str, calibrated: bool, asked: Sequence[float | None]) -> list[str]:
        each = np.array([results[case, calibrated, seed] for seed in range(options.seeds)])
        return [
            f"{worst:.1f}" + (f"/{limit:g}" if limit is not None else "")
            for worst, limit in zip(np.abs(each[:, :2]).max(axis=0), asked, strict=True)
        ]

    rows = [
        [
            case,
            *cells(case, False, asked),
            *(cells(case, True, (None, ASKED_CALIBRATED)) if case in BENT else ["", ""]),
        ]
        for case, asked in ASKED.items()
    ]
    every = np.array(list(results.values()))
    is_bent = np.array([case in BENT and not calibrated for case, calibrated, _ in results])
    known, *covered = (
        100.0 * each.min() for each in (every[:, 2], every[~is_bent, 3], every[is_bent, 3])
    )
    about = (
        f"Of the pictures, at least {known:.0f} % are measured, {covered[0]:.0f} % of them within "
        f"their ± (without a calibration that is needed, {covered[1]:.0f} %). One takes "
        f"{every[:, 4].max():.1f} ms, and learning {every[:, 5].max():.1f} s and "
        f"{_find_memory() / 1e6:.0f} MB."
    )
    figures = {
        f"{case}{', calibrated' * calibrated}, seed {seed}": result
        for (case, calibrated, seed), result in results.items()
    }
    head = "film | rms [mrad] | α_max [%] | calibrated: rms | α_max"
    return Report({"bench fin_angle": f"{table(head, rows)}\n\n{about}"}, figures)


def _measure_faults(options: Namespace) -> Report:
    """Return the table of faults: fractions of all films, and the last to be named."""
    seeds = range(FIRST_SEED, FIRST_SEED + options.seeds)
    films = [(film, seed) for seed in seeds for film in FILMS]
    outcomes = dict(zip(films, run_cases(_measure_outcomes, films, options.jobs), strict=True))
    rows = []
    for fault in FAULTS:
        cells = [fault]
        for film in FILMS:
            each = [outcomes[film, seed][fault] for seed in seeds]
            known, wrong = (100.0 * np.mean([x[index] for x in each]) for index in (0, 1))
            told = max(0.0, *(x[2] for x in each))
            cells.append(f"{known:.0f} % / {wrong:.1f} %")
            if np.isfinite(told):
                cells[-1] += f" / {told:.1f} s"
        rows.append(cells)
    text = table(" | ".join(["fault", *FILMS]), rows)
    figures = {f"{film}, seed {seed}": outcome for (film, seed), outcome in outcomes.items()}
    return Report({"bench fin_angle --faults": text}, figures)


def _measure_outcomes(case: tuple[str, int]) -> dict[str, tuple[float, float, float]]:
    """Return the outcome of each fault in a film."""
    cv2.setNumThreads(1)
    film = replace(FILMS[case[0]], seed=case[1])
    return {fault: tuple(fail(film, fault, case[1])) for fault in FAULTS}  # type: ignore[misc]


def _measure_film(case: tuple[str, bool, int]) -> list[float]:
    """Return the errors of a film [mrad, %], two fractions, and the cost [ms, s]."""
    cv2.setNumThreads(1)
    film = replace(CASES[case[0]], seed=case[2])
    camera, learner = FilmedTail(film), Learner(calibrate(film) if case[1] else None)
    for shot in camera.shots(0.0, 5.0):
        learner.add(*shot)
    begin = time.process_time()
    learned = learner.finish()
    learning = time.process_time() - begin
    meter, readings, cost = TailMeter(learned), [], 0.0
    for shot in camera.shots(5.0, 12.0):
        begin = time.process_time()
        readings.append(meter.read(shot.time, shot.picture, film.read_out))
        cost += time.process_time() - begin
    errors = find_errors(film, readings)
    return [
        1e3 * errors.rms, 100.0 * errors.alpha_max, errors.known, errors.covered,
        1e3 * cost / len(readings), learning,
    ]  # fmt: skip


def _find_memory() -> int:
    """Return the largest memory of pictures and of learning from them [bytes]."""
    tracemalloc.start()
    learner = Learner()
    for shot in FilmedTail(CASES["plain"]).shots(0.0, 17.0):
        learner.add(*shot)
    tracemalloc.reset_peak()
    learner.finish()
    return tracemalloc.get_traced_memory()[1]
