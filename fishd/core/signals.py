"""Data types that flow through fishd, from the force sensor to the sockets.

All values are in SI units: newtons, radians, seconds. `Tick`, `Event` and `Status` are sent
unchanged over telemetry and the control channel, so their field names are the public protocol.
The tables of docs/reference/protocol.md are generated from the declarations here (`make docs`).
"""

import math
from typing import Annotated, Any, Literal, Protocol, get_args

from msgspec import UNSET, Struct, UnsetType

from fishd.core.schema import Field, Reading, note, unit

MODES = "`idle`, `running`, `fault` or `estop`."


class Extremes(Struct, frozen=True, gc=False):
    """Lowest and highest single samples of a window [N]."""

    fx_min: float
    fx_max: float
    fy_min: float
    fy_max: float


class Measurement(Struct, frozen=True, gc=False):
    """Reading of the force sensor over the window since the previous read."""

    time: float
    """Time of the newest sample in the window [s, monotonic]."""
    fx: float
    """Mean longitudinal force of the window, thrust positive [N]."""
    fy: float
    """Mean lateral force of the window [N]."""
    samples: int
    """Number of sample pairs in the means."""
    suspect: str | None = None
    """Reason not to trust these forces, such as a clipped sample; None if there is none."""
    extremes: Extremes | None = None
    """Extremes of the samples in the means, if the sensor provides them."""
    fin_velocity: float | None = None
    """Fin angular velocity at the newest sample, if a sensor measures it [rad/s]."""
    mean_time: float | None = None
    """Mean time of the samples in the means [s, monotonic]; None if unknown."""
    span: float = 0.0
    """Time over which the samples are spread evenly, half of it after `mean_time` [s]."""


MAX_SIDE_TIME_S = 2.0
"""Largest `side_time`; a tail that stays longer on one side does not beat [s]."""


class Observation(Struct, frozen=True, gc=False):
    """Input of a controller for the choice of the next instruction angle."""

    time: float
    """Time of this tick [s, monotonic]."""
    dt: float
    """Time since the previous tick: one period, more after missed slots [s]."""
    fx: float
    """Mean longitudinal force since the previous tick [N]."""
    fy: float
    """Mean lateral force since the previous tick [N]."""
    fy_rate: float
    """Rate of change of the lateral force [N/s]."""
    fin_velocity: float
    """Fin angular velocity, up to an unknown positive scale; in rad/s from the observer, which
    predicts it for the time at which the next instruction acts, and from a sensor, which measures
    it at this tick."""
    instruction_angle: float
    """The instruction angle applied since the previous tick [rad]."""
    previous_angle: float
    """The instruction angle applied before that one, until the previous tick [rad]."""
    thrust: float
    """Mean longitudinal force over the latest whole tail beats [N]."""
    frequency: float
    """Tail-beat frequency, from the reversals of the instruction angle; 0 without beats [Hz]."""
    thrust_factor: float | None = None
    """Ratio of thrust to the mean square of `fin_velocity`, from rests or a measurement [N]; None
    while unknown."""
    thrust_factor_ci95: float | None = None
    """Half-width of the 95 % confidence interval of `thrust_factor` [N]."""
    side_time: float = 0.0
    """Time since the instruction angle came to its side of neutral, with the sign of the angle; at
    most 2 s, and 0 at neutral [s]."""
    readings: dict[str, float] = {}
    """Readings of the sensors by name, such as `water_temperature`, without old ones."""


class Course(Struct, frozen=True, gc=False):
    """Position and motion of a free fish; the x axis points against its initial direction."""

    x: float
    """[m]"""
    y: float
    """[m]"""
    speed: float
    """Forward speed, along −x [m/s]."""
    heading: float
    """Angle of the front body to −x [rad]."""


class Truth(Struct, frozen=True, gc=False):
    """True state of a simulated fish; unknown for a real one."""

    alpha: float
    """Fin angle [rad]."""
    alpha_rate: float
    """Fin angular velocity [rad/s]."""
    phi: float
    """Servo wheel angle [rad]; for a free fish, Φ times the activation of its muscles."""
    course: Course | None = None
    """Course of a free fish; None for a tethered fish."""


class Tick(Struct, frozen=True, gc=False):
    """Telemetry of one tick; published on topic `tick`.

    `ControlLoop._record` fills each field, with `Perception.telemetry`.
    """

    t: Annotated[float, unit("s", "Time of the tick, unix.")]
    seq: Annotated[int, note("Number of the tick, from 1; a gap means lost messages.")]
    mode: Annotated[str, note(MODES)]
    controller: Annotated[str, note("Name of the controller that chose `phi_c`.")]
    fx: Annotated[float, unit("N", "Mean longitudinal force since the previous tick.")]
    fy: Annotated[float, unit("N", "Mean lateral force since the previous tick.")]
    fy_rate: Annotated[float, unit("N/s", "Rate of change of the lateral force.")]
    fin_velocity: Annotated[
        float,
        unit(
            "1",
            "Estimated fin angular velocity, up to an unknown positive scale; in rad/s with "
            "`estimator.kind: observer`, which predicts it over the servo's delay, and with "
            "`sensor`.",
        ),
    ]
    phi_c: Annotated[
        float, unit("rad", "Instruction angle that was sent to the servo in this tick.")
    ]
    servo_on: Annotated[bool, note("False if it is certain that the servo gets no pulses.")]
    thrust: Annotated[
        float,
        unit(
            "N",
            "Mean thrust over the latest whole tail beats, without the sensor's zero; mean `fx` "
            "while that is unknown.",
        ),
    ]
    frequency: Annotated[
        float, unit("Hz", "Tail-beat frequency, from reversals of `phi_c`; 0.0 without beats.")
    ]
    samples: Annotated[int, note("Pairs of force samples since the previous tick.")]
    sample_age_ms: Annotated[float, unit("ms", "Age of the newest force sample.")]
    lateness_us: Annotated[float, unit("µs", "Delay of the start of the tick after its deadline.")]
    busy_time_us: Annotated[
        float, unit("µs", "Time from the start of the tick until the servo was driven.")
    ]
    missed_slots: Annotated[int, note("Number of slots skipped since start.")]
    thrust_ci95: Annotated[
        float | UnsetType,
        unit(
            "N",
            "Half-width of the 95 % confidence interval of `thrust`; absent while the zero is "
            "unknown.",
        ),
    ] = UNSET
    fx_min: Annotated[
        float | UnsetType,
        unit("N", "Lowest sample of F_x since the previous tick; absent for a simulated fish."),
    ] = UNSET
    fx_max: Annotated[float | UnsetType, unit("N", "Highest sample of F_x.")] = UNSET
    fy_min: Annotated[float | UnsetType, unit("N", "Lowest sample of F_y.")] = UNSET
    fy_max: Annotated[float | UnsetType, unit("N", "Highest sample of F_y.")] = UNSET
    alpha: Annotated[
        float | UnsetType,
        unit("rad", "True fin angle; only of a simulated fish, like the next two."),
    ] = UNSET
    alpha_rate: Annotated[float | UnsetType, unit("rad/s", "True fin angular velocity.")] = UNSET
    phi: Annotated[float | UnsetType, unit("rad", "True servo wheel angle.")] = UNSET
    quantities: Annotated[
        dict[str, float] | UnsetType,
        note("Quantities of the controller, by name; absent if it has none."),
    ] = UNSET
    time: Annotated[
        float,
        unit(
            "s",
            "Time of the tick, on fishd's monotonic clock; virtual in lockstep and of a free fish, "
            "for which a second takes several seconds of `t`.",
        ),
    ] = 0.0
    x: Annotated[
        float | UnsetType,
        unit("m", "Position; only of a free fish, like the next three. It swims towards −x."),
    ] = UNSET
    y: Annotated[float | UnsetType, unit("m", "Position across the direction of swimming.")] = UNSET
    speed: Annotated[float | UnsetType, unit("m/s", "True speed, along −x.")] = UNSET
    heading: Annotated[
        float | UnsetType, unit("rad", "True heading of the front body: its angle to −x.")
    ] = UNSET
    thrust_factor: Annotated[
        float | UnsetType,
        unit(
            "N",
            "Ratio of thrust to the mean square of `fin_velocity`, from rests or a measurement; "
            "absent while unknown, and while no controller swims.",
        ),
    ] = UNSET
    thrust_factor_ci95: Annotated[
        float | UnsetType,
        unit("N", "Half-width of the 95 % confidence interval of `thrust_factor`."),
    ] = UNSET
    readings: Annotated[
        dict[str, float] | UnsetType,
        note(
            "Readings of the sensors by name, without old ones; absent without sensors. `power` is "
            "the electrical power of the servo [W]. Status has their units."
        ),
    ] = UNSET
    leak: Annotated[
        float | UnsetType,
        unit("s", "Active leak time, with `estimator.leak: auto`; absent with a number."),
    ] = UNSET
    fy_corrected: Annotated[
        bool | UnsetType,
        note(
            "True if estimator and controller got `fy` and `fy_rate` with the opposite sign; "
            "absent otherwise. See `estimator.reversed_fy`."
        ),
    ] = UNSET
    suspect: Annotated[
        str | UnsetType,
        note(
            "Reason not to trust `fx` and `fy`; absent if there is none. Estimators and "
            "controllers then get the values of the previous tick."
        ),
    ] = UNSET
    force_age_ms: Annotated[
        float | UnsetType,
        unit(
            "ms",
            "Mean age of the samples of `fx` and `fy` at `time`: the forces are those at `time` "
            "minus this; absent before the first sample.",
        ),
    ] = UNSET
    force_span_ms: Annotated[
        float | UnsetType,
        unit("ms", "Time over which these samples are spread evenly, around that instant."),
    ] = UNSET


def reading_of(readings: dict[str, float] | UnsetType, name: str) -> float:
    """Return a reading of a tick by its name; NaN if it is absent."""
    return math.nan if readings is UNSET else readings.get(name, math.nan)


Level = Literal["info", "warning", "error"]
EventKind = Literal[
    "mode",
    "controller",
    "parameters",
    "fallback",
    "fault",
    "overrun",
    "servo",
    "sensor",
    "calibration",
    "gateway",
    "sockets",
    "lease",
    "lease-expired",
    "mark",
]
EVENTS: tuple[tuple[EventKind, str, str, str], ...] = (
    ("mode", "info; error for estop", "another mode except `fault`", "`before`, `mode`"),
    ("controller", "info", "another controller takes over", "`controller`, `parameters`"),
    (
        "parameters",
        "info",
        "parameters of the active controller changed",
        "`controller`, `parameters`",
    ),
    (
        "fallback",
        "warning",
        "the active controller gave up and another one took over, as `ppo` may",
        "`controller`, `parameters` (of the new controller), `before`, `code`",
    ),
    ("fault", "error", "mode `fault` was entered", "`code`, `mode`"),
    (
        "overrun",
        "warning",
        "a tick took longer than a period, or slots were skipped",
        "`seq`, `missed_slots` (skipped just before it)",
    ),
    (
        "servo",
        "error",
        "in mode `fault` or `estop`: the servo cannot be released and may still get pulses",
        "empty",
    ),
    ("servo", "info", "the servo can be reached again", "empty"),
    ("sensor", "warning", "a sensor gives no readings, or a doubtful one", "`sensor`: its name"),
    ("sensor", "info", "that sensor gives good readings again", "`sensor`: its name"),
    ("calibration", "info", "another calibration was saved and is used now", "`file`"),
    (
        "calibration",
        "info; warning if the client did not end it",
        "a trial of a calibration ended, and the previous calibration is active again",
        "empty",
    ),
    (
        "calibration",
        "warning",
        "the controller of `start` does not begin after its initial rest: the servo was calibrated",
        "empty",
    ),
    (
        "calibration",
        "warning",
        "the first movement of the tail showed that F_y is reversed",
        "empty",
    ),
    (
        "gateway",
        "warning",
        "the process that has the sockets was restarted; messages were lost",
        "`gateway`: `local`, or `network` for clients with a key",
    ),
    (
        "sockets",
        "warning; error if they cannot be created",
        "files of sockets, or their folder, were gone: they were created again, or the fish fades "
        "to neutral unless an experiment holds it",
        "`control`: address of the control socket, empty without one",
    ),
    (
        "lease",
        "info",
        "an experiment took or returned the fish, or lost it to another request",
        "`lease`: `taken`, `returned` or `lost`; `name`, `host`, `pid`",
    ),
    (
        "lease-expired",
        "warning",
        "an experiment did not renew its lease: the fish fades to neutral",
        "`name`, `host`, `pid`",
    ),
    ("mark", "info", "a client asked for a mark", "empty"),
)
"""Kind, level, condition and data of each kind of event."""


class Event(Struct, frozen=True):
    """An event; published on topic `event` and logged."""

    t: Annotated[float, unit("s", "Time of the event, unix.")]
    level: Annotated[str, note(f"One of {', '.join(get_args(Level))}.")]
    kind: Annotated[str, note(f"One of {', '.join(get_args(EventKind))}.")]
    message: Annotated[str, note("Description in one line.")]
    data: Annotated[dict[str, Any], note("Details for programs.")] = {}
    time: Annotated[
        float, unit("s", "Time of the event, on fishd's monotonic clock, as `time` of a tick.")
    ] = 0.0


class QuantityInfo(Struct, frozen=True):
    """Description of a quantity that a controller computes."""

    name: str
    unit: str
    """Unit in SI notation, `1` for a pure number."""
    description: str


class ControllerInfo(Struct, frozen=True):
    """Description of a controller, for help texts and option parsers."""

    name: str
    summary: str
    """Description in one line."""
    parameters: tuple[Field, ...]
    quantities: tuple[QuantityInfo, ...] = ()


class Reason(Struct, frozen=True):
    """Reason why fishd is in mode fault or estop."""

    code: Annotated[str, note("Short name, such as `sensor-stale`.")]
    message: Annotated[str, note("Description in one line.")]
    remedy: Annotated[str, note("Remedy to apply before `fishctl clear-fault`.")] = ""


class LeaseHolder(Struct, frozen=True):
    """The experiment that holds the lease of the fish, as it describes itself."""

    name: Annotated[str, note("Name of the experiment, such as `measure`.")]
    host: Annotated[str, note("Name of its machine.")]
    pid: Annotated[int, note("Its process id there.")]
    age: Annotated[float, unit("s", "Time since it took the fish.")]

    def __str__(self) -> str:
        """Return name, process and machine, without the age."""
        origin = [f"pid {self.pid}"] * bool(self.pid) + [f"on {self.host}"] * bool(self.host)
        return f"{self.name} ({' '.join(origin)})" if origin else self.name

    def refusal(self) -> str:
        """Return the refusal for another experiment."""
        return (
            f"the fish is taken, for {self.age:.0f} s: by {self}; wait for its end, or take the "
            "fish from it: with --take, or by hand with 'fishctl stop'"
        )


class Percentiles(Struct, frozen=True):
    """Distribution of a duration since start."""

    p50: Annotated[float, unit("µs", "Median, at most 12 % too high.")]
    p99: Annotated[float, unit("µs", "99th percentile, at most 12 % too high.")]
    max: Annotated[float, unit("µs", "Maximum, exact.")]
    max_seq: Annotated[int, note("Number of the tick of `max`.")]


class Timing(Struct, frozen=True):
    """Timing of the loop."""

    lateness: Annotated[Percentiles, note("Delay of the start of a tick after its deadline.")]
    duration: Annotated[Percentiles, note("Duration of a whole tick, publishing included.")]
    phases: Annotated[
        dict[str, Percentiles],
        note(
            "Durations of the phases of a tick: `read`, `estimate`, `update`, `write`, `publish`."
        ),
    ]


class Publisher(Protocol):
    """The receiver of ticks and events; must not block."""

    def tick(self, tick: Tick) -> None:
        """Publish one tick."""

    def event(self, event: Event) -> None:
        """Publish one event."""


class ReadingState(Reading, frozen=True, kw_only=True):
    """A reading of a sensor, with its description."""

    sensor: Annotated[str, note("Name of its sensor in the configuration.")]
    value: Annotated[
        float | None, note("Mean over the last 2 s, in its unit; null while it is old or unknown.")
    ]
    age: Annotated[float | None, unit("s", "Age of its newest sample; null before the first one.")]
    problem: Annotated[str | None, note("Reason why it is old or doubtful; null for neither.")]


class Status(Struct, frozen=True):
    """Snapshot of the daemon; published on topic `status`, and the result of `status`.

    `Operations.status` fills each field.
    """

    t: Annotated[float, unit("s", "Time of the snapshot, unix.")]
    version: Annotated[str, note("Version of fishd.")]
    pid: Annotated[int, note("Process id of fishd.")]
    uptime: Annotated[float, unit("s", "Time since start.")]
    mode: Annotated[str, note(MODES)]
    reason: Annotated[Reason | None, note("Reason of mode fault or estop; else null.")]
    controller: Annotated[str, note("The active controller; `hold` unless running.")]
    parameters: Annotated[dict[str, Any], note("All parameters of the controller.")]
    servo_on: Annotated[bool, note("False if it is certain that the servo gets no pulses.")]
    thrust: Annotated[float, unit("N", "As in `tick`.")]
    frequency: Annotated[float, unit("Hz", "As in `tick`.")]
    tick: Annotated[float, unit("s", "Period of the loop.")]
    amplitude_limit: Annotated[float, unit("rad", "Limit Φ of the magnitude of any angle.")]
    lowest_angle: Annotated[
        float, unit("rad", "Lowest angle that Φ, soft limits and pulse widths permit.")
    ]
    highest_angle: Annotated[float, unit("rad", "Highest angle that they permit.")]
    seq: Annotated[int, note("Number of the latest tick.")]
    missed_slots: Annotated[int, note("Number of slots skipped since start.")]
    overruns: Annotated[int, note("Number of ticks that took longer than a period, since start.")]
    timing: Annotated[Timing, note("Timing of the loop since start.")]
    robot: Annotated[str, note("The robot, as `robot` in the configuration.")]
    limitations: Annotated[tuple[str, ...], note("Limitations of this robot.")]
    recovered_errors: Annotated[
        dict[str, int], note("Number of errors that fishd recovered from since start, by name.")
    ]
    realtime: Annotated[bool, note("True under real-time scheduling.")]
    telemetry: Annotated[str, note("Address of the telemetry socket.")]
    servo_lost: Annotated[
        bool,
        note("True while the servo cannot be reached; with `servo_on`, it may still get pulses."),
    ] = False
    calibrating: Annotated[bool, note("True while a servo calibration is on trial.")] = False
    fallback: Annotated[
        Reason | None,
        note("Reason why the active controller replaced the one that was set; else null."),
    ] = None
    sensor_lost: Annotated[
        bool, note("True while no force can be trusted; `thrust` is then the last known one.")
    ] = False
    name: Annotated[
        str, note("Name of the fish: `name` in the configuration, else the name of the machine.")
    ] = ""
    phi_c: Annotated[float, unit("rad", "As in `tick`.")] = 0.0
    force_unit: Annotated[
        str,
        note("Unit of forces and thrust: `N`; `V` or the unit of the driver before a calibration."),
    ] = "N"
    thrust_ci95: Annotated[
        float | None,
        unit(
            "N",
            "Half-width of the 95 % confidence interval of `thrust`; null while the zero is "
            "unknown.",
        ),
    ] = None
    quantities: Annotated[
        dict[str, float], note("Quantities of the active controller, as in `tick`.")
    ] = {}
    quantity_units: Annotated[
        dict[str, str], note("Unit of each quantity of this controller; `1` for none.")
    ] = {}
    clock: Annotated[float, unit("s", "Time of the snapshot, on fishd's monotonic clock.")] = 0.0
    speed: Annotated[float | None, unit("m/s", "As in `tick`; null for a tethered fish.")] = None
    readings: Annotated[
        dict[str, ReadingState], note("[Readings](#readings) of the sensors by name.")
    ] = {}
    boot_id: Annotated[
        str,
        note("Identifier of the boot of fishd's machine, from which its monotonic clock counts."),
    ] = ""
    fy_reversed: Annotated[
        bool | None,
        note(
            "Whether the measured F_y is reversed against the tail; null until the tail has moved "
            "from rest."
        ),
    ] = None
    leak: Annotated[
        float | None, unit("s", "As in `tick`; null if `estimator.leak` is a number.")
    ] = None
    lease: Annotated[
        LeaseHolder | None,
        note("The experiment that drives the fish under a [lease](#leases); null without one."),
    ] = None
    lease_expiry: Annotated[
        Reason | None,
        note(
            "Reason why the fish rests after a lease that was not renewed, or because no client "
            "could connect; null otherwise."
        ),
    ] = None
    keyed_telemetry: Annotated[
        str, note("Address of telemetry for [clients with a key](#keys); empty for none.")
    ] = ""
    control: Annotated[
        str, note("Address of the control socket; empty while its file cannot be created.")
    ] = ""

    def shows_restart_since(self, earlier: "Status") -> bool:
        """Return whether this is the status of another fishd than the one of `earlier`."""
        return self.pid != earlier.pid or self.uptime < earlier.uptime
