"""Accuracy and speed of the free swimmer, compared with reference values.

It takes several minutes to hours, mostly on one core; options for larger cells make it faster.

    turek-hron    an elastic flag behind a cylinder, FSI3 and FSI2, beside the published values
    cylinder      flow past a fixed cylinder at a Reynolds number of 100
    beam          frequencies of a free beam, and deflection of a clamped one by its weight
    momentum      momentum of a fish and its water, against the flux through the boundaries
    convergence   swimming speed with smaller cells and shorter steps
    speed         seconds for a second of swimming, beside a finite-element solver
"""

import os

for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")  # before numpy is loaded

import time  # noqa: E402
from argparse import Namespace  # noqa: E402

from bench.swimmer_cylinder import cylinder  # noqa: E402
from bench.swimmer_fish import convergence, momentum, speed  # noqa: E402
from bench.swimmer_flag import beam, turek_hron  # noqa: E402
from common.machine import machine_in_short  # noqa: E402
from common.report import Options, Report, progress  # noqa: E402

DOCUMENT = "explanation/swimmer.md"
PARTS = {
    "turek-hron": turek_hron,
    "cylinder": cylinder,
    "beam": beam,
    "momentum": momentum,
    "convergence": convergence,
    "speed": speed,
}
OPTIONS: Options = {
    "part": {"choices": (*PARTS, "all")},
    "--finest": {
        "type": float,
        "default": 1.0,
        "help": "cells of the finest grid over those of the defaults (1)",
    },
}


def measure(options: Namespace) -> Report:
    """Return the requested parts."""
    sections = {}
    for part in PARTS if options.part == "all" else (options.part,):
        begun = time.perf_counter()
        text = PARTS[part](options.finest)
        seconds = time.perf_counter() - begun
        progress(part, f"{seconds:.0f} s")
        about = f"`tools/bench swimmer {part}`, {seconds:.0f} s; {machine_in_short()}"
        sections[f"bench swimmer {part}"] = f"{text}\n\n{about}"
    return Report(sections, sections)
