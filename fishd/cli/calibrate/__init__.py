"""Verbs that calibrate: tare, calibrate force, calibrate servo."""

import click

from fishd.cli.options import FiniteRange, daemon_options, for_option
from fishd.cli.output import echo, print_json
from fishd.cli.verbs import Verb, Verbs
from fishd.client import Fish
from fishd.core import text
from fishd.core.robots import find_kind

VERBS = {
    "Verbs": {
        "force": Verb("calibrate.force", "force", "Calibrate the force sensor with known loads."),
        "servo": Verb("calibrate.servo", "servo", "Find trim, direction and limits of the servo."),
    }
}


@click.group(cls=Verbs, verbs=VERBS)
def calibrate() -> None:
    """Calibrate the force sensor with known loads, or the servo by small steps."""


@click.command()
@for_option("Duration of the measurement [s].", default=2.0, kind=FiniteRange(0.1, 60.0))
@daemon_options
def tare(seconds: float, endpoint: str | None, as_json: bool) -> None:
    """Set the zero of the force sensor to the present force; the fish must hang still.

    Refused while the fish swims, while the force varies, and for a force that is too large to be an
    offset. The result is saved as a new calibration file, except for a simulated fish. After
    Ctrl-C during the measurement, nothing changes.
    """
    with Fish(endpoint) as fish:
        has_hardware = find_kind(fish.status().robot).has_hardware
        before = fish.calibrations().force if has_hardware else None
        after = fish.tare(seconds)
    if as_json:
        print_json(after)
        return
    for when, force in (("before", before), ("after", after.force)):
        if force is None:
            continue
        echo(f"{when:<7} x0 {force.x0 * 1e3:+9.2f} mN   y0 {force.y0 * 1e3:+9.2f} mN")
    storage = f"and saved in {after.force_file}" if after.force_file else "until this fish ends"
    echo(text.line(f"in use, {storage}"))
