"""Faults of a film that begin when the tail has been learned and measured for a while."""

from collections.abc import Callable
from copy import deepcopy
from dataclasses import replace
from functools import cache, partial
from typing import NamedTuple

import numpy as np

from fishd.camera.tail.meter import TailMeter
from rigs.filmed_tail import Film, FilmedTail, Knock, Thing, sine
from rigs.measured_tail import CASES, WEB, learn

LEARNED_S, BEGIN_S, END_S = 5.0, 6.0, 10.0
"""Times to which a film is learned, from which it has a fault, and at which it ends [s]."""
WRONG_RAD = 0.05
"""Error of a fin angle that is wrong [rad]."""
FILMS = {
    "still water": CASES["plain"],
    "rough water": CASES[WEB],
    "rough water, body not in view": replace(CASES[WEB], root=(0.0, 0.0), length=0.65),
}
MOVED = "the zero has moved", "the camera has moved"
Change = Callable[[Film, np.random.Generator], Film]


def _knock(angle: float, film: Film, random: np.random.Generator) -> Film:
    return replace(film, knock=Knock(BEGIN_S, float(random.choice([-1, 1])) * angle))


def _turn_mount(film: Film, random: np.random.Generator) -> Film:
    return replace(film, yaw=float(random.choice([-1, 1]) * random.uniform(0.05, 0.15)))


def _shift(film: Film, random: np.random.Generator) -> Film:
    shift = random.uniform(-0.04, 0.04, 2)
    return replace(film, knock=Knock(BEGIN_S, shift=(float(shift[0]), float(shift[1]))))


def _zoom(film: Film, random: np.random.Generator) -> Film:
    zoom = float(random.choice([random.uniform(0.85, 0.97), random.uniform(1.03, 1.15)]))
    return replace(film, knock=Knock(BEGIN_S, zoom=zoom))


def _thing(
    axes: tuple[float, float], speed: float, film: Film, random: np.random.Generator,
    level: float | None = None,
) -> Film:  # fmt: skip
    """Return the film with an ellipse that passes through the sweep of the fin."""
    direction, turn = random.uniform(0.0, 6.28, 2)
    velocity = speed * random.uniform(0.3, 1.0) * np.array([np.cos(direction), np.sin(direction)])
    place = np.array([random.uniform(0.35, 0.8), random.uniform(-0.2, 0.2)])
    start = place - velocity * random.uniform(BEGIN_S, END_S)
    thing = Thing(tuple(start), tuple(velocity), axes, turn, level)  # type: ignore[arg-type]
    return replace(film, things=(thing,))


def _shine(film: Film, random: np.random.Generator) -> Film:
    """Return the film with a lamp that is mirrored in the sweep of the fin."""
    x, slope = random.uniform(0.4, 0.75), random.uniform(-0.3, 0.3)
    y = 0.5 * film.height / film.width + slope * (x - film.root[0])
    return replace(film, glare=(float(x), float(y), float(random.uniform(0.01, 0.05))))


def _repeat(film: Film, random: np.random.Generator) -> Film:
    begin = BEGIN_S + random.uniform(0.3, 0.8)
    return replace(film, repeated=(float(begin), float(begin + random.choice([0.08, 0.3, 3.0]))))


def _swing_out(film: Film, random: np.random.Generator) -> Film:
    return replace(film, motion=sine(float(random.uniform(0.9, 1.2))))


def _tear(film: Film, random: np.random.Generator) -> Film:
    return replace(film, torn=float(random.uniform(0.08, 0.4)))


FAULTS: dict[str, Change] = {
    "none": lambda film, _: film,
    **{f"knock by {mrad} mrad": partial(_knock, mrad / 1000) for mrad in (5, 20, 50, 100)},
    "turned mount": _turn_mount,
    "shifted camera": _shift,
    "zoomed camera": _zoom,
    "hand": partial(_thing, (0.25, 0.12), 0.3),
    "second fish": partial(_thing, (0.12, 0.025), 0.3),
    "leaf on the surface": partial(_thing, (0.04, 0.025), 0.02),
    "light leaf": partial(_thing, (0.04, 0.025), 0.02, level=230.0),
    "bubbles": lambda film, random: replace(film, bubbles=int(random.integers(10, 60))),
    "mirrored lamp": _shine,
    "flickering lamp": lambda film, _: replace(film, flicker=0.3, read_out=0.02),
    "light dimmed by half": lambda film, _: replace(film, brightness=0.5),
    "longer exposure": lambda film, _: replace(film, brightness=1.35, exposure=0.03),
    "repeated pictures": _repeat,
    "tail leaves the picture": _swing_out,
    "torn fin": _tear,
}  # fmt: skip


class Outcome(NamedTuple):
    """Readings of a film after a fault has begun."""

    known: float
    """Fraction whose fin angle is known."""
    wrong: float
    """Fraction that is known, but off by `WRONG_RAD` or more."""
    told_s: float
    """Time from the fault to the first reading that says that something has moved [s]."""


@cache
def _measure_until_fault(film: Film) -> TailMeter:
    meter = TailMeter(learn(film))
    for shot in FilmedTail(film).shots(LEARNED_S, BEGIN_S):
        meter.read(shot.time, shot.picture, film.read_out)
    return meter


def fail(film: Film, fault: str, seed: int, until: float = END_S) -> Outcome:
    """Return the outcome of a fault in a film, whose details are random, until a time [s]."""
    random = np.random.default_rng([seed, list(FAULTS).index(fault)])
    faulty = FAULTS[fault](film, random)
    meter = deepcopy(_measure_until_fault(film))
    readings = [
        meter.read(shot.time, shot.picture, faulty.read_out)
        for shot in FilmedTail(faulty).shots(BEGIN_S, until)
    ]
    known = [reading for reading in readings if reading.alpha is not None]
    truth = faulty.motion(np.array([reading.time for reading in known]))
    wrong = [abs((r.alpha or 0.0) - t) >= WRONG_RAD for r, t in zip(known, truth, strict=True)]
    moved = [reading.time for reading in readings if reading.reason.startswith(MOVED)]
    return Outcome(
        len(known) / len(readings),
        sum(wrong) / len(readings),
        min(moved, default=np.inf) - BEGIN_S,
    )
