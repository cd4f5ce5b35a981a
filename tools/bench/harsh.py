"""Effect of each imperfection of config/harsh.yaml on `swing`, alone and with all others.

Each fish swims in virtual time with C = 0.6 for a minute, without its first 10 s, and with
C = auto, of which the second minute counts. Relative thrust is the true thrust over that of the
best square wave of the same fish.
"""

import os
from argparse import Namespace
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import yaml

from bench.swing import Shares, measured, percent
from common.report import DOCS, Options, Report, table
from fishd.config import load
from fishd.lab.other_fish import OtherFish
from fishd.virtual.plant.optimum import best_square_wave

DOCUMENT = "explanation/concepts.md"
FILE = DOCS.parent / "config" / "harsh.yaml"
NAMES = {
    "servo delay": ("plant.servo_delay",),
    "servo dead zone": ("plant.servo_dead_zone",),
    "backlash": ("plant.backlash",),
    "cable slack": ("plant.cable_slack",),
    "servo reaction": ("plant.servo_reaction",),
    "lateral drag": ("plant.lateral_drag",),
    "quadratic drag": ("plant.quadratic_drag", "plant.lateral_quadratic_drag"),
    "noise with heavy tails": ("simulation.noise", "simulation.noise_freedom"),
    "hum": ("simulation.hum", "simulation.hum_frequency"),
    "spikes": ("simulation.spike_rate", "simulation.spike_size"),
    "steps of the ADC": ("simulation.quantum",),
    "turned sensor": ("simulation.rotation",),
    "offsets": ("simulation.offset_x", "simulation.offset_y"),
    "drift": ("simulation.drift", "simulation.drift_walk"),
}
"""Configuration keys of each imperfection."""


def cases(file: Path, amplitude: float) -> list[OtherFish]:
    """Return the cases: none of them, each alone, all of them; amplitude: Φ [rad]"""
    sections = yaml.safe_load(file.read_text(encoding="utf-8"))
    values = {
        f"{section}.{key}": value
        for section in ("plant", "simulation")
        for key, value in sections[section].items()
    }
    named = {key for keys in NAMES.values() for key in keys}
    if named != set(values):
        raise ValueError(f"{file} and NAMES differ by {sorted(named ^ set(values))}")

    def case(name: str, keys: Any) -> OtherFish:
        own = (f"{key}={values[key]!r}" for key in keys)
        return OtherFish(name, (f"amplitude_limit={amplitude}", *own))

    alone = [case(name, keys) for name, keys in NAMES.items()]
    return [case("none", ()), *alone, case("all of them", values)]


OPTIONS: Options = {
    "--jobs": {"type": int, "default": os.cpu_count(), "help": "processes"},
    "--amplitude": {"type": float, "default": 0.42, "help": "Φ [rad]"},
}


def measure(options: Namespace) -> Report:
    """Return one table; takes a minute or two."""
    fish = cases(FILE, options.amplitude)
    with ProcessPoolExecutor(options.jobs) as pool:
        all_shares = list(pool.map(measured, fish))
    rows = [row(case, shares) for case, shares in zip(fish, all_shares, strict=True)]
    head = "imperfection | keys | best square wave, mN | C = 0.6, % | C = auto, %"
    figures = {case.name: shares._asdict() for case, shares in zip(fish, all_shares, strict=True)}
    return Report({"bench harsh": table(head, rows)}, figures)


def row(case: OtherFish, shares: Shares) -> list[str]:
    """Return the row of the table for one case."""
    config = load(None, case.overrides)
    best = best_square_wave(config.plant, config.amplitude_limit)
    own = case.overrides[1:]
    keys = ", ".join(f"`{key.replace('=', ' ')}`" for key in own) if len(own) <= 2 else ""
    thrust = f"{1e3 * best.thrust:.2f}"
    return [case.name, keys, thrust, percent(shares.fixed), percent(shares.auto)]
