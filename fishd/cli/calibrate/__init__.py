"""The verbs that make measurements and pulses true: tare, calibrate force, calibrate servo."""

import click

from fishd import text
from fishd.cli.calibrate_force import force
from fishd.cli.calibrate_servo import servo
from fishd.cli.options import endpoint_option, json_option
from fishd.cli.output import echo, print_json
from fishd.client import Fish


@click.group()
def calibrate() -> None:
    """Calibrate the force sensor with known loads, or the servo by small steps."""


calibrate.add_command(force)
calibrate.add_command(servo)


@click.command()
@click.option(
    "--seconds",
    type=click.FloatRange(0.1, 60.0),
    default=2.0,
    show_default=True,
    help="How long to measure.",
)
@endpoint_option
@json_option
def tare(seconds: float, endpoint: str | None, as_json: bool) -> None:
    """Call the present force zero; the fish must hang still.

    Refused while it swims, while the force varies, and for a force that is too large to be an
    offset. It is saved as a new calibration file. Ctrl-C while it measures: nothing changes.
    """
    with Fish(endpoint) as fish:
        before = fish.calibrations().force
        after = fish.tare(seconds)
    if as_json:
        print_json(after)
        return
    now = after.force
    echo(f"before  x0 {before.x0 * 1e3:+9.2f} mN   y0 {before.y0 * 1e3:+9.2f} mN")
    echo(f"after   x0 {now.x0 * 1e3:+9.2f} mN   y0 {now.y0 * 1e3:+9.2f} mN")
    echo(text.line(f"in force, and saved in {after.force_file}"))
