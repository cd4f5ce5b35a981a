"""A swim of the free swimmer in virtual time: its track, a report, and its file."""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
from msgspec import Struct
from msgspec.structs import replace

from fishd.config import Config
from fishd.controllers import registry
from fishd.core.errors import ParameterError
from fishd.core.signals import Publisher, Reason
from fishd.lab.simulation.report import count_ticks
from fishd.lab.simulation.virtual_run import EncodingPublisher, VirtualRun
from fishd.lab.swimmer.refinement import find_grid_error
from fishd.lab.swimmer.speed import find_swimmer
from fishd.virtual.swimmer import checkpoint
from fishd.virtual.swimmer.checkpoint import Checkpoint, CheckpointError
from fishd.virtual.swimmer.fish import Diverged
from fishd.virtual.swimmer.gait import Gait, gait
from fishd.virtual.swimmer.grid import Array
from fishd.virtual.swimmer.midlines import Midlines
from fishd.virtual.swimmer.robot import Swimmer
from fishd.virtual.swimmer.track import Track


class SwimReport(Gait, frozen=True, kw_only=True):
    """Result of a swim: the settled gait, and facts about the run."""

    controller: str
    parameters: dict[str, Any]
    seconds: float
    """Length of the swim, including the part before it was resumed [s]."""
    resumed: float | None
    """Time at which the swim resumed, with the controller reset [s]; None if it did not."""
    ticks: int
    mode: str
    """Mode at the end."""
    reason: Reason | None
    """Reason of mode fault."""
    fallback: Reason | None
    """Reason why the fallback took over; None if it did not."""
    grid_error: float | None
    """Half-width of the error of `speed` by the grid [m/s]; None if it is not known."""
    real_time_factor: float
    """Ratio of simulated time to computing time."""


class SwimFile(Struct, frozen=True):
    """Settings of the file of a swim, from which it can be resumed."""

    path: Path
    """Path of the file, which is overwritten."""
    every: float = 5.0
    """Simulated time between two writes [s]."""
    command: Sequence[str] = ()
    """Arguments of `fishctl simulate` that a resumed swim takes over."""


class SwimResult(NamedTuple):
    """Result of a swim, possibly incomplete."""

    track: Track
    report: SwimReport | None
    """Report of the swim; None where it ended before the gait had settled."""
    error: Diverged | None
    """Error of the simulation that ended the swim; None if there was none."""
    checkpoint_time: float | None
    """Time at which the file of the swim was last written [s]."""
    checkpoint_error: OSError | None
    """Error of the last write of this file; None if it was written."""
    complete: bool
    """True where the swim has the requested length."""


def swim(
    config: Config,
    name: str,
    parameters: Mapping[str, Any],
    seconds: float = 60.0,
    settle: float = 8.0,
    publisher: Publisher | None = None,
    on_start: Callable[[VirtualRun], None] = lambda run: None,
    *,
    progress: Callable[[float, float], None] = lambda passed, speed: None,
    file: SwimFile | None = None,
    resume: Checkpoint | None = None,
    ended: Callable[[], bool] = lambda: False,
    watch: Callable[[Swimmer], None] = lambda fish: None,
    lost: Callable[[OSError], None] = lambda error: None,
) -> SwimResult:
    """Swim a free swimmer with a controller for `seconds`; report the gait after `settle` seconds.

    publisher, on_start: see `fishd.lab.simulation.simulate`
    progress: called after each tick with the time [s] and the mean speed since it settled [m/s]
    file: file of the swim, which is also written at the end
    resume: earlier swim to resume; with the same controller the time before it counts
    ended: called after each tick; the swim ends where it returns True
    watch: called with the fish after each tick
    lost: called with the first error of writing the file; the swim continues
    Raises `UnknownController`, `ParameterError`, `MissingPackage` and `CheckpointError`.
    """
    controller = registry.create(name, parameters, replace(config.limits, virtual=True))
    parameter_values = msgspec.structs.asdict(controller.parameters)
    share = find_grid_error(config, name, parameter_values)  # raises before the swim
    ticks, first = count_ticks(seconds, settle, config.tick)
    if first + 1 >= ticks:
        raise ParameterError(
            f"a run of {seconds:g} s is too short: two ticks of {config.tick:g} s or more are "
            f"needed after the settling time of {settle:g} s"
        )
    settings = settings_of(config)
    writer = _FileWriter(file, lost)
    resumed_rows: Array | None = None
    midlines = Midlines()
    if resume:
        resume.check(settings)
        if (resume.controller, resume.parameters) == (name, msgspec.to_builtins(parameter_values)):
            resumed_rows, midlines = resume.track, resume.midlines
            if len(resumed_rows) >= ticks:
                raise CheckpointError(
                    f"{resume.path}: this swim is {resume.time:.2f} s long already; give a longer "
                    "--for"
                )
        elif file and file.path.exists() and file.path.samefile(resume.path):
            raise CheckpointError(
                f"{resume.path}: this swim is of another controller or of other parameters; give "
                "another file to --to"
            )
    with VirtualRun(config, publisher or EncodingPublisher()) as run:
        fish = find_swimmer(run)
        track = Track()
        if resume:
            resume.put_into(fish)
            run.loop.instruction_angle = fish.instruction_angle  # the controller starts from it
            track = Track(resumed_rows)
        resumed_ticks = len(track)
        track.begin(fish)
        on_start(run)
        run.loop.set_controller(name, controller)
        next_write = fish.fish.time + file.every if file else math.inf
        start_time = time.perf_counter()
        mean_speed = _Speed(fish, first - resumed_ticks)

        def write_file() -> None:
            command = file.command if file else ()
            writer.write(fish, track, midlines, settings, name, parameter_values, command)

        while len(track) < ticks:
            instruction_angle = run.loop.instruction_angle
            run.tick()
            if fish.trouble:
                break
            track.add(fish, instruction_angle)
            if file:
                midlines.add(fish)
            watch(fish)
            progress(len(track) * config.tick, mean_speed.mean())
            if file and fish.fish.time >= next_write - 1e-9:
                write_file()
                next_write += file.every
            if ended():
                break
        elapsed = time.perf_counter() - start_time
        if not fish.trouble and len(track) > resumed_ticks:
            write_file()
        loop = run.loop
        report = None
        if len(track) > first + 1:
            columns = {key: values[first:] for key, values in track.columns().items()}
            measured = gait(columns, config.swimmer)
            report = SwimReport(
                **msgspec.structs.asdict(measured),
                controller=name,
                parameters=parameter_values,
                seconds=len(track) * config.tick,
                resumed=resume.time if resume else None,
                ticks=len(track),
                mode=loop.supervisor.mode.value,
                reason=loop.supervisor.reason,
                fallback=loop.active.fallback,
                grid_error=None if share is None else share * abs(measured.speed),
                real_time_factor=(len(track) - resumed_ticks) * config.tick / elapsed,
            )
    return SwimResult(
        track, report, fish.trouble, writer.time, writer.error, complete=len(track) >= ticks
    )


def settings_of(config: Config) -> dict[str, Any]:
    """Return the settings on which the motion of a swimmer depends, as in the configuration."""
    swimmer = msgspec.to_builtins(config.swimmer)
    del swimmer["slow_motion"]
    settings = {"tick": config.tick, "swimmer": swimmer, "amplitude_limit": config.amplitude_limit}
    if config.swimmer.muscle.servo:
        plant = config.plant
        settings["plant"] = {"servo_speed": plant.servo_speed, "servo_lag": plant.servo_lag}
    return settings


class _FileWriter:
    """A writer of the file of a swim; an error does not end the swim."""

    def __init__(self, file: SwimFile | None, lost: Callable[[OSError], None]) -> None:
        self._file, self._lost = file, lost
        self._has_reported = False
        self.time: float | None = None
        """Time at which the file was last written [s]."""
        self.error: OSError | None = None
        """Error of the last write; None if the file was written."""

    def write(self, fish: Swimmer, *content: Any) -> None:
        """Write the file, if there is one; content: further arguments of `checkpoint.save`."""
        if not self._file:
            return
        try:
            checkpoint.save(self._file.path, fish, *content)
        except OSError as error:
            self.error = error
            if not self._has_reported:
                self._has_reported = True
                self._lost(error)
        else:
            self.time, self.error = fish.fish.time, None


class _Speed:
    """Mean speed of a fish since it settled."""

    def __init__(self, fish: Swimmer, wait: int) -> None:
        """wait: number of ticks until it settles; not positive for none"""
        self._fish, self._wait = fish, wait
        self._from = fish.motion

    def mean(self) -> float:
        """Count a tick and return the mean speed [m/s]; before it settles, that since the start."""
        self._wait -= 1
        now = self._fish.motion
        if self._wait == 0:
            self._from = now
        passed = now.time - self._from.time
        return (self._from.x - now.x) / passed if passed else now.speed
