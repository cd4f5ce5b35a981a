"""The nouns that flow through fishd, from the force sensor to the wire.

Everything is SI: newtons, radians, seconds. `Tick`, `Event` and `Status` are exactly what goes out
over telemetry and the control channel, so their field names are the public protocol. The tables
of docs/reference/protocol.md are written from what is declared here (`make docs`).
"""

from typing import Annotated, Any, Literal, get_args

from msgspec import UNSET, Struct, UnsetType

from fishd.core.schema import Field, note, unit

MODES = "`idle`, `running`, `fault` or `estop`."


class Extremes(Struct, frozen=True, gc=False):
    """Lowest and highest single samples of a window [N]."""

    fx_min: float
    fx_max: float
    fy_min: float
    fy_max: float


class Measurement(Struct, frozen=True, gc=False):
    """What the force sensor says about the window since the previous read."""

    time: float
    """Time of the newest sample in the window [s, monotonic]."""
    fx: float
    """Mean longitudinal force of the window, thrust positive [N]."""
    fy: float
    """Mean lateral force of the window [N]."""
    samples: int
    """How many pairs of samples the means are taken over."""
    suspect: str = ""
    """Why these forces are not to be believed, such as a clipped sample; empty where they are."""
    extremes: Extremes | None = None
    """What the means are taken over, as far as the sensor tells."""
    fin_velocity: float | None = None
    """Fin angular velocity at the newest sample, where a sensor tells it [rad/s]."""


class Observation(Struct, frozen=True, gc=False):
    """What a controller knows when it chooses the next instruction angle."""

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
    """Fin angular velocity, up to an unknown positive scale; in rad/s with the observer, when the
    next instruction acts, and from a sensor, now."""
    instruction_angle: float
    """The instruction angle applied since the previous tick [rad]."""
    previous_angle: float
    """The instruction angle applied before that one, until the previous tick [rad]."""
    thrust: float
    """Mean longitudinal force over the latest whole tail beats [N]."""
    frequency: float
    """Tail-beat frequency, from the reversals of the instruction angle; 0 when not beating [Hz]."""
    thrust_factor: float | None = None
    """Thrust over the mean square of `fin_velocity`, as rests or a measurement have shown it [N];
    None while not known."""
    thrust_factor_error: float | None = None
    """Half of its 95 % interval [N]."""
    side_time: float = 0.0
    """How long the instruction angle has been on its side of neutral, negative where it is; up to
    2 s, and 0 at neutral [s]."""


class Course(Struct, frozen=True, gc=False):
    """Where a fish that swims freely is, and goes; x is against the way it began to swim."""

    x: float
    """[m]"""
    y: float
    """[m]"""
    speed: float
    """Forwards, along −x [m/s]."""
    heading: float
    """Of the front body against −x [rad]."""


class Truth(Struct, frozen=True, gc=False):
    """The true state of a simulated fish; a real one has none."""

    alpha: float
    """Fin angle [rad]."""
    alpha_rate: float
    """Fin angular velocity [rad/s]."""
    phi: float
    """Servo wheel angle [rad]; of a swimmer, Φ times the activation of its muscles."""
    course: Course | None = None
    """Where a fish goes that swims freely; None for one that is tethered."""


class Tick(Struct, frozen=True, gc=False):
    """One tick as everyone outside sees it; published on topic `tick`.

    `Reporter.tick` says where each field comes from.
    """

    t: Annotated[float, unit("s", "Time of the tick, unix.")]
    seq: Annotated[int, note("Number of the tick, from 1; a gap means that messages were lost.")]
    mode: Annotated[str, note(MODES)]
    controller: Annotated[str, note("Name of the controller that chose the command.")]
    fx: Annotated[float, unit("N", "Mean longitudinal force since the previous tick.")]
    fy: Annotated[float, unit("N", "Mean lateral force since the previous tick.")]
    fy_rate: Annotated[float, unit("N/s", "Rate of change of the lateral force.")]
    fin_velocity: Annotated[
        float,
        unit(
            "1",
            "Fin angular velocity as estimated, up to an unknown positive scale; with "
            "`estimator.kind: observer` in rad/s, and that after the servo's delay; with `sensor` "
            "in rad/s.",
        ),
    ]
    phi_c: Annotated[
        float, unit("rad", "Instruction angle that was sent to the servo in this tick.")
    ]
    servo_on: Annotated[bool, note("False once the servo is known to get no pulses.")]
    thrust: Annotated[
        float,
        unit(
            "N",
            "Thrust over the latest whole tail beats, the sensor's zero taken off; mean `fx` where "
            "that is not known.",
        ),
    ]
    frequency: Annotated[
        float, unit("Hz", "Tail-beat frequency, from reversals of `phi_c`; 0.0 when not beating.")
    ]
    samples: Annotated[int, note("Pairs of force samples since the previous tick.")]
    age_ms: Annotated[float, unit("ms", "Age of the newest force sample.")]
    lateness_us: Annotated[float, unit("µs", "How late after its deadline the tick began.")]
    busy_us: Annotated[float, unit("µs", "From the start of the tick until the servo was driven.")]
    missed: Annotated[int, note("Slots skipped since start.")]
    thrust_error: Annotated[
        float | UnsetType,
        unit("N", "Half of the 95 % interval of `thrust`; absent while the zero is not known."),
    ] = UNSET
    fx_min: Annotated[
        float | UnsetType, unit("N", "Lowest of these samples of F_x; not of a simulated fish.")
    ] = UNSET
    fx_max: Annotated[float | UnsetType, unit("N", "The highest of F_x.")] = UNSET
    fy_min: Annotated[float | UnsetType, unit("N", "The lowest of F_y.")] = UNSET
    fy_max: Annotated[float | UnsetType, unit("N", "The highest of F_y.")] = UNSET
    alpha: Annotated[
        float | UnsetType, unit("rad", "True fin angle; of a simulated fish only, as the next two.")
    ] = UNSET
    alpha_rate: Annotated[float | UnsetType, unit("rad/s", "True fin angular velocity.")] = UNSET
    phi: Annotated[float | UnsetType, unit("rad", "True servo wheel angle.")] = UNSET
    quantities: Annotated[
        dict[str, float] | UnsetType,
        note("The controller's own quantities, by name; absent where it has none to show."),
    ] = UNSET
    time: Annotated[
        float,
        unit(
            "s",
            "Time of the tick, on fishd's monotonic clock; virtual in lockstep and of a swimmer, "
            "whose second takes several of `t`.",
        ),
    ] = 0.0
    x: Annotated[
        float | UnsetType,
        unit("m", "Where the fish is; of a swimmer only, as the next three. It swims to −x."),
    ] = UNSET
    y: Annotated[float | UnsetType, unit("m", "Across it.")] = UNSET
    speed: Annotated[float | UnsetType, unit("m/s", "True speed, along −x.")] = UNSET
    heading: Annotated[
        float | UnsetType, unit("rad", "True heading of the front body, against −x.")
    ] = UNSET
    thrust_factor: Annotated[
        float | UnsetType,
        unit(
            "N",
            "Thrust over the mean square of `fin_velocity`, as rests or a measurement have shown "
            "it; absent while not known, and where no controller swims.",
        ),
    ] = UNSET
    thrust_factor_error: Annotated[float | UnsetType, unit("N", "Half of its 95 % interval.")] = (
        UNSET
    )
    power: Annotated[
        float | UnsetType,
        unit(
            "W",
            "Mean electrical power of the servo since the previous tick; absent without a power "
            "meter, or while it cannot be read.",
        ),
    ] = UNSET
    leak: Annotated[
        float | UnsetType,
        unit("s", "The leak in use, with `estimator.leak: auto`; absent with a number."),
    ] = UNSET
    fy_corrected: Annotated[
        bool | UnsetType,
        note(
            "True where estimator and controller were shown `fy` and `fy_rate` with the other "
            "sign; absent where unchanged. See `estimator.reversed_fy`."
        ),
    ] = UNSET
    suspect: Annotated[
        str | UnsetType,
        note(
            "Why `fx` and `fy` are not to be believed; absent where they are. Estimators and "
            "controllers then see those of the tick before."
        ),
    ] = UNSET


Level = Literal["info", "warning", "error"]
EventKind = Literal[
    "mode",
    "controller",
    "parameters",
    "fallback",
    "fault",
    "overrun",
    "servo",
    "power",
    "calibration",
    "gateway",
    "lease",
    "lease-expired",
    "mark",
]
EVENTS: tuple[tuple[EventKind, str, str, str], ...] = (
    ("mode", "info; error for estop", "another mode except `fault`", "`before`, `mode`"),
    ("controller", "info", "a controller takes over", "`controller`, `parameters`"),
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
        "`controller`, `parameters` (of who takes over), `before`, `code`",
    ),
    ("fault", "error", "mode `fault` was entered", "`code`, `mode`"),
    (
        "overrun",
        "warning",
        "a tick took longer than a period, or slots were skipped",
        "`seq`, `missed` (just before it)",
    ),
    (
        "servo",
        "error",
        "in mode `fault` or `estop`: the servo cannot be released and may still have pulses",
        "empty",
    ),
    ("servo", "info", "a servo that could not be reached can be reached again", "empty"),
    ("power", "warning", "the power meter cannot be read; the fish swims on", "empty"),
    ("power", "info", "a power meter that could not be read can be read again", "empty"),
    ("calibration", "info", "another calibration was saved and is used now", "`file`"),
    (
        "calibration",
        "info; warning where it was not given up",
        "a trial of a calibration ended, and the one before it is used again",
        "empty",
    ),
    (
        "calibration",
        "warning",
        "the controller of `start` does not begin after its rest: the servo was calibrated",
        "empty",
    ),
    ("calibration", "warning", "when the tail set off, F_y was seen to be reversed", "empty"),
    (
        "gateway",
        "warning",
        "the process behind a socket was started again; messages were lost",
        "`gateway`: `telemetry` or `control`",
    ),
    (
        "lease",
        "info",
        "an experiment took the fish, gave it back, or lost it to another request",
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
"""Kind, level, when, data: each kind of event."""


class Event(Struct, frozen=True):
    """Something that happened; published on topic `event` and logged."""

    t: Annotated[float, unit("s", "When, unix.")]
    level: Annotated[str, note(f"One of {', '.join(get_args(Level))}.")]
    kind: Annotated[str, note(f"One of {', '.join(get_args(EventKind))}.")]
    message: Annotated[str, note("One line for people.")]
    data: Annotated[dict[str, Any], note("The same for programs.")] = {}


class QuantityInfo(Struct, frozen=True):
    """A controller's own quantity as a person wants to know it."""

    name: str
    unit: str
    """In SI notation, `1` for a pure number."""
    description: str


class ControllerInfo(Struct, frozen=True):
    """A controller as a person or an option parser wants to know it."""

    name: str
    summary: str
    """One line that says what it does."""
    parameters: tuple[Field, ...]
    quantities: tuple[QuantityInfo, ...] = ()


class Reason(Struct, frozen=True):
    """Why fishd is in mode fault or estop."""

    code: Annotated[str, note("Short name, such as `sensor-stale`.")]
    message: Annotated[str, note("One line that says what happened.")]
    remedy: Annotated[str, note("What to do about it, before `fishctl clear-fault`.")] = ""


class LeaseHolder(Struct, frozen=True):
    """The experiment that holds the lease of the fish, in its own words."""

    name: Annotated[str, note("What it calls itself, such as `measure`.")]
    host: Annotated[str, note("The machine on which it runs.")]
    pid: Annotated[int, note("Its process there.")]
    age: Annotated[float, unit("s", "Time since it took the fish.")]

    def __str__(self) -> str:
        """Return it in words, without the age."""
        where = [f"pid {self.pid}"] * bool(self.pid) + [f"on {self.host}"] * bool(self.host)
        return f"{self.name} ({' '.join(where)})" if where else self.name

    def refusal(self) -> str:
        """Return why another experiment cannot have the fish."""
        return (
            f"the fish is taken, for {self.age:.0f} s: by {self}; wait for its end, or take the "
            "fish from it: with --take, or by hand with 'fishctl stop'"
        )


class Percentiles(Struct, frozen=True):
    """Distribution of a duration since start."""

    p50: Annotated[float, unit("µs", "Median, at most 12 % too high.")]
    p99: Annotated[float, unit("µs", "99th percentile, at most 12 % too high.")]
    worst: Annotated[float, unit("µs", "The longest, exact.")]
    worst_seq: Annotated[int, note("Number of the tick of `worst`.")]


class Timing(Struct, frozen=True):
    """How well the loop keeps its time."""

    lateness: Annotated[Percentiles, note("Start of a tick after its deadline.")]
    busy: Annotated[Percentiles, note("A whole tick, publishing included.")]
    phases: Annotated[
        dict[str, Percentiles],
        note("Each phase of a tick: `read`, `estimate`, `update`, `write`, `publish`."),
    ]


class Status(Struct, frozen=True):
    """The daemon in one snapshot; published on topic `status`, and the answer to `status`.

    `Operations.status` says where each field comes from.
    """

    t: Annotated[float, unit("s", "When the snapshot was taken, unix.")]
    version: Annotated[str, note("Version of fishd.")]
    pid: Annotated[int, note("Its process.")]
    uptime: Annotated[float, unit("s", "Since start.")]
    mode: Annotated[str, note(MODES)]
    reason: Annotated[Reason | None, note("Why, in mode fault and estop.")]
    controller: Annotated[str, note("The active controller; `hold` unless running.")]
    parameters: Annotated[dict[str, Any], note("All its parameters.")]
    servo_on: Annotated[bool, note("False once the servo is known to get no pulses.")]
    thrust: Annotated[float, unit("N", "As in `tick`.")]
    frequency: Annotated[float, unit("Hz", "As in `tick`.")]
    tick: Annotated[float, unit("s", "Period of the loop.")]
    amplitude_limit: Annotated[float, unit("rad", "The limit Φ of any angle.")]
    lowest: Annotated[
        float, unit("rad", "Lowest angle that Φ, soft limits and pulse widths permit.")
    ]
    highest: Annotated[float, unit("rad", "The highest that they permit.")]
    seq: Annotated[int, note("Number of the latest tick.")]
    missed: Annotated[int, note("Slots skipped since start.")]
    overruns: Annotated[int, note("Ticks that took longer than a period, since start.")]
    timing: Annotated[Timing, note("How well the loop keeps its time, since start.")]
    robot: Annotated[str, note("What is driven: `simulated`, `pi`, `virtual-pi` or `swimmer`.")]
    degraded: Annotated[
        tuple[str, ...], note("What keeps the robot from being as good as it could be.")
    ]
    counters: Annotated[dict[str, int], note("What was survived since start, by name.")]
    realtime: Annotated[bool, note("True under real-time scheduling.")]
    telemetry: Annotated[str, note("Address of the telemetry socket.")]
    servo_lost: Annotated[
        bool,
        note("True while the servo cannot be reached; with `servo_on`, it may still have pulses."),
    ] = False
    calibrating: Annotated[bool, note("True while a client tries a calibration of the servo.")] = (
        False
    )
    fallback: Annotated[
        Reason | None,
        note("Why the active controller took over from the one that was set, if it did."),
    ] = None
    sensor_lost: Annotated[
        bool,
        note("True while there is no force to believe; `thrust` is then that of the time before."),
    ] = False
    name: Annotated[
        str, note("Name of the fish: `name` in the configuration, else the machine's.")
    ] = ""
    phi_c: Annotated[float, unit("rad", "As in `tick`.")] = 0.0
    force_unit: Annotated[
        str,
        note(
            "Unit of forces and thrust: `N`; `V`, or the driver's, until the sensor is calibrated."
        ),
    ] = "N"
    thrust_error: Annotated[
        float | None,
        unit("N", "Half of the 95 % interval of `thrust`; null while the zero is not known."),
    ] = None
    quantities: Annotated[
        dict[str, float], note("The active controller's own quantities, as in `tick`.")
    ] = {}
    quantity_units: Annotated[
        dict[str, str], note("Unit of each quantity that this controller has; `1` for none.")
    ] = {}
    clock: Annotated[
        float, unit("s", "When the snapshot was taken, on fishd's monotonic clock.")
    ] = 0.0
    speed: Annotated[
        float | None, unit("m/s", "As in `tick`; null for a fish that is tethered.")
    ] = None
    power: Annotated[
        float | None,
        unit("W", "Mean of `power` over the last 2 s; null where it is not known."),
    ] = None
    boot: Annotated[
        str, note("Names this start of fishd's machine, from which its monotonic clock counts.")
    ] = ""
    fy_reversed: Annotated[
        bool | None,
        note(
            "Is the measured F_y reversed against the tail? Seen when the tail set off from "
            "rest; null while it was not seen."
        ),
    ] = None
    leak: Annotated[
        float | None, unit("s", "As in `tick`; null where `estimator.leak` is a number.")
    ] = None
    lease: Annotated[
        LeaseHolder | None,
        note("The experiment that drives the fish under a [lease](#leases); null without one."),
    ] = None
    lease_expired: Annotated[
        Reason | None,
        note("Why the fish rests, where the latest lease was not renewed; null otherwise."),
    ] = None
