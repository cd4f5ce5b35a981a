"""`fishctl release`: the last resort, when fishd can no longer let go of the servo itself."""

import os
import signal
from contextlib import suppress
from pathlib import Path

import click
from msgspec.structs import replace

from fishd.cli.config import load_service, service_option, set_option
from fishd.config import FILE_VARIABLE, SERVICE_FILE, Config, load, service_file
from fishd.core import text
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
    config, found = _loaded(file, overrides)
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


def _loaded(file: Path | None, overrides: tuple[str, ...]) -> tuple[Config, Path | None]:
    """As `load_service`; a configuration that is wrong in its state folder alone goes without."""
    try:
        return load_service(file, overrides)
    except ConfigError as error:
        file = file or service_file()
        try:
            config = load(file, (*overrides, f"state_folder={_NO_FOLDER}"))
        except ConfigError:
            raise error from None
        _go_on_without(error)
        return config, file


def _end_pulses(config: Config) -> bool:
    """True where there were any; whatever is wrong with the calibration or its folder: neutral may
    then be off by the trim.
    """
    from fishd.config.assembly import end_pulses

    try:
        return end_pulses(config)
    except ServoError:
        raise
    except (OSError, ValueError) as error:  # a ConfigError is one, too
        _go_on_without(error)
        return end_pulses(replace(config, state_folder=_NO_FOLDER))


def _go_on_without(error: Exception) -> None:
    with suppress(OSError):  # the terminal may be gone
        click.echo(f"fishctl: {text.line(str(error))}; going on without it", err=True)
