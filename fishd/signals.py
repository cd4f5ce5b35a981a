"""The nouns that flow through fishd, from the force sensor to the wire.

Everything is SI: newtons, radians, seconds. `Tick`, `Event` and `Status` are exactly what goes out
over telemetry and the control channel, so their field names are the public protocol.
"""

from typing import Any

from msgspec import UNSET, Struct, UnsetType

from fishd.schema import Field


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
    """Fin angular velocity up to an unknown positive scale; its sign is that of the true one."""
    instruction_angle: float
    """The instruction angle in force since the previous tick [rad]."""
    previous_angle: float
    """The instruction angle in force before that one, until the previous tick [rad]."""
    thrust: float
    """Mean longitudinal force over the latest whole tail beats [N]."""
    frequency: float
    """Tail-beat frequency, from the reversals of the instruction angle; 0 when not beating [Hz]."""


class Truth(Struct, frozen=True, gc=False):
    """The true state of a simulated fish; a real one has none."""

    alpha: float
    """Fin angle [rad]."""
    alpha_rate: float
    """Fin angular velocity [rad/s]."""
    phi: float
    """Servo wheel angle [rad]."""


class Tick(Struct, frozen=True, gc=False):
    """One tick as everyone outside sees it; published on topic `tick`."""

    t: float
    """Time of the tick [s, unix]."""
    seq: int
    """Number of this tick, from 1; a gap means that messages were lost on the way."""
    mode: str
    """idle, running, fault or estop."""
    controller: str
    """Name of the controller that chose the command."""
    fx: float
    """Mean longitudinal force since the previous tick [N]."""
    fy: float
    """Mean lateral force since the previous tick [N]."""
    fy_rate: float
    """Rate of change of the lateral force [N/s]."""
    fin_velocity: float
    """Fin angular velocity as estimated, up to a positive scale."""
    phi_c: float
    """The instruction angle that was sent to the servo in this tick, after the guard [rad]."""
    servo_on: bool
    """False once the servo is known to get no pulses."""
    thrust: float
    """Mean longitudinal force over the latest whole tail beats [N]."""
    frequency: float
    """Tail-beat frequency, from reversals of the instruction angle; 0 when not beating [Hz]."""
    samples: int
    """Pairs of force samples since the previous tick."""
    age_ms: float
    """Age of the newest force sample [ms]."""
    lateness_us: float
    """How late after its deadline the tick began [µs]."""
    busy_us: float
    """Time from the start of the tick until this record was sealed, publishing excluded [µs]."""
    missed: int
    """Slots skipped since start because a tick or the machine was late."""
    fx_min: float | UnsetType = UNSET
    """Lowest sample of F_x since the previous tick; left out by a simulated fish [N]."""
    fx_max: float | UnsetType = UNSET
    fy_min: float | UnsetType = UNSET
    fy_max: float | UnsetType = UNSET
    alpha: float | UnsetType = UNSET
    """True fin angle, simulated fish only [rad]."""
    alpha_rate: float | UnsetType = UNSET
    """True fin angular velocity, simulated fish only [rad/s]."""
    phi: float | UnsetType = UNSET
    """True servo wheel angle, simulated fish only [rad]."""


class Event(Struct, frozen=True):
    """Something that happened; published on topic `event` and logged."""

    t: float
    """When [s, unix]."""
    level: str
    """info, warning or error."""
    kind: str
    """mode, controller, parameters, fallback, fault, overrun, servo, calibration, gateway, mark."""
    message: str
    """One line for people."""
    data: dict[str, Any] = {}
    """The same for programs."""


class ControllerInfo(Struct, frozen=True):
    """A controller as a person or an option parser wants to know it."""

    name: str
    summary: str
    """One line that says what it does."""
    parameters: tuple[Field, ...]


class Reason(Struct, frozen=True):
    """Why fishd is in mode fault or estop."""

    code: str
    """Short name, such as sensor-stale."""
    message: str
    """One line that says what happened."""


class Percentiles(Struct, frozen=True):
    """Distribution of a duration since start [µs], within 12 %; the worst is exact."""

    p50: float
    p99: float
    worst: float
    worst_seq: int
    """Number of the tick that was the worst."""


class Timing(Struct, frozen=True):
    """How well the loop keeps its time."""

    lateness: Percentiles
    """Start of the tick after its deadline."""
    busy: Percentiles
    """Whole tick, from its start until everything is published."""
    phases: dict[str, Percentiles]
    """The same for each phase of a tick: read, estimate, update, write, publish."""


class Status(Struct, frozen=True):
    """The daemon in one snapshot; published on topic `status`, and the answer to `status`."""

    t: float
    """When the snapshot was taken [s, unix]."""
    version: str
    pid: int
    uptime: float
    """[s]"""
    mode: str
    reason: Reason | None
    """Why, in mode fault and estop."""
    controller: str
    parameters: dict[str, Any]
    """Parameters of the running controller."""
    servo_on: bool
    """False once the servo is known to get no pulses."""
    thrust: float
    """[N]"""
    frequency: float
    """[Hz]"""
    tick: float
    """Period of the loop [s]."""
    amplitude_limit: float
    """[rad]"""
    lowest: float
    """Lowest instruction angle that Φ, soft limits and pulse widths permit [rad]."""
    highest: float
    """Highest instruction angle that they permit [rad]."""
    seq: int
    """Number of the latest tick."""
    missed: int
    """Slots skipped since start."""
    overruns: int
    """Ticks that took longer than a period, since start."""
    timing: Timing
    robot: str
    """What the loop drives, such as simulated."""
    degraded: tuple[str, ...]
    """What keeps the robot from being as good as it could be."""
    counters: dict[str, int]
    """Errors of the hardware that were survived, since start."""
    realtime: bool
    """True when the loop runs under SCHED_FIFO."""
    telemetry: str
    """Address of the telemetry socket."""
    servo_lost: bool = False
    """True while the servo cannot be reached; with `servo_on`, it may still have pulses."""
    calibrating: bool = False
    """True while a client has the servo on loan, to calibrate it."""
    fallback: Reason | None = None
    """Why the controller in command took over from the one that was set; None where it was set."""
    sensor_lost: bool = False
    """True while there is no force to believe; `thrust` is then that of the time before."""
