"""A swim of the free swimmer in virtual time: its track, what it tells, and its checkpoints."""

import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
from msgspec import Struct
from msgspec.structs import replace

from fishd.config import Config
from fishd.control.reporting import Publisher
from fishd.controllers import registry
from fishd.core.errors import ParameterError
from fishd.core.signals import Reason
from fishd.lab.simulation.report import count_ticks
from fishd.lab.simulation.virtual_run import EncodingPublisher, VirtualRun
from fishd.virtual.swimmer import checkpoint
from fishd.virtual.swimmer.checkpoint import Checkpoint, CheckpointError
from fishd.virtual.swimmer.fish import Diverged
from fishd.virtual.swimmer.gait import Gait, gait
from fishd.virtual.swimmer.grid import Array
from fishd.virtual.swimmer.robot import Swimmer
from fishd.virtual.swimmer.track import Track


class SwimReport(Gait, frozen=True, kw_only=True):
    """The result of a swim: the gait once settled, and how the run went."""

    controller: str
    parameters: dict[str, Any]
    seconds: float
    """Length of the swim, that before a checkpoint included [s]."""
    resumed: float | None
    """Time of the checkpoint that it goes on from, where the controller began anew [s]."""
    ticks: int
    mode: str
    """Mode at the end."""
    reason: Reason | None
    """Why, when that is fault."""
    fallback: Reason | None
    """Why another controller took over, if one did."""
    real_time_factor: float
    """Seconds of the fish per second."""


class Keeping(Struct, frozen=True):
    """Where checkpoints go, and how often."""

    path: Path
    every: float = 5.0
    """Of the fish's time [s]."""


class Swum(NamedTuple):
    """What is left of a swim."""

    track: Track
    report: SwimReport | None
    """None where the swim was ended before there was anything to judge."""
    trouble: Diverged | None
    """Why the fish could not go on."""
    kept: float | None
    """Time of the latest checkpoint that was written [s]."""
    lost: OSError | None
    """Why the latest one was not."""
    complete: bool


def swim(
    config: Config,
    name: str,
    parameters: Mapping[str, Any],
    seconds: float = 60.0,
    settle: float = 8.0,
    publisher: Publisher | None = None,
    begun: Callable[[VirtualRun], None] = lambda run: None,
    *,
    progress: Callable[[float, float], None] = lambda passed, speed: None,
    keeping: Keeping | None = None,
    resume: Checkpoint | None = None,
    ended: Callable[[], bool] = lambda: False,
    watch: Callable[[Swimmer], None] = lambda fish: None,
    lost: Callable[[OSError], None] = lambda error: None,
) -> Swum:
    """Let a controller swim a free swimmer for `seconds`, and judge it after `settle` seconds.

    publisher, begun: as for `fishd.lab.simulation.simulate`
    progress: called after every tick with the time [s] and the mean speed since it settled [m/s]
    keeping: write checkpoints, the last one when it ends
    resume: go on from there; with the same controller the time before counts
    ended: asked after every tick whether to end now
    watch: shown the fish after every tick
    lost: told the first time that a checkpoint cannot be written; the fish swims on
    Raises `UnknownController`, `ParameterError`, `MissingPackage` and `CheckpointError`.
    """
    controller = registry.create(name, parameters, replace(config.limits, virtual=True))
    given = msgspec.structs.asdict(controller.parameters)
    ticks, first = count_ticks(seconds, settle, config.tick)
    if first + 1 >= ticks:
        raise ParameterError(
            f"a run of {seconds:g} s is too short: it has to be judged by two ticks of "
            f"{config.tick:g} s or more after the {settle:g} s that it may take to settle"
        )
    settings = settings_of(config)
    keeper = _Keeper(keeping, lost)
    kept_rows: Array | None = None
    if resume:
        resume.check(settings)
        if (resume.controller, resume.parameters) == (name, msgspec.to_builtins(given)):
            kept_rows = resume.track
            if len(kept_rows) >= ticks:
                raise CheckpointError(
                    f"{resume.path}: the checkpoint is of {resume.time:.2f} s already: nothing was "
                    "swum; more --seconds are needed"
                )
    with VirtualRun(config, publisher or EncodingPublisher()) as run:
        fish = run.swimmer
        assert fish
        track = Track()
        if resume:
            resume.put_into(fish)
            run.loop.applied = fish.command  # which the new controller goes on from
            track = Track(kept_rows)
        before = len(track)
        track.begin(fish)
        fish.compile()
        begun(run)
        run.loop.set_controller(name, controller)
        next_kept = fish.fish.time + keeping.every if keeping else float("inf")
        since = time.perf_counter()
        mean_speed = _Speed(fish, first - before)

        def keep() -> None:
            keeper.keep(fish, track, settings, name, given)

        while len(track) < ticks:
            command = run.loop.applied
            run.tick()
            if fish.trouble:
                break
            track.add(fish, command)
            watch(fish)
            progress(len(track) * config.tick, mean_speed.mean())
            if fish.fish.time >= next_kept - 1e-9:
                keep()
                next_kept += keeping.every if keeping else 0.0
            if ended():
                break
        elapsed = time.perf_counter() - since
        if not fish.trouble and len(track) > before:
            keep()
        loop = run.loop
        report = None
        if len(track) > first + 1:
            columns = {key: values[first:] for key, values in track.columns().items()}
            report = SwimReport(
                **msgspec.structs.asdict(gait(columns, config.swimmer)),
                controller=name,
                parameters=given,
                seconds=len(track) * config.tick,
                resumed=resume.time if resume else None,
                ticks=len(track),
                mode=loop.supervisor.mode.value,
                reason=loop.supervisor.reason,
                fallback=loop.active.fallback,
                real_time_factor=(len(track) - before) * config.tick / elapsed,
            )
    return Swum(
        track, report, fish.trouble, keeper.kept, keeper.trouble, complete=len(track) >= ticks
    )


def settings_of(config: Config) -> dict[str, Any]:
    """What the motion of a swimmer depends on, as in the configuration."""
    swimmer = msgspec.to_builtins(config.swimmer)
    del swimmer["slow_motion"]
    found = {"tick": config.tick, "swimmer": swimmer, "amplitude_limit": config.amplitude_limit}
    if config.swimmer.muscle.servo:
        plant = config.plant
        found["plant"] = {"servo_speed": plant.servo_speed, "servo_lag": plant.servo_lag}
    return found


class _Keeper:
    """Writes checkpoints; one that cannot be written is no reason to end a swim."""

    def __init__(self, keeping: Keeping | None, lost: Callable[[OSError], None]) -> None:
        self._keeping, self._lost = keeping, lost
        self._told = False
        self.kept: float | None = None
        """Time of the latest checkpoint [s]."""
        self.trouble: OSError | None = None
        """Why the latest one was not written."""

    def keep(self, fish: Swimmer, *others: Any) -> None:
        """Write one, where they are wanted; others: what `checkpoint.save` needs, too."""
        if not self._keeping:
            return
        try:
            checkpoint.save(self._keeping.path, fish, *others)
        except OSError as error:
            self.trouble = error
            if not self._told:
                self._told = True
                self._lost(error)
        else:
            self.kept, self.trouble = fish.fish.time, None


class _Speed:
    """Mean speed of a fish from the tick on that counts first."""

    def __init__(self, fish: Swimmer, wait: int) -> None:
        """wait: so many ticks, or none where that is negative"""
        self._fish, self._wait = fish, wait
        self._from = fish.motion

    def mean(self) -> float:
        """After one more tick; from the start on before the first that counts [m/s]."""
        self._wait -= 1
        now = self._fish.motion
        if self._wait == 0:
            self._from = now
        passed = now.time - self._from.time
        return (self._from.x - now.x) / passed if passed else now.speed
