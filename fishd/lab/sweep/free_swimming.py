"""One point of a sweep with a fish that swims freely: its speed once that is settled."""

from collections.abc import Callable

import numpy as np
from msgspec.structs import replace

from fishd.config import Config, Start
from fishd.control.reporting import Publisher
from fishd.controllers import registry
from fishd.lab.simulation import VirtualRun
from fishd.lab.sweep.grid import Lengths, Point
from fishd.lab.sweep.results import SpeedResult
from fishd.lab.sweep.settling import is_steady, judged_from
from fishd.virtual.swimmer.gait import gait
from fishd.virtual.swimmer.track import Track

LONGEST = 24.0
"""A fish whose speed still changes is judged all the same after so long [s]."""
_ASK_EVERY = 50


def swim_freely(
    point: Point,
    config: Config,
    lengths: Lengths,
    publisher: Publisher,
    begun: Callable[[VirtualRun], None] = lambda run: None,
    stop: Callable[[], bool] = lambda: False,
) -> SpeedResult | None:
    """The speed of a free swimmer at a point, over whole beats once it is settled.

    It swims until the speeds of `lengths.periods` beats, and of the seconds that `settling` names,
    show no trend, or for `LONGEST` seconds: then the later half is judged, or as many beats as that
    where it has fewer, and `settled` is None.

    publisher: gets every tick, and every event
    begun: called before the first of them
    stop: asked now and then whether to stop, and give None
    Raises `ParameterError` and `UnknownController`.
    """
    config = replace(config, start=Start())
    controller = registry.create(
        point.controller, point.parameters, replace(config.limits, virtual=True)
    )
    track = Track()
    begins: list[int] = []
    with VirtualRun(config, publisher) as run:
        fish = run.swimmer
        assert fish
        begun(run)
        track.begin(fish)
        run.loop.set_controller(point.controller, controller)
        before = 0.0
        first: int | None = None
        while first is None and not _is_long_enough(track, begins, lengths, config.tick):
            command = run.loop.applied
            run.tick()
            trouble = fish.trouble or run.loop.supervisor.reason or run.loop.active.fallback
            if trouble:
                message = getattr(trouble, "message", str(trouble))
                return SpeedResult(seconds=len(track) * config.tick, trouble=message)
            track.add(fish, command)
            if command > 0.0 and before < 0.0 and len(track) * config.tick > lengths.settle:
                begins.append(len(track) - 1)
                first = _settled(track, begins, lengths, config)
            if len(track) % _ASK_EVERY == 0 and stop():
                return None
            before = command or before
    return _result(track, begins, first, lengths, config)


def _is_long_enough(track: Track, begins: list[int], lengths: Lengths, tick: float) -> bool:
    """A slow wave gets the time for its beats; what does not beat at all is not waited for."""
    time, longest = len(track) * tick, max(LONGEST, 4.0 * lengths.settle)
    waiting = 0 < len(begins) <= lengths.periods and time < 4.0 * longest
    return time >= longest and not waiting


def _settled(track: Track, begins: list[int], lengths: Lengths, config: Config) -> int | None:
    """The row of the first beat that is judged; None while the speed changes."""
    if len(begins) - 1 < lengths.periods:
        return None
    time, x = _at(track, begins)
    beat = judged_from(time, x)
    if len(begins) - 1 - beat < lengths.periods:
        return None
    steady = is_steady(time[beat:], x[beat:], config.swimmer.body.length)
    return begins[beat] if steady else None


def _at(track: Track, begins: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """Time and place where beats begin: at the end of the tick before."""
    columns = track.columns()
    rows = np.array(begins) - 1
    return columns["time"][rows], columns["x"][rows]


def _result(
    track: Track, begins: list[int], first: int | None, lengths: Lengths, config: Config
) -> SpeedResult:
    columns = track.columns()
    row = first
    if row is None:
        count = len(begins) - 1
        beat = max(0, min(count // 2, count - lengths.periods))
        row = begins[beat] if begins else len(track) // 2
    found = gait({name: values[row - 1 :] for name, values in columns.items()}, config.swimmer)
    return SpeedResult(
        speed=found.speed,
        error=found.speed_error,
        beat_frequency=found.frequency,
        beats=found.beats,
        settled=None if first is None else float(columns["time"][first - 1]),
        tail_width=found.tail_width,
        muscle_power=found.muscle_power,
        cost_of_transport=found.cost_of_transport,
        strouhal=found.strouhal,
        froude_efficiency=found.froude_efficiency,
        seconds=len(track) * config.tick,
    )
