"""The thrust of a controller with its interval: the fish swims and rests in turn."""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import groupby, pairwise
from typing import Any, NamedTuple

import numpy as np
from msgspec import UNSET, Struct

from fishd.control.estimators.live_thrust import PIECE_S, REST_SETTLE_TIME_S, SWIM_SETTLE_TIME_S
from fishd.core.beats import upward_reversals
from fishd.core.errors import ParameterError
from fishd.core.signals import Tick
from fishd.lab import error_budget
from fishd.lab.disturbances import RESPONSE_TIMES_S, Disturbance
from fishd.lab.drift import LEAST_BLOCKS, Array, Blocks, fit
from fishd.lab.session import Session, refuse_lost
from fishd.lab.statistics import Z95, per_watt

SWIM, REST = 6.0, 2.75
"""How long the fish swims and rests in turn, on average [s]."""
SHORT_SWIM, SHORT_REST = 4.5, 2.25
"""The shortest of these [s]."""
GOLDEN_RATIO = (math.sqrt(5.0) - 1.0) / 2.0
"""Multiples of the golden ratio, less their whole part, are spread evenly and never recur."""
UNSTEADY, RESTLESS = 0.05, 0.01
"""The power of the fin may change by this share in a swim, and be this share of it at rest."""
LONGEST = 3600.0
"""The longest measurement [s]."""
LONGER = "measure again with a longer --settle"
DISTURBED = "the zero of F_x was disturbed too often for the interval to be trusted; measure again"
"""What is said of a measurement that may be wrong."""
MOST_BLOCKS = 200
"""Beats and pieces of a rest are taken together until there are no more blocks than this."""
FEW_STEPS = 3
"""From fewer beat to beat nobody knows how beats differ."""
UNUSUAL = 20.0
"""Squares of differences beyond so many times their median do not count: 3 standard deviations."""
SHORT_BEAT = 0.4
"""Beats are taken together until they last so long [s]."""


class Sample(NamedTuple):
    """What a measurement needs to know of a tick."""

    seq: int
    """Number of the tick."""
    fx: float
    """Mean F_x since the tick before [N]."""
    fin_velocity: float
    phi_c: float
    """Instruction angle from this tick on [rad]."""
    swims: bool
    """Is the fish told to swim?"""
    watts: float = math.nan
    """Mean electrical power of the servo since the tick before [W]; NaN where it is not known."""


class Measured(NamedTuple):
    """What a controller does on a rig, and what it was found from."""

    controller: str
    parameters: Mapping[str, Any]
    thrust: float
    """[N]"""
    error: float
    """Half of its 95 % interval [N]."""
    frequency: float
    """Tail beats per second; 0 where the tail does not beat [Hz]."""
    power: float
    """Mean square of `fin_velocity` while it swims, in the square of that quantity's unit."""
    swims: int
    """How often it swam."""
    blocks: Blocks
    """The force in blocks; of time since the first tick."""
    drift: Array
    """The force without swimming, block by block [N]."""
    ticks: Sequence[Tick]
    """Every tick, in order."""
    unit: str
    """Of all forces: `N`; that of the sensor where it is not calibrated."""
    remark: str
    """Why the thrust may be wrong by more than its error; empty where nothing speaks for that."""
    watts: float | None = None
    """Electrical power of the servo while it swims [W]; None where it is not known."""
    watts_error: float | None = None
    """Half of its 95 % interval, by how beats differ [W]."""
    steps: Sequence["Step"] = ()
    """How each beat differed from the one before it."""
    calibration_ci95: float | None = 0.0
    """Half-width of the 95 % interval that the calibration of the sensor leaves to the thrust [N].

    None where its uncertainty is unknown.
    """
    total_ci95: float | None = None
    """Half-width of the 95 % interval by `error` and `calibration_ci95` together [N]."""
    rotation: float = 0.0
    """Rotation of the sensor's axes that is left after calibration; 0 where none is seen [rad]."""
    lateral: float = 0.0
    """Mean F_y that swimming adds [N]."""
    disturbances: Sequence[Disturbance] = ()
    """Disturbances of the zero that the fit found and accounted for."""


class Step(NamedTuple):
    """How two neighbouring beats of a swim, or pieces of a rest, differ.

    Squares of the differences; their means are the variances of the mean of a second.
    """

    force: float
    """[N² s]"""
    watts: float
    """[W² s]"""


def measure(
    session: Session,
    controller: str,
    parameters: Mapping[str, Any],
    seconds: float = 60.0,
    settle: float = SWIM_SETTLE_TIME_S,
) -> Measured:
    """Swim and rest a controller in turn for `seconds`, and return its thrust.

    The rests separate the drift of the sensor: see `fishd.lab.drift`.
    settle: how long the fin takes until it swims steadily, or hangs still as before [s]

    Raises `ParameterError` for a time that is too short, `Disturbed` (also where many ticks were
    lost on their way), and what `Session.swim` raises.
    """
    ticks: list[Tick] = []
    phases = plan(seconds, parameters, settle)
    for swims, length in phases:
        ticks += session.swim(controller, parameters, length) if swims else session.rest(length)
    refuse_lost(ticks, (length for _, length in phases), session.tick)
    samples = samples_of(ticks)
    found = evaluate(samples, session.tick, settle, _still(settle))
    if not found.frequency and len({each.phi_c for each in samples if each.swims}) > 1:
        raise ParameterError("no whole beat is left of a swim; a longer --settle lengthens swims")
    rotation = error_budget.visible_rotation(ticks)
    lateral = error_budget.lateral_force(ticks)
    budget = error_budget.budget(session.calibration, found.thrust, found.error, lateral, rotation)
    return found._replace(
        controller=controller,
        parameters=dict(parameters),
        ticks=ticks,
        unit=session.unit,
        rotation=rotation,
        lateral=lateral,
        **budget._asdict(),
    )


def samples_of(ticks: Iterable[Tick]) -> list[Sample]:
    """What a measurement needs to know of these.

    One whose force is not to be believed counts as lost, and with it its beat.
    """
    return [
        Sample(
            each.seq,
            each.fx,
            each.fin_velocity,
            each.phi_c,
            each.mode == "running",
            math.nan if each.power is UNSET else each.power,
        )
        for each in ticks
        if each.suspect is UNSET
    ]


class Summary(Struct, frozen=True):
    """A measurement without what it was found from."""

    controller: str
    parameters: dict[str, Any]
    thrust: float
    """[N]"""
    error: float
    """Half of its 95 % interval [N]."""
    frequency: float
    """[Hz]"""
    factor: float
    """Thrust over the mean square of `fin_velocity`."""
    swims: int
    seconds: float
    """How long it took, rests included [s]."""
    force_unit: str
    remark: str
    power: float | None = None
    """Electrical power of the servo while it swims [W]; null where it is not known."""
    power_error: float | None = None
    """Half of its 95 % interval [W]."""
    thrust_per_watt: float | None = None
    """[N/W]"""
    thrust_per_watt_error: float | None = None
    """Half of its 95 % interval [N/W]."""
    calibration_ci95: float | None = None
    """Half-width of the 95 % interval that the calibration leaves to the thrust [N].

    null where its uncertainty is unknown.
    """
    total_ci95: float | None = None
    """Half-width of the 95 % interval by `error` and `calibration_ci95` together [N]."""
    rotation: float = 0.0
    """Rotation of the sensor's axes that is left after calibration; 0 where none is seen [rad]."""
    thrust_per_watt_total_ci95: float | None = None
    """As `total_ci95`, of the thrust for each watt [N/W]."""
    disturbances: Sequence[Disturbance] = ()
    """Disturbances of the zero that the fit found and accounted for."""


def summary(found: Measured, tick: float) -> Summary:
    """What fits in a line, or in JSON; tick: period of the loop [s]."""
    ratio, ratio_error = per_watt(found.thrust, found.error, found.watts, found.watts_error)
    return Summary(
        found.controller,
        dict(found.parameters),
        found.thrust,
        found.error,
        found.frequency,
        found.thrust / found.power if found.power else 0.0,
        found.swims,
        len(found.ticks) * tick,
        found.unit,
        found.remark,
        found.watts,
        found.watts_error,
        ratio,
        ratio_error,
        found.calibration_ci95,
        found.total_ci95,
        found.rotation,
        per_watt(found.thrust, found.total_ci95, found.watts, found.watts_error)[1],
        list(found.disturbances),
    )


def plan(
    seconds: float, parameters: Mapping[str, Any], settle: float = SWIM_SETTLE_TIME_S
) -> list[tuple[bool, float]]:
    """When to swim (True) and to rest, and for how long each [s]; `seconds` in all.

    A slow beat makes a swim longer, a long time to settle both.
    Raises `ParameterError` where two swims do not fit.
    """
    frequency = parameters.get("frequency")
    slow = 3.0 / frequency if isinstance(frequency, int | float) and frequency > 0.0 else 0.0
    swim = settle + max(SWIM - SWIM_SETTLE_TIME_S, slow)
    rest = _still(settle) + REST - REST_SETTLE_TIME_S
    if not 2 * swim + 3 * rest <= seconds <= LONGEST:  # NaN is not
        raise ParameterError(
            f"a measurement of {seconds:g} s is not possible: two swims of {swim:.3g} s between "
            f"three rests of {rest:.3g} s need {2 * swim + 3 * rest:.4g} s, and {LONGEST:g} s are "
            "the most"
        )
    count = math.floor((seconds - rest) / (swim + rest) + 1e-9)
    least = rest - REST + SHORT_REST, settle + max(SHORT_SWIM - SWIM_SETTLE_TIME_S, slow)
    shares = [((GOLDEN_RATIO * (index + 1) / 2) % 1.0) ** 2 for index in range(2 * count + 1)]
    spare = (seconds - count * sum(least) - least[False]) / sum(shares)
    return [
        (bool(index % 2), least[index % 2] + spare * share) for index, share in enumerate(shares)
    ]


def _still(settle: float) -> float:
    """When the fin of a fish that takes so long to swim steadily hangs still [s]."""
    return REST_SETTLE_TIME_S + max(0.0, settle - SWIM_SETTLE_TIME_S)


def evaluate(
    samples: Sequence[Sample],
    tick: float,
    settles: float = SWIM_SETTLE_TIME_S,
    stills: float = REST_SETTLE_TIME_S,
    alike: Sequence[Step] = (),
) -> Measured:
    """The thrust of a fish that swam and rested in turn; names no controller, and has no ticks.

    A tail that does not beat is judged by pieces of its swims, as of its rests.

    tick: period of the loop [s]
    settles, stills: when a swim is steady, and a rest is still [s]
    alike: how beats of other swims on this rig differed; counts where there are few beats here
    Raises `ParameterError` where there is too little to tell it from a drift.
    """
    first = samples[0].seq
    phases = list(_phases(samples))
    kept = [
        list(_blocks(phase, tick, first, settles if phase[0].swims else stills)) for phase in phases
    ]
    found = [block for blocks in _together(kept) for block in blocks]
    swimming = [block for block in found if block.swims]
    if len(found) < LEAST_BLOCKS or len({block.swims for block in found}) < 2:
        raise ParameterError(
            f"too little is left of {len(samples) * tick:.3g} s to measure a thrust: whole beats "
            "between rests are needed"
        )
    time, force = np.array([(block.time, block.force) for block in found]).T
    swims = np.array([block.swims for block in found])
    lasts = np.array([block.lasts for block in found])
    apart = [block for blocks in kept for block in blocks]
    steps, still = list(_steps(apart, True)), list(_steps(apart, False))
    known = steps if len(steps) >= FEW_STEPS else [*steps, *alike]
    beats, rests = _spread(known if len(known) >= FEW_STEPS else [*known, *still]), _spread(still)
    spread = np.where(swims, beats.force, rests.force)
    blocks = Blocks(
        time, force, spread / lasts, swims, _responses(phases, time, tick, first, settles)
    )
    result = fit(blocks)
    lasting = sum(block.lasts for block in swimming)
    return Measured(
        controller="",
        parameters={},
        thrust=result.force,
        error=result.error,
        frequency=sum(block.beats for block in swimming) / lasting,
        power=sum(block.power * block.lasts for block in swimming) / lasting,
        swims=sum(phase[0].swims for phase in phases),
        blocks=blocks,
        drift=result.drift,
        ticks=[],
        unit="N",
        remark=_remark(kept) or (DISTURBED if result.is_disturbed else ""),
        steps=steps,
        disturbances=result.disturbances,
        **_watts(swimming, beats.watts),
    )


def _responses(
    phases: Sequence[Sequence[Sample]], time: Array, tick: float, first: int, settles: float
) -> Array:
    """Return first-order responses to swimming, which begin at 0, at these times; n×k.

    There is one for each of `RESPONSE_TIMES_S` that is twice as long as a swim takes to settle:
    faster ones cannot be told from thrust. With a single swim, none can.

    first: index that time is counted from
    """
    several = sum(phase[0].swims for phase in phases) > 1
    constants = np.array([each for each in RESPONSE_TIMES_S if several and each >= 2.0 * settles])
    begins = [(phase[0].seq - first) * tick for phase in phases]
    responses, level = np.empty((len(time), len(constants))), np.zeros(len(constants))
    for phase, begin, end in zip(phases, begins, [*begins[1:], math.inf], strict=True):
        inside = (time >= begin) & (time < end)
        gap = level - phase[0].swims
        fading = np.exp(-(time[inside, np.newaxis] - begin) / constants)
        responses[inside] = phase[0].swims + gap * fading
        level = phase[0].swims + gap * np.exp(-(end - begin) / constants)
    return responses


def block_of(phase: Sequence[Sample], tick: float, settles: float) -> "Block | None":
    """The whole beats of one swim, or the pieces of one rest, once it has settled, in one block.

    tick: period of the loop [s]
    settles: when it has [s]
    None where nothing is left.
    """
    found = list(_blocks(phase, tick, 0, settles))
    return _joined(found) if found else None


def _watts(swimming: Sequence["Block"], spread: float) -> dict[str, float]:
    """The power of these blocks and its error; nothing where it is not known of each.

    spread: variance of the power of a second [W² s]
    """
    lasting = sum(block.lasts for block in swimming)
    mean = sum(block.watts * block.lasts for block in swimming) / lasting
    if not math.isfinite(mean):
        return {}
    return {"watts": mean, "watts_error": Z95 * math.sqrt(spread / lasting)}


def _together(kept: Sequence[list["Block"]]) -> list[list["Block"]]:
    """The same in longer blocks, each within its swim or rest, where there are too many."""
    each = math.ceil(sum(map(len, kept)) / MOST_BLOCKS)
    return [
        [_joined(blocks[begin : begin + each]) for begin in range(0, len(blocks), each)]
        for blocks in kept
    ]


def _joined(blocks: Sequence["Block"]) -> "Block":
    if len(blocks) == 1:
        return blocks[0]
    lasts = np.array([block.lasts for block in blocks])
    time, force, power, watts = np.average(
        [(block.time, block.force, block.power, block.watts) for block in blocks],
        axis=0,
        weights=lasts,
    ).tolist()
    beats = sum(block.beats for block in blocks)
    return Block(time, float(lasts.sum()), force, power, beats, blocks[0].swims, watts)


def _remark(kept: Sequence[Sequence["Block"]]) -> str:
    """What speaks against a measurement, of the blocks of each swim and rest."""
    swims = [blocks for blocks in kept if len(blocks) > 1 and blocks[0].swims]
    rests = [block.power for blocks in kept[1:] for block in blocks if not block.swims]
    begins = sum(block.power for blocks in swims for block in blocks[: len(blocks) // 2])
    ends = sum(block.power for blocks in swims for block in blocks[-(len(blocks) // 2) :])
    if begins and abs(ends / begins - 1.0) > UNSTEADY:
        change = ends / begins - 1.0
        return f"the fin was not steady: its power changed by {change:+.0%} in a swim; {LONGER}"
    count = sum(len(blocks) // 2 for blocks in swims)
    if begins and rests and np.mean(rests) > RESTLESS * begins / count:
        share = np.mean(rests) * count / begins
        return f"the fin did not rest: it had {share:.0%} of its power left; {LONGER}"
    return ""


class Block(NamedTuple):
    """Some whole beats of a swim, or a piece of a rest."""

    time: float
    """Of its middle [s]."""
    lasts: float
    """[s]"""
    force: float
    """Mean F_x in it [N]."""
    power: float
    """Mean square of `fin_velocity`, in the square of that quantity's unit."""
    beats: float
    swims: bool
    """Did the fish swim? It rested where not."""
    watts: float
    """Mean electrical power of the servo [W]; NaN where it is not known."""


def _phases(samples: Sequence[Sample]) -> Iterator[list[Sample]]:
    """Each swim and each rest."""
    for _, phase in groupby(samples, lambda sample: sample.swims):
        yield list(phase)


def _blocks(phase: Sequence[Sample], tick: float, first: int, settles: float) -> Iterator[Block]:
    """Whole beats of a swim, or pieces of a rest, once it has settled.

    first: index that time is counted from
    settles: when it has [s]
    """
    swims = phase[0].swims
    begin = round(settles / tick)
    ups = upward_reversals(each.phi_c for each in phase) if swims else []
    cuts = [up for up in ups if up >= begin]
    beating = len(cuts) > 1
    if not beating:
        cuts = list(range(begin, len(phase), max(1, round(PIECE_S / tick))))
    begun, beats = 0, 0
    for index in range(1, len(cuts)):
        beats += 1
        start, end = cuts[begun], cuts[index]
        if (end - start) * tick < SHORT_BEAT - 1e-9 * tick:
            continue
        # A force is that of the window before its tick, an angle that of the one after it.
        window = phase[start + 1 : end + 1]
        counted, beats, begun = beats, 0, index
        if phase[end].seq - phase[start].seq != len(window):  # a tick was lost: no whole beats
            continue
        yield Block(
            time=(0.5 * (phase[start].seq + phase[end].seq) - first) * tick,
            lasts=len(window) * tick,
            force=sum(each.fx for each in window) / len(window),
            power=sum(each.fin_velocity**2 for each in window) / len(window),
            beats=counted if beating else 0,
            swims=swims,
            watts=sum(each.watts for each in window) / len(window),
        )


def _steps(found: Sequence[Block], swims: bool) -> Iterator[Step]:
    """Between neighbours, so that hardly any drift is in them."""
    for one, other in pairwise(found):
        if one.swims == other.swims == swims and other.time - one.time < 2.0 * one.lasts:
            share = 1.0 / (1.0 / one.lasts + 1.0 / other.lasts)
            yield Step(
                (other.force - one.force) ** 2 * share, (other.watts - one.watts) ** 2 * share
            )


def _spread(steps: Sequence[Step]) -> Step:
    """Their means without those far off; next to nothing where there are none."""
    force, watts = (map(_usual_mean, zip(*steps, strict=True))) if steps else (0.0, 0.0)
    return Step(max(force, 1e-12), max(watts, 1e-12))


def _usual_mean(squares: Sequence[float]) -> float:
    """Return the mean of these, without those that a disturbance of the force has made."""
    largest = UNUSUAL * float(np.median(squares))
    usual = [square for square in squares if not square > largest]  # NaN stays
    return sum(usual) / len(usual)
