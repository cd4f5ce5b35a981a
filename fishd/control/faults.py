"""Every fault that fishd latches: one table from its code to its effect, its text and its remedy.

The supervisor, `fishctl status`, docs/explanation/concepts.md and the tests read it.
"""

from enum import StrEnum

from msgspec import Struct


class Effect(StrEnum):
    """Effect of a fault on the pulses of the servo."""

    FADE = "mode `fault`: the servo fades to neutral, then it gets no pulses"
    RELEASE = "mode `estop`: no pulses at once, wherever the tail is"


class Fault(Struct, frozen=True):
    """A row of the table."""

    text: str
    """Condition that triggers the fault."""
    remedy: str
    """Action of the operator before `fishctl clear-fault`."""
    in_a_row: int = 1
    """Number of failed checks in a row that trigger the fault."""
    effect: Effect = Effect.FADE


FAULTS = {
    "sensor-stale": Fault(
        "the sensor cannot be read, or its newest sample is older than 2 periods; until it is a "
        "fault, the last measurement is used again",
        "check wires and power of the force sensor",
        in_a_row=3,
    ),
    "sensor-range": Fault(
        "the force is not plausible: a sample at the end of the ADC's range, a channel that has "
        "not changed for `force_sensor.frozen_after`, or a force beyond "
        "`force_sensor.force_limit`; until it is a fault, the last plausible force is used again",
        "look for a clipped or broken wire of the force sensor, or calibrate it",
        in_a_row=3,
    ),
    "fish-lost": Fault(
        "the computation of a free fish has diverged, or it has left the part of the tank that is "
        "computed well; or a plant of another package has failed",
        "change what the message says, and start fishd again",
    ),
    "fy-reversed": Fault(
        "the first push of the tail has shown that F_y is reversed, `estimator.reversed_fy` is "
        "`refuse`, and the controller uses F_y",
        "calibrate the force sensor or the servo, as the message says",
    ),
    "estimate-error": Fault(
        "the estimator raised an exception, or returned a value that is not finite",
        "report it, with the log: it is an error in fishd",
    ),
    "controller-error": Fault(
        "the controller raised an exception of any kind, SystemExit too, or returned something "
        "that is not a finite real number",
        "correct the controller (the log shows where it failed), or set another one",
    ),
    "controller-slow": Fault(
        "the controller took longer than half a period",
        "make the controller faster or `tick` longer, or take other load from this machine",
        in_a_row=3,
    ),
    "chatter": Fault(
        "`ppo`, or `remote` with a `dwell`, keeps reversing too fast, and `chatter.fallback` "
        "is `fault`",
        "set another policy, one that was trained for this fish",
    ),
    "remote-silent": Fault(
        "the agent of `remote` has not answered in time, 5 ticks in a row, or not at all for 10 s",
        "start the agent again, or give it a longer deadline",
    ),
    "remote-error": Fault(
        "the agent of `remote` sent something that is not an answer", "correct the agent"
    ),
    "servo-link": Fault(
        "the servo cannot be driven; fishd keeps trying to reach it, and releases it as soon as "
        "it can",
        "check that pigpiod, or the PWM channel, runs and that nothing else uses it",
    ),
    "estop-button": Fault(
        "the E-stop button cannot be read", "check that nothing else uses the pin of the button"
    ),
    "publish-error": Fault(
        "telemetry cannot be encoded or sent; not because of a slow subscriber",
        "report it, with the log: it is an error in fishd",
    ),
    "overrun": Fault(
        "more than 20 of the last 100 ticks took too long or came late; or, on pigpiod, fishd "
        "stood still for longer than `servo.countdown`: the servo went to rest meanwhile",
        "take other load from this machine, or make `tick` longer",
    ),
    "estop": Fault(
        "an emergency stop, by a request or by the button of the panel",
        "make sure that the fish may move again",
        effect=Effect.RELEASE,
    ),
}
UNLISTED = Fault(
    "a controller of another package gave up with a fault code that is not in this table",
    "see the documentation of that controller",
)
