"""Numbers of the paper of Fu et al., compared with the tables and equations of fishd.

The tables are those of the figures; docs/explanation/paper.md contains the result of `sections`.
"""

import math
from collections.abc import Callable, Iterator, Set
from typing import Any, NamedTuple

from msgspec.structs import replace
from scipy.optimize import brentq

from common.report import table
from fishd.config import Config
from fishd.controllers.policy import file, library
from fishd.lab.optimum import best_square_waves, fast_servo, saturation_amplitude, slow_servo
from fishd.virtual.plant.optimum import square_wave
from fishd.virtual.plant.parameters import PlantParameters
from paper import figure_2b, figure_3, figure_4, figure_5, figure_6, swing_map
from paper.runs import PLANT, column, read

DOCUMENT = "explanation/paper.md"
HARD_SERVO_LAG = 1e-4
"""Δ that represents a servo without a lag, which turns at Ω until it arrives [rad]."""
PLATEAU = 0.99
"""Fraction of the best thrust from which a frequency counts as equally good."""
SMALL_AMPLITUDE, LARGE_AMPLITUDE = 0.02, 100.0
"""Amplitudes that represent a small and a large Φ, in units of Φ_s."""
NEAR = 0.05
"""Relative difference below which a number agrees with one of the paper."""


class Claim(NamedTuple):
    """Row of the table."""

    paper: str
    computed: str
    agrees: bool | None
    """Whether the numbers agree; None where they cannot be compared."""


def sections() -> list[tuple[str, str, str]]:
    """Return document, name of the markers, and the text between them."""
    return [(DOCUMENT, name, section(name)) for name in SECTIONS]


def section(name: str) -> str:
    """Return the text between the markers of this name."""
    if name == SWIMS:
        return swims()
    words = {True: "yes", False: "**no**", None: "–"}
    return table(
        "the paper | computed here | agrees",
        ((claim.paper, claim.computed, words[claim.agrees]) for claim in GROUPS[name]()),
    )


def equations() -> Iterator[Claim]:
    """Return the claims on the equations, without a tick."""
    p = PLANT
    yield _near("Φ_s = Ω/ω₀ = 0.464 rad", saturation_amplitude(p), 0.464, "{:.3f} rad")
    resonance = p.omega0 / (2.0 * math.pi)
    yield _near(
        "fast servo: best frequency ≈ ω₀/2π = 1.99 Hz",
        float(fast_servo(p, [1.0]).frequency[0]),
        resonance,
        "{:.3f} Hz, the maximum of the closed form",
    )
    peak = p.omega0 * math.sqrt(1.0 - p.xi**2 / 2.0) / (2.0 * math.pi)
    yield _near("resonance of the fin angle ≈ 1.1 Hz", peak, 1.1, "{:.3f} Hz")
    amplitude = LARGE_AMPLITUDE * saturation_amplitude(p)
    best, limit = best_square_waves(p, [amplitude]), slow_servo(p, [amplitude])
    ratio = float(best.frequency[0] / limit.frequency[0])
    yield _near(
        "slow servo: best frequency Ω/4Φ",
        ratio,
        1.0,
        f"{{:.4f}} of it at Φ = {LARGE_AMPLITUDE:g} Φ_s",
    )
    yield _near(
        "slow servo: thrust Kλ²Ω² = 91.8 mN",
        1e3 * float(best.thrust[0]),
        91.8,
        f"{{:.2f}} mN at Φ = {LARGE_AMPLITUDE:g} Φ_s",
    )
    best = best_square_waves(p, [0.42])
    thrust, frequency = float(best.thrust[0]), float(best.frequency[0])
    kept = square_wave(p, 0.42, 1.8).thrust / thrust
    low, high = _plateau(p, 0.42, frequency)
    yield _near(
        "optimum at Φ = 0.42 rad: about 1.8 Hz",
        frequency,
        1.8,
        f"{{:.3f}} Hz, {1e3 * thrust:.2f} mN; 1.8 Hz gives {kept:.1%} of that; "
        f"{PLATEAU:.0%} begins {frequency - low:.3f} Hz below the best and "
        f"{high - frequency:.3f} Hz above, at {low:.3f} and {high:.3f} Hz",
    )
    hard = best_square_waves(replace(p, servo_lag=HARD_SERVO_LAG), [0.42])
    yield _near(
        "… of a hard servo, which turns at Ω until it is there (Δ → 0)",
        float(hard.frequency[0]),
        1.8,
        f"{{:.3f}} Hz, {1e3 * float(hard.thrust[0]):.2f} mN",
    )
    ends = best_square_waves(p, [SMALL_AMPLITUDE * saturation_amplitude(p), 1.57]).frequency
    yield Claim(
        "best frequency falls from 2.5 to 1 Hz over the range of Φ",
        f"from {ends[0]:.2f} Hz (Φ → 0) to {ends[1]:.2f} Hz (Φ = 1.57 rad)",
        _close(float(ends[0]), 2.5) and _close(float(ends[1]), 1.0),
    )
    slow_start, at_once = float(ends[0]), float(fast_servo(p, [1.0]).frequency[0])
    yield Claim(
        "… 2.5 Hz at small Φ",
        f"{slow_start:.3f} Hz; without the servo's lag {at_once:.3f} Hz: the lag is "
        f"{at_once - slow_start:.2f} of the {2.5 - slow_start:.2f} Hz that are missing, "
        f"{2.5 - at_once:.2f} Hz are not explained",
        _close(slow_start, 2.5),
    )


def control() -> Iterator[Claim]:
    """Return the claims on the best command of any shape."""
    cases = read(figure_2b.CASES)
    full = min(column(cases, "share_of_time_at_limit"))
    ratios = column(cases, "thrust_over_best_square")
    side = min(column(cases, "share_of_time_on_side_of_costate"))
    yield Claim(
        "the optimum is bang-bang: a square wave between ±Φ",
        f"in {len(cases)} cases, optimal control has \\|φ_c\\| = Φ in at least {full:.1%} of the "
        f"time, on the side of the costate in at least {side:.1%}",
        full >= 0.98 and side >= 0.98,
    )
    yield Claim(
        "… and so its thrust is that of the best square wave",
        f"{min(ratios):.2%} to {max(ratios):.2%} of it",
        min(ratios) >= 0.995 and max(ratios) <= 1.005,
    )


def waveforms() -> Iterator[Claim]:
    """Return the claims on the loop with three waveforms."""
    for tick in figure_4.TICKS:
        waves = [
            column(read(figure_4.NAME, waveform=wave, tick_s=tick), "thrust_mN")
            for wave in figure_4.WAVES
        ]
        frequencies = column(read(figure_4.NAME, waveform="square", tick_s=tick), "frequency_Hz")
        unlike = [f for f, a, b, c in zip(frequencies, *waves, strict=True) if not a > b > c]
        where = f"{len(frequencies)} frequencies from {frequencies[0]:g} to {frequencies[-1]:g} Hz"
        but = f", but not at {', '.join(f'{f:g}' for f in unlike)} Hz" if unlike else ""
        yield Claim(
            "at Φ = 0.42 rad, square > sine > triangle at every frequency",
            f"ticks of {1e3 * tick:g} ms: at {where}{but}",
            not unlike,
        )
    (best,) = read(figure_3.NAME, source=figure_3.LOOP, amplitude_rad=figure_4.AMPLITUDE)
    yield _near(
        "optimum at Φ = 0.42 rad: about 1.8 Hz",
        best["frequency_Hz"],
        1.8,
        f"ticks of 50 ms: {{:.3f}} Hz, {best['thrust_mN']:.2f} mN, "
        f"{best['relative_thrust']:.1%} of the optimum",
    )


def swinging() -> Iterator[Claim]:
    """Return the claims on swinging control."""
    best = read(figure_5.NAME, C=swing_map.RECOMMENDED)
    everything = read(figure_5.NAME)
    for claim, rows, bound in (
        (swing_map.CLAIMS[0], best, swing_map.NEARLY_BEST),
        (swing_map.CLAIMS[1], everything, swing_map.GOOD),
    ):
        low = min(rows, key=lambda row: row["relative_thrust"])
        missed = [row for row in rows if row["relative_thrust"] <= bound]
        thresholds = {row["C"] for row in rows}
        lacking = _listed({row["C"] for row in missed}, thresholds)
        yield Claim(
            claim,
            f"from {low['relative_thrust']:.1%} up (C = {low['C']:g}, ω₀Φ/Ω = "
            f"{low['w0Phi_over_Omega']:g}); less in {len(missed)} of {len(rows)} cases"
            f"{f', all with {lacking}' if lacking else ''}; "
            f"in continuous time {_in_continuous_time(thresholds, bound)}",
            not missed,
        )
    (weak,) = read(figure_5.INSET, xi=min(figure_5.DAMPINGS), C=0.0)
    yield Claim(
        "ξ → 0, fast servo, C = 0: close to 100 %",
        f"{weak['relative_thrust']:.2%} at ξ = {weak['xi']:g}",
        weak["relative_thrust"] > swing_map.NEARLY_BEST,
    )


def _listed(thresholds: Set[float], choices: Set[float]) -> str:
    """Return several values of C as a list in words; empty for a single value."""
    return ", ".join(f"C = {c:g}" for c in sorted(thresholds)) if len(choices) > 1 else ""


def _in_continuous_time(thresholds: Set[float], bound: float) -> str:
    """Return the results of the reference for these C, and those that miss the bound."""
    shares = {case: s for case, s in swing_map.continuous_time().items() if case[0] in thresholds}
    low = min(shares, key=shares.__getitem__)
    description = f"from {shares[low]:.1%} up (C = {low[0]:g}, ω₀Φ/Ω = {low[1]:g})"
    missed = {c for (c, _), share in shares.items() if share <= bound}
    if not missed:
        return description
    lacking = _listed(missed, thresholds)
    alone = f"only {lacking} misses it, by" if lacking else "less by"
    return f"{description}; {alone} {100 * (bound - shares[low]):.1f} points"


def learning() -> Iterator[Claim]:
    """Return the claims on PPO, with ticks of 50 ms."""
    learned = read(figure_3.NAME, source=figure_3.LEARNT)
    relative_thrusts = column(learned, "relative_thrust")
    full = column(learned, "mean_command_over_limit")
    yield Claim(
        "learning finds the square wave between ±Φ",
        f"mean \\|φ_c\\|/Φ {min(full):.3f} to {max(full):.3f}, thrust {min(relative_thrusts):.1%} "
        f"to {max(relative_thrusts):.1%} of the best square wave, over {len(learned)} amplitudes",
        min(full) > 0.98 and min(relative_thrusts) > swing_map.NEARLY_BEST,
    )
    steps = [_steps(figure_3.policy(amplitude)) for amplitude in figure_3.LEARNED]
    yield Claim(
        "10⁵ control steps, about 2 h",
        f"{min(steps)} to {max(steps)} steps, {min(steps) * Config().tick / 60:.1f} to "
        f"{max(steps) * Config().tick / 60:.1f} min of swimming, for the learned points of "
        f"figure 3; 10⁵ steps are {1e5 * Config().tick / 60:.0f} min",
        None,
    )
    seen = read(figure_3.NAME, source=figure_3.SEEN)
    amplitudes = column(seen, "amplitude_rad")
    forces = [read(figure_3.NAME, source=figure_3.LEARNT, amplitude_rad=a)[0] for a in amplitudes]
    apart = [
        abs(one["frequency_Hz"] - other["frequency_Hz"])
        for one, other in zip(seen, forces, strict=True)
    ]
    ratios = [
        one["thrust_mN"] / other["thrust_mN"] for one, other in zip(seen, forces, strict=True)
    ]
    yield Claim(
        "from images it finds the same square wave as from forces",
        f"frequencies {max(apart):.2f} Hz apart at most, thrust {min(ratios):.1%} to "
        f"{max(ratios):.1%} of that from forces, over {len(seen)} amplitudes",
        max(apart) <= NEAR * max(column(forces, "frequency_Hz")) and min(ratios) > 1.0 - NEAR,
    )


def swimming() -> Iterator[Claim]:
    """Return the claims on the free swimmer, for each reading of the paper that swims the waves."""
    for fish, reading in figure_6.READINGS.items():
        if reading.waves:
            yield from _swimming(fish)


def _swimming(fish: str) -> Iterator[Claim]:
    margins = _margins(fish, figure_6.CELL)
    fine = _margins(fish, figure_6.FINE_CELL)
    text = f"faster than the next wave by {_percentages(margins)}"
    if fine:
        text += f"; on cells of {figure_6.FINE_CELL} mm by {_percentages(fine)}"
    yield Claim(
        f"the square wave is the fastest at every frequency: {fish}",
        text,
        all(value > 0.0 for value in (*margins.values(), *fine.values())),
    )
    waves = [row for wave in figure_6.WAVES for row in _swum(fish, wave)]
    top = max(waves, key=lambda row: row["speed_mm_per_s"])
    (row,) = (row for row in _swum(fish, "swing") if row["setting"] == 0.0)
    share = row["speed_mm_per_s"] / top["speed_mm_per_s"]
    yield Claim(
        f"swing with C = 0 is close to the maximum: {fish}",
        f"{share:.1%} of the fastest wave, the {top['controller']} wave of {top['setting']:g} Hz",
        share > swing_map.NEARLY_BEST,
    )
    swings = [0.5 * row["tail_side_to_side_over_L"] for row in waves]
    yield Claim(
        f"tail amplitude of about 0.2 L: {fish}",
        f"{min(swings):.2f} to {max(swings):.2f} L to either side while it swims; the muscles "
        "alone bend it by 0.21 L",
        None,
    )


def _margins(fish: str, cell: float) -> dict[float, float]:
    """Return how much faster the square wave is, as a fraction, by frequency [Hz]."""
    margins = {each: figure_6.margin(fish, each, cell) for each in figure_6.FREQUENCIES}
    return {each: value for each, value in margins.items() if value is not None}


def _percentages(margins: dict[float, float]) -> str:
    values = ", ".join(f"{100.0 * value:+.0f}" for value in margins.values())
    return f"{values} % at {', '.join(f'{each:g}' for each in margins)} Hz"


def swims() -> str:
    """Return the table of the swings, a row for each reading and C, beside the best square wave."""
    rows = []
    for fish in figure_6.READINGS:
        best = max(_swum(_wave_fish(fish), "square"), key=lambda row: row["speed_mm_per_s"])
        square = f"{_speed(best)} at {best['setting']:g} Hz"
        for row in _swum(fish, "swing"):
            share = row["speed_mm_per_s"] / best["speed_mm_per_s"]
            swing = f"{_speed(row)} at {row['frequency_Hz']:.2f} Hz"
            rows.append((fish, square, f"{row['setting']:g}", swing, f"{share:.1%}"))
    return table("reading | best square wave (mm/s) | C | swing (mm/s) | share", rows)


def _wave_fish(fish: str) -> str:
    """Return the reading with the waves of this body."""
    return fish if figure_6.READINGS[fish].waves else "damped"


def _speed(row: dict[str, Any]) -> str:
    """Return speed ± averaging, and ± grid where that is known."""
    text = f"{row['speed_mm_per_s']:.1f} ± {row['ci95_mm_per_s']:.1f}"
    error = figure_6.Case(*(row[key] for key in figure_6.KEYS)).grid_error()
    return text if error is None else f"{text} ± {error:.0f}"


def _swum(fish: str, controller: str) -> list[dict[str, Any]]:
    having = {"fish": fish, "controller": controller, "cell_mm": figure_6.CELL, "start": 1.0}
    return read(figure_6.NAME, **having)


def _steps(policy: str) -> int:
    """Return the length of a policy's training [control steps]."""
    return file.read(library.find(policy)).card.provenance.steps


def _plateau(p: PlantParameters, amplitude: float, best: float) -> list[float]:
    """Return the two frequencies at which a square wave has `PLATEAU` of the best thrust [Hz]."""
    wanted = PLATEAU * square_wave(p, amplitude, best).thrust

    def excess(frequency: float) -> float:
        return square_wave(p, amplitude, frequency).thrust - wanted

    return [float(brentq(excess, best, share * best)) for share in (0.5, 1.5)]


def _near(paper: str, value: float, stated: float, text: str) -> Claim:
    return Claim(paper, text.format(value), _close(value, stated))


def _close(value: float, stated: float) -> bool:
    return abs(value - stated) <= NEAR * abs(stated)


GROUPS: dict[str, Callable[[], Iterator[Claim]]] = {
    "equations": equations,
    "optimal control": control,
    "waveforms": waveforms,
    "swinging control": swinging,
    "learning": learning,
    "free swimming": swimming,
}
SWIMS = "swings of the free swimmer"
SECTIONS = (*GROUPS, SWIMS)
