"""The sections of the configuration, and how a file with its overrides becomes a `Config`.

Each section is a struct of the part that it configures; this module only puts them together.
"""

import logging
import math
import os
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta, Struct

from fishd.config import consistency as checks
from fishd.config import drivers
from fishd.control.estimators.base import EstimatorSettings
from fishd.controllers.base import DWELL, LONGEST_DWELL, ChatterSettings, Limits
from fishd.core import strict_yaml
from fishd.core.errors import ConfigError
from fishd.core.overrides import apply_overrides
from fishd.core.protocol import LEASE, LONGEST_LEASE, SHORTEST_LEASE
from fishd.core.schema import (
    Problem,
    convert,
    fields_of,
    find_doubts,
    leaves,
    note,
    unit,
    without_empty_sections,
)
from fishd.hardware.force_sensor.ads1115 import Ads1115Settings
from fishd.hardware.servo.pigpio import PigpioSettings
from fishd.hardware.settings import (
    ForceSensorSettings,
    PanelSettings,
    PowerMeterSettings,
    ServoSettings,
)
from fishd.virtual.imperfections import SimulationSettings
from fishd.virtual.pi.settings import VirtualPiSettings
from fishd.virtual.plant.dwell import shortest_dwell
from fishd.virtual.plant.parameters import PlantParameters
from fishd.virtual.swimmer.settings import SwimmerSettings

log = logging.getLogger(__name__)

SERVICE_FILE = Path("/etc/fishd/fishd.yaml")
"""What the service runs with, as installed by 'make install-pi'."""
FILE_VARIABLE = "FISHD_CONFIG"


Name = Annotated[
    str, Meta(min_length=1, max_length=40, pattern=r"^(?! )[^\x00-\x1f\x7f-\x9f]+$(?<! )(?!\n)")
]
"""Printable, and without spaces around it."""


class Start(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What the fish does once the daemon runs."""

    controller: Annotated[
        str | None, note("Controller to start with; null starts in mode idle.")
    ] = None
    parameters: Annotated[
        dict[str, Any], note("Its parameters; those left out keep their defaults.")
    ] = {}
    rest: Annotated[
        float,
        unit(
            "s",
            "How long the fish rests before: 3 s are enough to find the zero of the force sensor.",
            ge=0,
            le=3600,
            usual=600,
        ),
    ] = 0.0


class TelemetrySettings(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Where telemetry is published."""

    address: Annotated[
        str,
        note(
            "ZeroMQ address of the PUB socket: tcp://HOST:PORT or ipc://PATH. Telemetry is not "
            "secret: tcp://0.0.0.0:9872 lets the whole network watch."
        ),
    ] = "tcp://127.0.0.1:9872"


class ControlSettings(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Where requests are taken."""

    address: Annotated[
        str | None,
        note(
            "ZeroMQ address of the ROUTER socket: ipc://PATH or tcp://127.0.0.1:PORT. null: a "
            "socket named control in $RUNTIME_DIRECTORY, else in $XDG_RUNTIME_DIR/fishd, else in a "
            "private folder under /tmp. From another machine, use an ssh tunnel."
        ),
    ] = None
    lease: Annotated[
        float,
        unit(
            "s",
            "An experiment that does not renew its lease for this time is over, and the fish fades "
            "to neutral; longer for slow links.",
            ge=SHORTEST_LEASE,
            le=LONGEST_LEASE,
        ),
    ] = LEASE


class RealtimeSettings(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How hard fishd tries to be on time; without the privilege it warns once and goes on."""

    priority: Annotated[
        int,
        note(
            "SCHED_FIFO priority; 0 keeps the normal scheduler. More than 50 needs more than the "
            "LimitRTPRIO=51 of the service: one above the priority.",
            ge=0,
            le=99,
        ),
    ] = 50
    warm_up: Annotated[
        bool,
        note(
            "Run mock ticks just before each real one, so that it finds warm caches; has no effect "
            "for ticks below 10 ms."
        ),
    ] = True
    lock_memory: Annotated[bool, note("Keep fishd's memory from being paged out.")] = True


class Config(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Everything that can be configured; `Config()` is a simulated fish at rest."""

    name: Annotated[
        Name | None,
        Meta(description="Name of the fish, in status and telemetry; null: this machine's name."),
    ] = None
    robot: Annotated[
        Literal["simulated", "pi", "virtual-pi", "swimmer"],
        note(
            "What swims: a simulated fish, the robot on this Raspberry Pi, or a simulated fish "
            "behind the robot's own drivers (fishctl virtual-pi), or a fish that swims freely in a "
            "two-dimensional fluid."
        ),
    ] = "simulated"
    tick: Annotated[float, unit("s", "Period of the loop.", ge=0.002, le=0.2)] = 0.05
    amplitude_limit: Annotated[
        float, unit("rad", "Φ: no instruction angle goes beyond ±Φ.", gt=0, le=1.57)
    ] = 0.42
    slew_limit: Annotated[
        Annotated[float, Meta(gt=0, le=10_000)] | None,
        unit(
            "rad/s",
            "Fastest change of the instruction angle. null allows one full reversal, 2Φ, in each "
            "tick and so leaves a square wave untouched.",
        ),
    ] = None
    fade_time: Annotated[
        float, unit("s", "Time to fade from Φ to neutral on stop, fault and exit.", gt=0, le=0.5)
    ] = 0.4
    start: Annotated[Start, note("What the fish does at once.")] = Start()
    chatter: Annotated[ChatterSettings, note("A policy that would reverse too fast.")] = (
        ChatterSettings()
    )
    lockstep: Annotated[
        bool,
        note(
            "Virtual time, for a simulated fish: while remote is active, each tick waits for "
            "its agent, and the next one follows at once."
        ),
    ] = False
    estimator: Annotated[EstimatorSettings, note("Fin velocity and thrust from the forces.")] = (
        EstimatorSettings()
    )
    plant: Annotated[
        PlantParameters,
        note("Physics of the fish: of the simulated one, and of what the observer believes in."),
    ] = PlantParameters()
    simulation: Annotated[
        SimulationSettings, note("The simulated fish: imperfections of the rig.")
    ] = SimulationSettings()
    force_sensor: Annotated[
        ForceSensorSettings, note("The force sensor; not for a simulated fish.")
    ] = Ads1115Settings(driver="ads1115")
    servo: Annotated[ServoSettings, note("The tail servo; not for a simulated fish.")] = (
        PigpioSettings(driver="pigpio")
    )
    power_meter: Annotated[
        PowerMeterSettings | None,
        note(
            "The power meter of the servo, where there is one; null without. Not for a simulated "
            "fish, whose servo has a model."
        ),
    ] = None
    panel: Annotated[
        PanelSettings, note("E-stop button and status light, where there are any.")
    ] = PanelSettings()
    state_folder: Annotated[
        str | None,
        note(
            "Folder for calibrations; null: $STATE_DIRECTORY, else $XDG_STATE_HOME/fishd, else "
            "~/.local/state/fishd; in it, a folder for each robot."
        ),
    ] = None
    swimmer: Annotated[SwimmerSettings, note("The fish that swims freely, with robot swimmer.")] = (
        SwimmerSettings()
    )
    virtual_pi: Annotated[VirtualPiSettings, note("The virtual Pi, with robot virtual-pi.")] = (
        VirtualPiSettings()
    )
    telemetry: Annotated[TelemetrySettings, note("What is published, and where.")] = (
        TelemetrySettings()
    )
    control: Annotated[ControlSettings, note("Where requests are taken.")] = ControlSettings()
    realtime: Annotated[RealtimeSettings, note("Scheduling and memory.")] = RealtimeSettings()

    @property
    def has_hardware(self) -> bool:
        """Does it have a force sensor and a servo, real or emulated ones?"""
        return self.robot in ("pi", "virtual-pi")

    @property
    def driver_settings(self) -> drivers.Chosen:
        """What its sections of drivers say."""
        return drivers.Chosen(self.force_sensor, self.servo, self.power_meter)

    @property
    def limits(self) -> Limits:
        """What controllers must respect."""
        return Limits(
            amplitude=self.amplitude_limit,
            tick=self.tick,
            scaled=self.estimator.kind != "lateral_force",
            virtual=self.lockstep or self.robot == "swimmer",
            dwell=self._dwell,
            chatter=self.chatter,
            tethered=self.robot != "swimmer",
            thrust_coefficient=(
                self.plant.thrust_coefficient if self.estimator.kind == "observer" else None
            ),
        )

    @property
    def _dwell(self) -> float:
        """Shortest time between two reversals of a policy [s]."""
        if self.chatter.dwell != "auto":
            return self.chatter.dwell
        if self.robot == "swimmer":  # whose muscles are no servo
            return DWELL
        shortest = min(shortest_dwell(self.plant, self.amplitude_limit), LONGEST_DWELL)
        return round(math.ceil(shortest / self.tick - 1e-9) * self.tick, 9)


def service_file() -> Path | None:
    """The file that the fishd of this machine most likely runs with; None for the defaults.

    $FISHD_CONFIG where it is set, empty for none; else that of the service where there is one.
    """
    given = os.environ.get(FILE_VARIABLE)
    if given is not None:
        return Path(given) if given else None
    return SERVICE_FILE if os.path.lexists(SERVICE_FILE) else None


def load(path: str | os.PathLike[str] | None = None, overrides: Iterable[str] = ()) -> Config:
    """Read a configuration file and apply `KEY=VALUE` overrides, such as `plant.xi=0.9`.

    Without a path the defaults apply. Raises `ConfigError` with one line that names the file, the
    line, the key and what is permitted.
    """
    data, sources = read(path) if path is not None else ({}, {})
    sources |= apply_overrides(data, overrides)
    try:
        config = convert_sections(without_empty_sections(data, Config))
        for check in CHECKS:
            check(config)
    except Problem as problem:
        raise ConfigError(problem.located(sources)) from None
    _warn_of_values(config, sources)
    return config


def read(
    path: str | os.PathLike[str], mistakes: list[str] | None = None
) -> tuple[dict[str, Any], dict[tuple[str, ...], str]]:
    """Return what stands in a configuration file, and the place of each key.

    mistakes: takes what is wrong with single values, which are left out then
    Raises `ConfigError`.
    """
    return strict_yaml.read(path, "a configuration", "tick: 0.05", mistakes)


def _warn_of_values(config: Config, sources: Mapping[tuple[str, ...], str]) -> None:
    """Log a warning for each value that was given and is far beyond what makes sense."""
    for path, place in sources.items():
        section: Any = config
        for key in path[:-1]:
            section = getattr(section, key, None)
        if not path or not isinstance(section, Struct):
            continue
        (name,) = path[-1:]
        fields = [field for field in fields_of(type(section)) if field.name == name]
        for doubt in find_doubts({name: getattr(section, name, None)}, fields):
            log.warning("careful: %s: %s", place, ".".join((*path[:-1], doubt)))


def check_tethered(robot: str, what: str) -> None:
    """Raise `ConfigError` where the fish swims freely; what: that which needs a tethered one."""
    if robot == "swimmer":
        raise ConfigError(
            f"robot: swimmer is not valid for {what}, which is about the thrust of a tethered "
            "fish; robot: simulated is needed, and what a swimmer does 'fishctl simulate' tells"
        )


Check = Callable[[Config], None]

CHECKS: tuple[Check, ...] = (
    lambda c: checks.check_start(c.start.controller, c.start.parameters, c.limits),
    lambda c: checks.check_addresses(c.telemetry.address, c.control.address),
    lambda c: checks.check_state_folder(c.state_folder),
    lambda c: drivers.check_drivers(c.robot, c.tick, c.driver_settings),
    lambda c: checks.check_neutral(c.servo),
    lambda c: drivers.check_plant(c.plant),
    lambda c: checks.check_pulses(c.servo, c.amplitude_limit),
    lambda c: checks.check_i2c_addresses(c.driver_settings.sections()),
    lambda c: checks.check_pins(drivers.claims_of(c.driver_settings), c.panel),
    lambda c: checks.check_lockstep(c.robot, c.lockstep),
    lambda c: checks.check_estimator(c.robot, c.estimator.kind, c.plant),
    lambda c: checks.check_virtual_pi(c.virtual_pi),
    lambda c: checks.check_swimmer(c.swimmer, c.tick) if c.robot == "swimmer" else None,
)
"""Checks of keys against each other, in their order; each raises `Problem`."""


def adopt(data: dict[str, Any], overrides: Iterable[str] = ()) -> Config:
    """The configuration that a running fishd reports (`Fish.config`), with overrides.

    It is not validated across fields again: fishd has done so. Raises `ConfigError`.
    """
    sources = apply_overrides(data, overrides)
    try:
        return convert_sections(data)
    except Problem as problem:
        where = sources.get(problem.path, "the configuration of the fishd that runs")
        raise ConfigError(problem.located({problem.path: where})) from None


def convert_sections(data: Mapping[str, Any]) -> Config:
    """Validate each section on its own; raises `Problem`."""
    rest = {key: value for key, value in data.items() if key not in drivers.CHOICES}
    config = convert(rest, Config, elsewhere=drivers.keys)
    return msgspec.structs.replace(config, **drivers.convert_sections(data, keys))


def keys() -> list[str]:
    """Every key in dotted form, those of all drivers and plants that load among them."""
    return list(dict.fromkeys(leaves(Config) + drivers.keys()))


def to_yaml(config: Config | dict[str, Any]) -> str:
    """The whole configuration, defaults included, as YAML that `load` reads back."""
    return strict_yaml.dump(msgspec.to_builtins(config))


def json_schema() -> dict[str, Any]:
    """The JSON Schema of the configuration, with the keys of all drivers and plants that load."""
    choices = {section: drivers.settings_of_drivers(section) for section in drivers.CHOICES}
    types = [Config, *(struct for found in choices.values() for struct in found.values())]
    (top, *_), parts = msgspec.json.schema_components(types, ref_template="#/$defs/{name}")
    properties = parts["Config"]["properties"]
    for section, found in choices.items():
        refs = []
        for struct in dict.fromkeys(found.values()):
            named = [name for name, keys_of in found.items() if keys_of is struct]
            parts[struct.__name__]["properties"][drivers.CHOICES[section].key] = {"enum": named}
            refs.append({"$ref": f"#/$defs/{struct.__name__}"})
        default = {key: value for key, value in properties[section].items() if key == "default"}
        properties[section] = {"anyOf": refs, **default}
    return {**top, "$defs": parts}
