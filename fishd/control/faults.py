"""Every fault that fishd latches, with its remedy, and after how many failed checks it is one.

The section of each code in docs/how-to/troubleshooting.md says what triggers it.
"""

from msgspec import Struct


class Fault(Struct, frozen=True):
    """A row of the table."""

    remedy: str
    """Action of the operator before `fishctl clear-fault`."""
    in_a_row: int = 1
    """Number of failed checks in a row that trigger the fault."""
    releases: bool = False
    """Whether the pulses end at once, wherever the tail is: mode `estop`. Else, in mode `fault`,
    the servo fades to neutral before they end."""


FAULTS = {
    # The fish swims on after one lost or doubtful window: the last trusted one is used again.
    "sensor-stale": Fault("check wires and power of the force sensor", in_a_row=3),
    "sensor-range": Fault(
        "look for a clipped or broken wire of the force sensor, or calibrate it", in_a_row=3
    ),
    "sensor-lost": Fault("mend what the message says, or set required: false"),
    # A simulation that has diverged, or a plant of another package: it cannot be mended meanwhile.
    "fish-lost": Fault("change what the message says, and start fishd again"),
    "fy-reversed": Fault("calibrate the force sensor or the servo, as the message says"),
    "estimate-error": Fault("report it, with the log: it is an error in fishd"),
    "controller-error": Fault(
        "correct the controller (the log shows where it failed), or set another one"
    ),
    # The first updates of a controller have cold caches, and any computer pauses now and then.
    "controller-slow": Fault(
        "make the controller faster or `tick` longer, or take other load from this machine",
        in_a_row=3,
    ),
    "chatter": Fault("set another policy, one that was trained for this fish"),
    # `remote` itself tolerates some late answers, with its own count.
    "remote-silent": Fault("start the agent again, or give it a longer deadline"),
    "remote-error": Fault("correct the agent"),
    "servo-link": Fault(
        "check that pigpiod, or the PWM channel, runs and that nothing else uses it"
    ),
    "estop-button": Fault("check that nothing else uses the pin of the button"),
    "publish-error": Fault("report it, with the log: it is an error in fishd"),
    # The supervisor counts the ticks that came late; a silence beyond the countdown is one at once.
    "overrun": Fault("take other load from this machine, or make `tick` longer"),
    "estop": Fault("make sure that the fish may move again", releases=True),
}
UNLISTED = Fault("see the documentation of that controller")
"""Row of a fault code that a controller of another package has made."""
