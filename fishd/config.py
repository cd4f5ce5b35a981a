"""The configuration file: YAML in, one frozen `Config` out, or one line that says what is wrong.

Each section is a struct of the part that it configures; this module only puts them together.
"""

import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta, Struct

from fishd import files, strict_yaml
from fishd.config_checks import (
    check_addresses,
    check_data_rate,
    check_force_sensor,
    check_lockstep,
    check_pins,
    check_removed,
    check_servo,
    check_start,
    check_virtual_pi,
)
from fishd.controllers.base import Limits
from fishd.controllers.chatter import ChatterSettings
from fishd.emulation.settings import VirtualPiSettings
from fishd.errors import ConfigError
from fishd.estimators.lateral_force import EstimatorSettings
from fishd.hardware.imperfections import SimulationSettings
from fishd.hardware.settings import ForceSensorSettings, PanelSettings, ServoSettings
from fishd.overrides import apply_overrides
from fishd.plant.parameters import PlantParameters
from fishd.schema import Problem, convert, without_empty_sections

SERVICE_FILE = Path("/etc/fishd/fishd.yaml")
"""What the service runs with, as installed by 'make install-pi'."""
FILE_VARIABLE = "FISHD_CONFIG"


class Start(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What the fish does as soon as the daemon is up."""

    controller: Annotated[
        str | None, Meta(description="Controller to start with; null starts in mode idle.")
    ] = None
    parameters: Annotated[
        dict[str, Any], Meta(description="Its parameters; those left out keep their defaults.")
    ] = {}


class TelemetrySettings(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Where telemetry is published."""

    address: Annotated[
        str,
        Meta(
            description="ZeroMQ address of the PUB socket: tcp://HOST:PORT or ipc://PATH. "
            "Telemetry is not secret: tcp://0.0.0.0:9872 lets the whole network watch.",
        ),
    ] = "tcp://127.0.0.1:9872"


class ControlSettings(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Where requests are taken."""

    address: Annotated[
        str | None,
        Meta(
            description="ZeroMQ address of the ROUTER socket: ipc://PATH or tcp://127.0.0.1:PORT. "
            "null: a socket named control in $RUNTIME_DIRECTORY, else in $XDG_RUNTIME_DIR/fishd, "
            "else in a private folder under /tmp. From another machine, use an ssh tunnel."
        ),
    ] = None


class RealtimeSettings(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How hard fishd tries to be on time; without the privilege it warns once and goes on."""

    priority: Annotated[
        int, Meta(ge=0, le=99, description="SCHED_FIFO priority; 0 keeps the normal scheduler.")
    ] = 50
    rehearse: Annotated[
        bool,
        Meta(
            description="Run mock ticks just before each real one, so that it finds warm caches; "
            "has no effect for ticks below 10 ms."
        ),
    ] = True
    lock_memory: Annotated[bool, Meta(description="Keep fishd's memory from being paged out.")] = (
        True
    )


class Config(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Everything that can be configured; `Config()` is a simulated fish at rest."""

    robot: Annotated[
        Literal["simulated", "pi", "virtual-pi"],
        Meta(
            description="What swims: a simulated fish, the robot on this Raspberry Pi, or a "
            "simulated fish behind the robot's own drivers (fishctl virtual-pi)."
        ),
    ] = "simulated"
    tick: Annotated[
        float,
        Meta(ge=0.002, le=0.2, description="Period of the loop.", extra_json_schema={"unit": "s"}),
    ] = 0.05
    amplitude_limit: Annotated[
        float,
        Meta(
            gt=0,
            le=1.57,
            description="Φ: no instruction angle goes beyond ±Φ.",
            extra_json_schema={"unit": "rad"},
        ),
    ] = 0.42
    slew_limit: Annotated[
        Annotated[float, Meta(gt=0, le=10_000)] | None,
        Meta(
            description="Fastest change of the instruction angle. null allows one full reversal, "
            "2Φ, in each tick and so leaves a square wave untouched.",
            extra_json_schema={"unit": "rad/s"},
        ),
    ] = None
    fade_time: Annotated[
        float,
        Meta(
            gt=0,
            le=0.5,
            description="Time to fade from Φ to neutral on stop, fault and exit.",
            extra_json_schema={"unit": "s"},
        ),
    ] = 0.4
    start: Annotated[Start, Meta(description="What the fish does at once.")] = Start()
    chatter: Annotated[
        ChatterSettings, Meta(description="A policy that would reverse too fast.")
    ] = ChatterSettings()
    lockstep: Annotated[
        bool,
        Meta(
            description="Virtual time, for a simulated fish: while remote is in command, each "
            "tick waits for its agent, and the next one follows at once."
        ),
    ] = False
    estimator: Annotated[
        EstimatorSettings, Meta(description="Fin velocity from the lateral force.")
    ] = EstimatorSettings()
    plant: Annotated[PlantParameters, Meta(description="The simulated fish: physics.")] = (
        PlantParameters()
    )
    simulation: Annotated[
        SimulationSettings, Meta(description="The simulated fish: imperfections of the rig.")
    ] = SimulationSettings()
    force_sensor: Annotated[
        ForceSensorSettings, Meta(description="The force sensor; not for a simulated fish.")
    ] = ForceSensorSettings()
    servo: Annotated[
        ServoSettings, Meta(description="The tail servo; not for a simulated fish.")
    ] = ServoSettings()
    panel: Annotated[
        PanelSettings, Meta(description="E-stop button and status light, where there are any.")
    ] = PanelSettings()
    state_folder: Annotated[
        str | None,
        Meta(
            description="Folder for calibrations; null: $STATE_DIRECTORY, else "
            "$XDG_STATE_HOME/fishd, else ~/.local/state/fishd; in it, a folder for each robot."
        ),
    ] = None
    virtual_pi: Annotated[
        VirtualPiSettings, Meta(description="The virtual Pi, with robot virtual-pi.")
    ] = VirtualPiSettings()
    telemetry: Annotated[TelemetrySettings, Meta(description="What is published, and where.")] = (
        TelemetrySettings()
    )
    control: Annotated[ControlSettings, Meta(description="Where requests are taken.")] = (
        ControlSettings()
    )
    realtime: Annotated[RealtimeSettings, Meta(description="Scheduling and memory.")] = (
        RealtimeSettings()
    )

    @property
    def limits(self) -> Limits:
        """What controllers must respect."""
        return Limits(
            amplitude=self.amplitude_limit,
            tick=self.tick,
            virtual=self.lockstep,
            chatter=self.chatter,
        )


def service_file() -> Path | None:
    """The file that the fishd of this machine most likely runs with; None for the defaults.

    $FISHD_CONFIG where it is set, empty for none; else that of the service where there is one.
    """
    given = os.environ.get(FILE_VARIABLE)
    if given is not None:
        return Path(given) if given else None
    return SERVICE_FILE if os.path.lexists(SERVICE_FILE) else None


def load(path: Path | None = None, overrides: Iterable[str] = ()) -> Config:
    """Read a configuration file and apply `KEY=VALUE` overrides, such as `plant.xi=0.9`.

    Without a path the defaults apply. Raises `ConfigError` with one line that names the file, the
    line, the key and what is permitted.
    """
    document = _read(path) if path else strict_yaml.Document({}, {})
    if not isinstance(document.data, dict):
        raise ConfigError(f"{path}:1: keys and values are needed, such as 'tick: 0.05'")
    sources = {key: f"{path}:{line}" for key, line in document.lines.items()}
    sources |= apply_overrides(document.data, overrides)
    try:
        check_removed(document.data)
        config = convert(without_empty_sections(document.data, Config), Config)
        check_start(config.start.controller, config.start.parameters, config.limits)
        check_addresses(config.telemetry.address, config.control.address)
        check_force_sensor(config.force_sensor)
        if config.robot != "simulated":
            check_data_rate(config.force_sensor, config.tick)
        check_servo(config.servo, config.amplitude_limit)
        check_pins(config.force_sensor, config.servo, config.panel)
        check_lockstep(config.robot, config.lockstep)
        check_virtual_pi(config.robot, config.servo, config.virtual_pi)
    except Problem as problem:
        raise ConfigError(_located(problem, sources)) from None
    return config


def adopt(data: dict[str, Any], overrides: Iterable[str] = ()) -> Config:
    """The configuration that a running fishd tells (`Fish.config`), with overrides.

    What must fit together, that fishd has checked. Raises `ConfigError`.
    """
    sources = apply_overrides(data, overrides)
    try:
        return convert(data, Config)
    except Problem as problem:
        where = sources.get(problem.path, "the configuration of the fishd that runs")
        raise ConfigError(_located(problem, {problem.path: where})) from None


def _read(path: Path) -> strict_yaml.Document:
    try:
        return strict_yaml.parse(files.read_text(path, files.SETTINGS, "a configuration"))
    except strict_yaml.YamlProblem as problem:
        raise ConfigError(f"{path}:{problem.line}: {problem}") from None
    except files.NoFile as problem:
        raise ConfigError(
            f"{path}: {problem}; give the path of a YAML file, or none for the defaults"
        ) from None
    except files.FileProblem as problem:
        raise ConfigError(f"{path}: {problem}") from None


def _located(problem: Problem, sources: Mapping[tuple[str, ...], str]) -> str:
    """Name the place of the problem: its own, one within it, or the nearest section above it."""
    path = problem.path
    within = [place for key, place in sources.items() if path and key[: len(path)] == path]
    above = [sources[path[:n]] for n in range(len(path) + 1) if path[:n] in sources]
    where = sources.get(path) or (within or above[::-1] or [""])[0]
    return ": ".join(part for part in (where, ".".join(path), str(problem)) if part)


def to_yaml(config: Config | dict[str, Any]) -> str:
    """The whole configuration, defaults included, as YAML that `load` reads back."""
    import yaml

    return yaml.safe_dump(
        msgspec.to_builtins(config), sort_keys=False, allow_unicode=True, default_flow_style=False
    )
