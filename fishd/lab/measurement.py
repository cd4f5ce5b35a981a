"""Measurement of the thrust of a controller, with its interval, by swimming and resting in turn."""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from itertools import groupby, pairwise
from typing import Any, NamedTuple

import numpy as np
from msgspec import UNSET, field
from msgspec.structs import replace

from fishd.core.beats import upward_reversals
from fishd.core.errors import ParameterError
from fishd.core.estimation import PIECE_S, REST_SETTLE_TIME_S, SWIM_SETTLE_TIME_S
from fishd.core.signals import Tick, reading_of
from fishd.core.swim_plan import plan, rest_settle_time
from fishd.lab.disturbances import RESPONSE_TIMES_S, Disturbance
from fishd.lab.drift import MIN_FIT_BLOCKS, Array, Blocks, fit
from fishd.lab.error_budget import Thrust, lateral_force, thrust_fields, visible_rotation
from fishd.lab.session import Session, refuse_lost
from fishd.lab.statistics import Z95

MAX_POWER_CHANGE, MAX_REST_POWER = 0.05, 0.01
"""Largest change of the fin's power within a swim, and largest decay of it within a rest, as
fractions."""
SETTLE_REMEDY = "measure again with a longer --settle"
DISTURBED_REMARK = (
    "the zero of F_x was disturbed too often for the interval to be trusted; measure again"
)
"""Remark on a measurement with as many disturbances as a fit can have."""
MAX_BLOCKS = 200
"""Largest number of blocks; with more of them, neighbouring blocks are merged."""
MIN_STEPS = 3
"""Smallest number of steps from beat to beat that gives the variance of a beat."""
MAX_SQUARE_OVER_MEDIAN = 20.0
"""Largest squared step that counts, over the median square: about 3 standard deviations."""
MIN_BLOCK_S = 0.4
"""Length of the shortest block of a swim; shorter beats are merged [s]."""


class Sample(NamedTuple):
    """The quantities of a tick that a measurement uses."""

    seq: int
    """Number of the tick."""
    fx: float
    """Mean F_x since the tick before [N]."""
    fin_velocity: float
    phi_c: float
    """Instruction angle from this tick on [rad]."""
    swims: bool
    """Whether a controller drives the fish."""
    watts: float = math.nan
    """Mean electrical power of the servo since the tick before [W]; NaN where unknown."""


class Summary(Thrust, frozen=True, kw_only=True):
    """The thrust of a controller on a rig, as a result."""

    controller: str = ""
    parameters: dict[str, Any] = field(default_factory=dict)
    thrust_ci95: float
    frequency: float
    """Frequency of the tail beat [Hz]; 0 where the tail does not beat."""
    factor: float
    """Thrust over the mean square of `fin_velocity`."""
    factor_ci95: float
    """Half-width of the 95 % confidence interval of `factor`, by that of the thrust."""
    swims: int
    """Number of swims."""
    seconds: float = 0.0
    """Length of the measurement, rests included [s]."""
    force_unit: str = "N"
    """Unit of all forces: `N`, or that of the sensor where it is not calibrated."""
    remark: str = ""
    """Reason why the thrust may be wrong by more than its error; empty where there is none."""
    disturbances: Sequence[Disturbance] = ()
    """Disturbances of the zero that the fit contains."""


class ThrustMeasurement(Summary, frozen=True, kw_only=True):
    """The thrust of a controller on a rig, with the data that it was computed from."""

    blocks: Blocks
    """Means of the force in blocks, with times since the first tick."""
    drift: Array
    """Force that each block would have without swimming [N]."""
    ticks: Sequence[Tick] = ()
    """Every tick, in order."""
    steps: Sequence["Step"] = ()
    """Differences between neighbouring beats."""
    lateral: float = 0.0
    """Mean F_y that swimming adds [N]."""

    def summary(self) -> Summary:
        """Return the result without the data."""
        return Summary(**{name: getattr(self, name) for name in Summary.__struct_fields__})


class Step(NamedTuple):
    """Squared differences between two neighbouring beats of a swim, or pieces of a rest.

    Their means over many steps are the variances of the mean over one second.
    """

    force: float
    """Squared difference of the force [N² s]."""
    watts: float
    """Squared difference of the power [W² s]."""


def measure(
    session: Session,
    controller: str,
    parameters: Mapping[str, Any],
    seconds: float = 60.0,
    settle: float = SWIM_SETTLE_TIME_S,
    heard: Callable[[Thrust, int], None] | None = None,
) -> ThrustMeasurement:
    """Swim a controller and rest in turn for `seconds`, and return its thrust.

    The rests separate the drift of the sensor: see `fishd.lab.drift`.
    settle: time the fin needs to swim steadily, or to hang still again [s]
    heard: called in each rest with the thrust until then, and the number of swims

    Raises `ParameterError` for a time that is too short, `Disturbed` (also where too many ticks
    were lost on the way from fishd), and the errors of `Session.swim`.
    """
    ticks: list[Tick] = []
    phases = plan(seconds, parameters, settle)
    for index, (swims, length) in enumerate(phases):
        ticks += session.swim(controller, parameters, length) if swims else session.rest(length)
        if heard and index and not swims and index < len(phases) - 1:
            with suppress(ParameterError):  # one swim may be too little
                heard(_evaluate_ticks(session, ticks, settle), (index + 1) // 2)
    refuse_lost(ticks, (length for _, length in phases), session.tick)
    measurement, samples = _evaluate_ticks(session, ticks, settle), to_samples(ticks)
    if not measurement.frequency and len({sample.phi_c for sample in samples if sample.swims}) > 1:
        raise ParameterError(
            "no whole beat is left of a swim; lengthen the swims with a longer --settle"
        )
    fields: dict[str, Any] = {}
    if session.fin_angles and measurement.frequency:  # noise of a resting fin is not a beat
        fields = session.fin_angles.find_maximum(ticks, settle)
    return replace(
        measurement,
        **fields,
        controller=controller,
        parameters=dict(parameters),
        ticks=ticks,
        seconds=len(ticks) * session.tick,
        force_unit=session.unit,
    )


def _evaluate_ticks(session: Session, ticks: Sequence[Tick], settle: float) -> ThrustMeasurement:
    """Return the thrust with its error budget, without controller and fin angle."""
    settles = settle, rest_settle_time(settle)
    measurement = evaluate(to_samples(ticks), session.tick, *settles)
    rotation, lateral = visible_rotation(ticks), lateral_force(ticks)
    fields = thrust_fields(
        session.calibration,
        measurement.thrust,
        measurement.thrust_ci95,
        measurement.power,
        measurement.power_ci95,
        lateral=lateral,
        rotation=rotation,
    )
    return replace(measurement, **fields, lateral=lateral)


def to_samples(ticks: Iterable[Tick]) -> list[Sample]:
    """Return the samples of a measurement from its ticks.

    A tick whose force is suspect counts as lost, and with it its beat.
    """
    return [
        Sample(
            tick.seq,
            tick.fx,
            tick.fin_velocity,
            tick.phi_c,
            tick.mode == "running",
            reading_of(tick.readings, "power"),
        )
        for tick in ticks
        if tick.suspect is UNSET
    ]


def evaluate(
    samples: Sequence[Sample],
    tick: float,
    swim_settle: float = SWIM_SETTLE_TIME_S,
    rest_settle: float = REST_SETTLE_TIME_S,
    other_steps: Sequence[Step] = (),
) -> ThrustMeasurement:
    """Return the thrust of a fish that swam and rested in turn, without controller and ticks.

    Where the tail does not beat, swims are cut into pieces, as rests are.

    tick: period of the loop [s]
    swim_settle, rest_settle: time until a swim is steady, and until a rest is still [s]
    other_steps: steps between beats of other swims on this rig, used where there are few beats here
    Raises `ParameterError` where the samples are too few to separate thrust from drift.
    """
    first = samples[0].seq
    phases = list(_split_phases(samples))
    blocks_of_phases = [
        list(_cut_blocks(phase, tick, first, swim_settle if phase[0].swims else rest_settle))
        for phase in phases
    ]
    merged_blocks = [block for blocks in _merge_blocks(blocks_of_phases) for block in blocks]
    swimming = [block for block in merged_blocks if block.swims]
    if len(merged_blocks) < MIN_FIT_BLOCKS or len({block.swims for block in merged_blocks}) < 2:
        raise ParameterError(
            f"too little is left of {len(samples) * tick:.3g} s to measure a thrust: whole beats "
            "between rests are needed"
        )
    time, force = np.array([(block.time, block.force) for block in merged_blocks]).T
    swims = np.array([block.swims for block in merged_blocks])
    durations = np.array([block.duration for block in merged_blocks])
    single_blocks = [block for blocks in blocks_of_phases for block in blocks]
    own_steps, rest_steps = (
        list(_iter_steps(single_blocks, True)),
        list(_iter_steps(single_blocks, False)),
    )
    swim_steps = own_steps if len(own_steps) >= MIN_STEPS else [*own_steps, *other_steps]
    swim_spread, rest_spread = (
        _mean_step(swim_steps if len(swim_steps) >= MIN_STEPS else [*swim_steps, *rest_steps]),
        _mean_step(rest_steps),
    )
    spread = np.where(swims, swim_spread.force, rest_spread.force)
    blocks = Blocks(
        time,
        force,
        spread / durations,
        swims,
        _response_columns(phases, time, tick, first, swim_settle),
    )
    result = fit(blocks)
    swimming_time = sum(block.duration for block in swimming)
    fin_power = sum(block.power * block.duration for block in swimming) / swimming_time
    return ThrustMeasurement(
        thrust=result.force,
        thrust_ci95=result.force_ci95,
        frequency=sum(block.beats for block in swimming) / swimming_time,
        factor=result.force / fin_power if fin_power else 0.0,
        factor_ci95=result.force_ci95 / fin_power if fin_power else 0.0,
        swims=sum(phase[0].swims for phase in phases),
        blocks=blocks,
        drift=result.drift,
        remark=_find_remark(blocks_of_phases) or (DISTURBED_REMARK if result.is_disturbed else ""),
        steps=own_steps,
        disturbances=list(result.disturbances),
        **_mean_power(swimming, swim_spread.watts),
    )


def _response_columns(
    phases: Sequence[Sequence[Sample]], time: Array, tick: float, first: int, settle: float
) -> Array:
    """Return first-order responses to swimming at these times, n×k; all are 0 at first.

    The columns are for the time constants in `RESPONSE_TIMES_S` of at least twice the settling
    time: faster responses cannot be separated from thrust. With a single swim, none can.

    first: index of the tick at time 0
    """
    several = sum(phase[0].swims for phase in phases) > 1
    constants = np.array(
        [constant for constant in RESPONSE_TIMES_S if several and constant >= 2.0 * settle]
    )
    begins = [(phase[0].seq - first) * tick for phase in phases]
    responses, level = np.empty((len(time), len(constants))), np.zeros(len(constants))
    for phase, begin, end in zip(phases, begins, [*begins[1:], math.inf], strict=True):
        inside = (time >= begin) & (time < end)
        gap = level - phase[0].swims
        fading = np.exp(-(time[inside, np.newaxis] - begin) / constants)
        responses[inside] = phase[0].swims + gap * fading
        level = phase[0].swims + gap * np.exp(-(end - begin) / constants)
    return responses


def average_phase(phase: Sequence[Sample], tick: float, settle: float) -> "Block | None":
    """Return the whole beats of a settled swim, or the pieces of a settled rest, as one block.

    tick: period of the loop [s]
    settle: time until the swim or the rest has settled [s]
    Returns None where nothing is left.
    """
    blocks = list(_cut_blocks(phase, tick, 0, settle))
    return _merge(blocks) if blocks else None


def _mean_power(swimming: Sequence["Block"], spread: float) -> dict[str, Any]:
    """Return the mean power of blocks and its error; empty where it is unknown for any of them.

    spread: variance of the mean power over one second [W² s]
    """
    duration = sum(block.duration for block in swimming)
    mean = sum(block.watts * block.duration for block in swimming) / duration
    if not math.isfinite(mean):
        return {}
    return {"power": mean, "power_ci95": Z95 * math.sqrt(spread / duration)}


def _merge_blocks(blocks_of_phases: Sequence[list["Block"]]) -> list[list["Block"]]:
    """Merge neighbouring blocks of each swim and rest where there are more than `MAX_BLOCKS`."""
    count = math.ceil(sum(map(len, blocks_of_phases)) / MAX_BLOCKS)
    return [
        [_merge(blocks[begin : begin + count]) for begin in range(0, len(blocks), count)]
        for blocks in blocks_of_phases
    ]


def _merge(blocks: Sequence["Block"]) -> "Block":
    """Return one block in place of several neighbours, with means weighted by length."""
    if len(blocks) == 1:
        return blocks[0]
    durations = np.array([block.duration for block in blocks])
    time, force, power, watts = np.average(
        [(block.time, block.force, block.power, block.watts) for block in blocks],
        axis=0,
        weights=durations,
    ).tolist()
    beats = sum(block.beats for block in blocks)
    return Block(time, float(durations.sum()), force, power, beats, blocks[0].swims, watts)


def _find_remark(blocks_of_phases: Sequence[Sequence["Block"]]) -> str:
    """Return why a measurement may be wrong, from its blocks by swim and rest; else empty.

    The swing of a fin that does not rest decays within each rest. A drift of F_y, which the fin
    velocity contains, too, does not.
    """
    swims = [blocks for blocks in blocks_of_phases if len(blocks) > 1 and blocks[0].swims]
    rests = [blocks for blocks in blocks_of_phases[1:] if len(blocks) > 1 and not blocks[0].swims]
    begins = sum(block.power for blocks in swims for block in blocks[: len(blocks) // 2])
    ends = sum(block.power for blocks in swims for block in blocks[-(len(blocks) // 2) :])
    if begins and abs(ends / begins - 1.0) > MAX_POWER_CHANGE:
        change = ends / begins - 1.0
        return (
            f"the fin was not steady: its power changed by {change:+.0%} in a swim; {SETTLE_REMEDY}"
        )
    count = sum(len(blocks) // 2 for blocks in swims)
    if begins and rests:
        decay = np.mean([rest[0].power - rest[-1].power for rest in rests]) * count / begins
        if decay > MAX_REST_POWER:
            share = np.mean([rest[0].power for rest in rests]) * count / begins
            return f"the fin did not rest: it had {share:.0%} of its power left; {SETTLE_REMEDY}"
    return ""


class Block(NamedTuple):
    """Some whole beats of a swim, or a piece of a rest."""

    time: float
    """Time of the middle [s]."""
    duration: float
    """Length [s]."""
    force: float
    """Mean F_x [N]."""
    power: float
    """Mean square of `fin_velocity`, in the square of that quantity's unit."""
    beats: float
    """Number of tail beats; 0 where the tail does not beat."""
    swims: bool
    """True in a swim, False in a rest."""
    watts: float
    """Mean electrical power of the servo [W]; NaN where unknown."""


def _split_phases(samples: Sequence[Sample]) -> Iterator[list[Sample]]:
    """Yield the samples of each swim and of each rest."""
    for _, phase in groupby(samples, lambda sample: sample.swims):
        yield list(phase)


def _cut_blocks(phase: Sequence[Sample], tick: float, first: int, settle: float) -> Iterator[Block]:
    """Yield blocks of whole beats of a settled swim, or of pieces of a settled rest.

    first: index of the tick at time 0
    settle: time until the swim or the rest has settled [s]
    """
    swims = phase[0].swims
    begin = round(settle / tick)
    ups = upward_reversals(sample.phi_c for sample in phase) if swims else []
    cuts = [up for up in ups if up >= begin]
    beats_found = len(cuts) > 1
    if not beats_found:
        cuts = list(range(begin, len(phase), max(1, round(PIECE_S / tick))))
    cut_index, beats = 0, 0
    for index in range(1, len(cuts)):
        beats += 1
        start, end = cuts[cut_index], cuts[index]
        if (end - start) * tick < MIN_BLOCK_S - 1e-9 * tick:
            continue
        # The force of a tick is the mean over the period before it; its angle applies after it.
        window = phase[start + 1 : end + 1]
        beat_count, beats, cut_index = beats, 0, index
        is_whole = phase[end].seq - phase[start].seq == len(window)
        if not is_whole:  # a tick was lost
            continue
        yield Block(
            time=(0.5 * (phase[start].seq + phase[end].seq) - first) * tick,
            duration=len(window) * tick,
            force=sum(sample.fx for sample in window) / len(window),
            power=sum(sample.fin_velocity**2 for sample in window) / len(window),
            beats=beat_count if beats_found else 0,
            swims=swims,
            watts=sum(sample.watts for sample in window) / len(window),
        )


def _iter_steps(blocks: Sequence[Block], swims: bool) -> Iterator[Step]:
    """Yield the differences between neighbouring blocks, which contain hardly any drift."""
    for block, successor in pairwise(blocks):
        if (
            block.swims == successor.swims == swims
            and successor.time - block.time < 2.0 * block.duration
        ):
            weight = 1.0 / (1.0 / block.duration + 1.0 / successor.duration)
            yield Step(
                (successor.force - block.force) ** 2 * weight,
                (successor.watts - block.watts) ** 2 * weight,
            )


def _mean_step(steps: Sequence[Step]) -> Step:
    """Return the means of steps without outliers; tiny values for an empty list."""
    force, watts = (map(_mean_without_outliers, zip(*steps, strict=True))) if steps else (0.0, 0.0)
    return Step(max(force, 1e-12), max(watts, 1e-12))


def _mean_without_outliers(squares: Sequence[float]) -> float:
    """Return the mean of these squares, without those that a disturbance has enlarged."""
    largest = MAX_SQUARE_OVER_MEDIAN * float(np.median(squares))
    usual = [square for square in squares if not square > largest]  # NaN stays
    return sum(usual) / len(usual)
