"""Sections of the configuration, and conversion of a file with its overrides into a `Config`.

Each section is a struct of the part that it configures; this module only combines them.
"""

import logging
import math
import os
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any

import msgspec
from msgspec import Meta, Struct

from fishd.config.consistency import (
    check_addresses,
    check_estimator,
    check_i2c_addresses,
    check_lockstep,
    check_network,
    check_neutral,
    check_pins,
    check_pulses,
    check_robot,
    check_start,
    check_state_folder,
    check_virtual_pi,
)
from fishd.config.drivers import (
    CHOICES,
    SENSOR_SECTIONS,
    DriverSettings,
    check_drivers,
    check_plant,
    check_readings,
    claims_of,
    convert_driver_sections,
    driver_keys,
    readings_of,
    settings_of_drivers,
)
from fishd.controllers import registry
from fishd.controllers.base import DEFAULT_DWELL_S, MAX_DWELL_S, ChatterSettings, Controller, Limits
from fishd.core import robots, strict_yaml
from fishd.core.errors import ConfigError
from fishd.core.estimation import EstimatorSettings
from fishd.core.loop_settings import LoopSettings
from fishd.core.overrides import apply_overrides
from fishd.core.protocol import DEFAULT_LEASE_S, MAX_LEASE_S, MIN_LEASE_S
from fishd.core.robots import RobotKind, find_kind
from fishd.core.schema import (
    Problem,
    Reading,
    convert,
    drop_empty_sections,
    fields_of,
    find_doubts,
    list_keys,
    note,
    unit,
)
from fishd.hardware.force_sensor.ads1115 import Ads1115Settings
from fishd.hardware.registry import SENSORS
from fishd.hardware.servo.pigpio import PigpioSettings
from fishd.hardware.settings import (
    POWER,
    ForceSensorSettings,
    PanelSettings,
    SensorSettings,
    ServoSettings,
)
from fishd.virtual.imperfections import SimulationSettings
from fishd.virtual.pi.settings import VirtualPiSettings
from fishd.virtual.plant.drive_train import shortest_dwell
from fishd.virtual.plant.parameters import TETHERED, PlantParameters
from fishd.virtual.swimmer.settings import SwimmerSettings

log = logging.getLogger(__name__)

SERVICE_FILE = Path("/etc/fishd/fishd.yaml")
"""Configuration file of the service, installed by the Debian package."""
FILE_VARIABLE = "FISHD_CONFIG"
"""Environment variable with the path of the configuration file."""


Name = Annotated[
    str, Meta(min_length=1, max_length=40, pattern=r"^(?! )[^\x00-\x1f\x7f-\x9f]+$(?<! )(?!\n)")
]
"""Printable name without spaces at its ends."""


class Start(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Controller that is started with the daemon."""

    controller: Annotated[
        str | None, note("Controller to start with; null starts in mode idle.")
    ] = None
    parameters: Annotated[
        dict[str, Any], note("Parameters of that controller; those left out keep their defaults.")
    ] = {}
    rest: Annotated[
        float,
        unit(
            "s",
            "Time at rest before the start: 3 s are enough to find the zero of the force sensor.",
            ge=0,
            le=3600,
            usual=600,
        ),
    ] = 0.0

    def create_controller(self, limits: Limits) -> tuple[str, Controller[Any]] | None:
        """Return name and controller, or None if none is set.

        Raises `UnknownController` and `ParameterError`.
        """
        if self.controller is None:
            return None
        return self.controller, registry.create(self.controller, self.parameters, limits)


class TelemetrySettings(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Address at which telemetry is published."""

    address: Annotated[
        str,
        note(
            "ZeroMQ address of the PUB socket: tcp://HOST:PORT or ipc://PATH. Telemetry is not "
            "secret: tcp://0.0.0.0:9872 lets the whole network watch."
        ),
    ] = "tcp://127.0.0.1:9872"


class ControlSettings(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Address at which requests are accepted, and the leases."""

    address: Annotated[
        str | None,
        note(
            "ZeroMQ address of the ROUTER socket: ipc://PATH or tcp://127.0.0.1:PORT. null: a "
            "socket named control in the folder of the service or of the user."
        ),
    ] = None
    lease: Annotated[
        float,
        unit(
            "s",
            "Time after which an experiment that does not renew its lease ends; longer for slow "
            "links.",
            ge=MIN_LEASE_S,
            le=MAX_LEASE_S,
        ),
    ] = DEFAULT_LEASE_S


class NetworkSettings(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Access over the network, for clients with a key; all that they exchange is encrypted."""

    keys: Annotated[
        str | None,
        note(
            "Folder with fishd's key and the known keys of clients, written by 'fishctl keygen'; "
            "null: no access over the network."
        ),
    ] = None
    control: Annotated[str, note("Address of requests: tcp://HOST:PORT.")] = "tcp://0.0.0.0:9877"
    telemetry: Annotated[str, note("Address of telemetry: tcp://HOST:PORT.")] = "tcp://0.0.0.0:9878"


class RealtimeSettings(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Real-time scheduling; without the privilege, fishd warns once and continues."""

    priority: Annotated[
        int,
        note(
            "SCHED_FIFO priority; 0 keeps the normal scheduler. A priority above 50 needs a larger "
            "LimitRTPRIO than the 51 of the service: one more than the priority.",
            ge=0,
            le=99,
        ),
    ] = 50
    lock_memory: Annotated[bool, note("Keep fishd's memory from being paged out.")] = True


class Config(LoopSettings, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The whole configuration; `Config()` is a simulated fish at rest."""

    name: Annotated[
        Name | None,
        Meta(description="Name of the fish, in status and telemetry; null: this machine's name."),
    ] = None
    robot: Annotated[
        str,
        note(
            "Robot: simulated, a fish on its rod; pi, the robot on this Raspberry Pi; virtual-pi, "
            "a simulated fish behind the robot's drivers; swimmer, a fish that swims freely; or "
            "one of another package."
        ),
    ] = "simulated"
    robot_settings: Annotated[dict[str, Any], note("Settings of a robot of another package.")] = (
        msgspec.field(default_factory=dict)
    )
    start: Annotated[Start, note("Controller that is started with fishd.")] = Start()
    chatter: Annotated[ChatterSettings, note("Limits for a policy that reverses too fast.")] = (
        ChatterSettings()
    )
    lockstep: Annotated[
        bool,
        note(
            "Virtual time, for a simulated fish: while remote is active, each tick waits for "
            "its agent, and the next tick starts at once."
        ),
    ] = False
    estimator: Annotated[EstimatorSettings, note("Fin velocity and thrust from the forces.")] = (
        EstimatorSettings()
    )
    plant: Annotated[
        PlantParameters,
        note("Physics of the fish, for the simulated fish and for the model of the observer."),
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
    sensors: Annotated[
        Mapping[str, SensorSettings],
        note("Any number of other sensors, each a named section."),
    ] = {}
    panel: Annotated[
        PanelSettings, note("E-stop button and status light, if the robot has them.")
    ] = PanelSettings()
    state_folder: Annotated[
        str | None,
        note(
            "Folder for calibrations, with a subfolder for each robot; null for $STATE_DIRECTORY, "
            "else $XDG_STATE_HOME/fishd, else ~/.local/state/fishd."
        ),
    ] = None
    swimmer: Annotated[SwimmerSettings, note("The fish that swims freely, with robot swimmer.")] = (
        SwimmerSettings()
    )
    virtual_pi: Annotated[VirtualPiSettings, note("The virtual Pi, with robot virtual-pi.")] = (
        VirtualPiSettings()
    )
    telemetry: Annotated[TelemetrySettings, note("Publication of telemetry.")] = TelemetrySettings()
    control: Annotated[ControlSettings, note("Requests and leases.")] = ControlSettings()
    network: Annotated[NetworkSettings, note("Access over the network, with keys.")] = (
        NetworkSettings()
    )
    realtime: Annotated[RealtimeSettings, note("Scheduling and memory.")] = RealtimeSettings()

    @property
    def kind(self) -> type[RobotKind]:
        """Properties of the robot."""
        return find_kind(self.robot)

    @property
    def driver_settings(self) -> DriverSettings:
        """Settings of the drivers."""
        return DriverSettings(self.force_sensor, self.servo, self.sensors)

    @property
    def readings(self) -> dict[str, Reading]:
        """Readings of all sensors by name."""
        has_model = not self.kind.has_hardware and self.kind.is_tethered
        readings = {"power": POWER} if has_model and self.plant.model == TETHERED else {}
        for settings in self.sensors.values():
            readings |= readings_of(settings)
        return readings

    @property
    def limits(self) -> Limits:
        """Limits that controllers must respect."""
        return Limits(
            amplitude=self.amplitude_limit,
            tick=self.tick,
            scaled=self.estimator.kind != "lateral_force",
            virtual=self.lockstep or not self.kind.is_real_time,
            dwell=self._dwell,
            chatter=self.chatter,
            tethered=self.kind.is_tethered,
            thrust_coefficient=(
                self.plant.thrust_coefficient if self.estimator.kind == "observer" else None
            ),
            readings=tuple(self.readings),
        )

    @property
    def _dwell(self) -> float:
        """Shortest time between two reversals of a policy [s]."""
        if self.chatter.dwell != "auto":
            return self.chatter.dwell
        if not self.kind.is_tethered:  # it has muscles instead of a servo
            return DEFAULT_DWELL_S
        shortest = min(shortest_dwell(self.plant, self.amplitude_limit), MAX_DWELL_S)
        return round(math.ceil(shortest / self.tick - 1e-9) * self.tick, 9)


def service_file() -> Path | None:
    """Return the file that the fishd of this machine probably uses; None for the defaults.

    That is $FISHD_CONFIG if it is set (empty for none), else the file of the service if it exists.
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
        config = convert_sections(drop_empty_sections(data, Config))
        for check in CHECKS:
            check(config)
    except Problem as problem:
        raise ConfigError(problem.message_with_place(sources)) from None
    _warn_of_values(config, sources)
    return config


def read(
    path: str | os.PathLike[str], mistakes: list[str] | None = None
) -> tuple[dict[str, Any], dict[tuple[str, ...], str]]:
    """Return the content of a configuration file, and the place of each key.

    mistakes: list to which errors of single values are added; those values are left out
    Raises `ConfigError`.
    """
    return strict_yaml.read(path, "a configuration", "tick: 0.05", mistakes)


def _warn_of_values(config: Config, sources: Mapping[tuple[str, ...], str]) -> None:
    """Log a warning for each value that was set and is far from usual values."""
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
    """Raise `ConfigError` if the fish swims freely; what: name of what needs a tethered fish."""
    if not find_kind(robot).is_tethered:
        raise ConfigError(
            f"robot: {robot} is not valid for {what}, which needs the thrust of a tethered fish; "
            "set robot: simulated, or use 'fishctl simulate' for one that swims freely"
        )


Check = Callable[[Config], None]

CHECKS: tuple[Check, ...] = (
    lambda c: check_robot(c.robot, c.robot_settings),
    lambda c: check_readings(c.sensors),
    lambda c: check_start(c.start.controller, c.start.parameters, c.limits),
    lambda c: check_addresses(c.telemetry.address, c.control.address),
    lambda c: (
        check_network(c.telemetry.address, c.network.control, c.network.telemetry)
        if c.network.keys
        else None
    ),
    lambda c: check_state_folder(c.state_folder),
    lambda c: check_drivers(c.robot, c.tick, c.driver_settings),
    lambda c: check_neutral(c.servo),
    lambda c: check_plant(c.plant),
    lambda c: check_pulses(c.servo, c.amplitude_limit),
    lambda c: check_i2c_addresses(c.driver_settings.sections()),
    lambda c: check_pins(claims_of(c.driver_settings), c.panel),
    lambda c: check_lockstep(c.robot, c.lockstep),
    lambda c: check_estimator(c.robot, c.estimator.kind, c.plant),
    lambda c: check_virtual_pi(c.virtual_pi),
    lambda c: c.kind.check(c),
)
"""Checks of keys against each other, in order; each raises `Problem`."""


def adopt(data: dict[str, Any], overrides: Iterable[str] = ()) -> Config:
    """Return the configuration that a running fishd reports (`Fish.config`), with overrides.

    The checks across fields are not repeated, as fishd has done them. Raises `ConfigError`.
    """
    sources = apply_overrides(data, overrides)
    data = {**data, SENSOR_SECTIONS: _known_sensors(data.get(SENSOR_SECTIONS))}
    try:
        return convert_sections(data)
    except Problem as problem:
        place = sources.get(problem.path, "the configuration of the running fishd")
        raise ConfigError(problem.message_with_place({problem.path: place})) from None


def _known_sensors(sensors: Any) -> Any:
    """Return sections of sensors without those whose kind is not installed on this machine."""
    if not isinstance(sensors, Mapping):
        return sensors
    return {
        name: section
        for name, section in sensors.items()
        if not isinstance(section, Mapping) or SENSORS.has(str(section.get("kind")))
    }


def convert_sections(data: Mapping[str, Any]) -> Config:
    """Convert and validate each section separately; raise `Problem` for an invalid value."""
    common = {key: value for key, value in data.items() if key not in CHOICES}
    config = convert(common, Config, elsewhere=driver_keys)
    return msgspec.structs.replace(config, **convert_driver_sections(data, keys))


def keys() -> list[str]:
    """Return every key in dotted form, including those of all drivers and plants that load."""
    return list(dict.fromkeys(list_keys(Config) + driver_keys()))


def to_yaml(config: Config | dict[str, Any]) -> str:
    """Return the whole configuration with its defaults as YAML that `load` accepts."""
    return strict_yaml.dump(msgspec.to_builtins(config))


def json_schema() -> dict[str, Any]:
    """Return the JSON Schema of the configuration, with all drivers and plants that load."""
    choices = {section: settings_of_drivers(section) for section in CHOICES}
    types = [Config, *(struct for structs in choices.values() for struct in structs.values())]
    (top, *_), parts = msgspec.json.schema_components(types, ref_template="#/$defs/{name}")
    properties = parts["Config"]["properties"]
    properties["robot"]["enum"] = robots.registry().names()
    for section, structs in choices.items():
        refs = []
        for struct in dict.fromkeys(structs.values()):
            names = [name for name, settings in structs.items() if settings is struct]
            parts[struct.__name__]["properties"][CHOICES[section].key] = {"enum": names}
            refs.append({"$ref": f"#/$defs/{struct.__name__}"})
        default = {key: value for key, value in properties[section].items() if key == "default"}
        choice = {"anyOf": refs, **default}
        if section == SENSOR_SECTIONS:
            choice = {
                "type": "object",
                "additionalProperties": {"anyOf": [*refs, {"type": "null"}]},
            }
        properties[section] = choice
    return {**top, "$defs": parts}
