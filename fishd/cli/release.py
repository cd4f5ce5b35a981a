"""`fishctl release`: the last resort, when fishd can no longer let go of the servo itself."""

import os
import signal
from pathlib import Path

import click
from msgspec.structs import replace

from fishd.cli.config import load_service, service_option, set_option
from fishd.config import FILE_VARIABLE, SERVICE_FILE, Config
from fishd.core.errors import ConfigError, ServoError
from fishd.core.interruption import SIGNALS, handled
from fishd.hardware.release_recipe import NOT_RELEASED

_NO_FOLDER = "/proc/self/no-calibrations"
"""Nobody can make it: as on a machine where nothing was ever calibrated."""


@click.command()
@service_option
@set_option
def release(file: Path | None, overrides: tuple[str, ...]) -> int:
    """Send the servo to neutral and stop its pulses, without the daemon.

    systemd runs this when the service has ended (ExecStopPost). A servo without pulses is not
    touched. Exit status 1 when the servo cannot be reached, and when no configuration says where a
    servo is: the defaults are those of a simulated fish. One that a file says is simulated has
    nothing to release, and that is no error. Once it has begun, neither a lost session nor Ctrl-C
    ends it halfway.
    """
    config, found = load_service(file, overrides)
    ended = os.environ.get("SERVICE_RESULT")
    why = f"the service ended with '{ended}': " if ended else ""
    if config.has_hardware:
        try:
            with handled(SIGNALS, signal.SIG_IGN):
                done = _end_pulses(config)
        except ServoError as error:
            raise ServoError(f"{error}; {NOT_RELEASED}") from None
        click.echo(why + ("pulses were on: neutral, then off" if done else "there were no pulses"))
        return 0
    if found is None:
        raise click.ClickException(
            f"{why}nothing was released: without a configuration file (${FILE_VARIABLE}, else "
            f"{SERVICE_FILE}) the robot is simulated; name the one that fishd runs with: "
            "fishctl release --config FILE"
        )
    click.echo(f"{why}a simulated fish, by {found}, has nothing to release")
    return 0


def _end_pulses(config: Config) -> bool:
    """True where there were any; even if the calibration cannot be read: neutral may then be off
    by the trim.
    """
    from fishd.config.assembly import end_pulses

    try:
        return end_pulses(config)
    except ServoError:
        raise
    except (ConfigError, OSError) as error:
        click.echo(f"fishctl: {error}; going on without it", err=True)
        return end_pulses(replace(config, state_folder=_NO_FOLDER))
