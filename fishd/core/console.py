"""Output of `fishd` and `fishctl` in a terminal: status lines, and one line for an error."""

import errno
import os
import resource
import sys
from contextlib import suppress
from typing import TYPE_CHECKING, NoReturn

import click

from fishd.core import text
from fishd.core.errors import ConfigError, FishdError

if TYPE_CHECKING:  # imports msgspec, which help and most completions do not need
    from fishd.core.signals import ReadingState, Status

INTERRUPTED = 130
"""Exit status after Ctrl-C, as shells report it: 128 plus the number of SIGINT."""
_OUTPUT_ERRORS = {errno.ENOSPC, errno.EBADF, errno.EIO, errno.EFBIG, errno.EDQUOT, errno.EPIPE}
MAX_COMPLAINT_CHARACTERS = 5000
"""Maximum length of an error message, which may list all keys of the configuration [characters]."""


log_format_option = click.option(
    "--log-format",
    type=click.Choice(["text", "json"]),
    default="text",
    show_default=True,
    help="Format of the log on standard error.",
)
"""Option of each program that writes a log."""


def status_line(status: "Status") -> str:
    """Return mode, controller, frequency, thrust, readings, lateness and missed ticks in one line.

    A free fish has its current speed instead of a thrust. A servo that is not reached is mentioned.
    """
    what = status.mode if status.mode == "idle" else f"{status.mode} {status.controller}"
    if status.reason:
        what = f"{status.mode} {status.reason.code}"
    what = text.quoted(what)
    servo = "  servo not reached" if status.servo_lost else ""
    result = f"thrust {format_thrust(status):>16}"
    if status.speed is not None:
        result = f"speed {status.speed * 1e3:6.1f} mm/s"
    readings = "".join(f"  {name} {value:>8}" for name, value in format_readings(status))
    return (
        f"{what:<16} {status.frequency:5.2f} Hz  {result}{readings}  "
        f"late p50 {status.timing.lateness.p50:4.0f} p99 {status.timing.lateness.p99:4.0f} µs  "
        f"missed {status.missed_slots} of {status.seq + status.missed_slots} ticks{servo}"
    )


def format_thrust(status: "Status") -> str:
    """Return thrust and half-width of its 95 % confidence interval: `25.7 ± 1.8 mN`.

    `?` while the zero is not known, `–` without a sensor.
    """
    unit = f"m{text.quoted(status.force_unit)}"
    if status.sensor_lost:
        return f"– {unit}"
    if status.thrust_ci95 is None:
        return f"{1e3 * status.thrust:.2f} ± ? {unit}"
    return text.format_measured(status.thrust, status.thrust_ci95, status.force_unit)


def format_readings(status: "Status") -> list[tuple[str, str]]:
    """Return the names of the readings, and their values with units; `–` for one that is old."""
    return [
        (text.quoted(name), "–" if reading.value is None else format_reading(reading))
        for name, reading in status.readings.items()
    ]


def format_reading(reading: "ReadingState") -> str:
    """Return a value that is not old with its unit: `21.25 °C`."""
    assert reading.value is not None
    if reading.unit == "W":
        return format_power(reading.value)
    from fishd.core import schema

    return schema.format_reading(reading.value, text.quoted(reading.unit))


def format_power(power: float) -> str:
    """Return an electrical power [W] with its unit: `1.23 W`."""
    return f"{power:.2f} W" if power >= 0.995 else f"{power * 1e3:.0f} mW"


def run(command: click.Command, name: str) -> int:
    """Run a command and return its exit status.

    An error is one line on standard error. Exit status: 2 for wrong usage, 78 for a wrong
    configuration, 1 for an output that cannot be written.
    """
    try:
        status = command(prog_name=name, standalone_mode=False)
    except click.exceptions.NoArgsIsHelpError as error:
        click.echo(error.format_message(), err=True)
        sys.exit(2)
    except click.UsageError as error:
        path = error.ctx.command_path if error.ctx else name
        message = error.format_message().rstrip(".")
        if isinstance(error, click.MissingParameter) and isinstance(error.param, click.Option):
            message = f"{message} {error.param.metavar or ''}".rstrip()  # what it takes
        complain(name, f"{message}; see '{path} --help'", 2)
    except click.ClickException as error:
        complain(name, error.format_message(), 1)
    except ConfigError as error:
        complain(name, str(error), os.EX_CONFIG)
    except click.Abort:
        complain(name, "interrupted", INTERRUPTED)
    except FishdError:  # some of these are OSErrors, too
        raise
    except MemoryError:
        complain(name, f"not enough memory{_memory_limit()}", 1)
    except BrokenPipeError:  # the reader, such as `head`, has closed the pipe
        discard_output()
        sys.exit(0)
    except OSError as error:
        if not error.filename:
            discard_output()
        complain(name, describe_write_error(error), 1)
    return status if isinstance(status, int) else 0


def _memory_limit() -> str:
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    if limit == resource.RLIM_INFINITY:
        return ""
    return f": at most {limit / 2**20:.0f} MB of address space are permitted (ulimit -v)"


def describe_write_error(error: OSError) -> str:
    """Return a message for an error of a file, of the output, or of the working folder."""
    why = error.strerror or str(error)
    if error.filename:
        return f"{error.filename}: {why}"
    if error.errno == errno.ENOENT:
        return "the working folder was deleted; change into another one"
    return f"the output cannot be written: {why}" if error.errno in _OUTPUT_ERRORS else why


def discard_output() -> None:
    """Discard pending standard output that cannot be written: the last flush would fail."""
    with suppress(OSError):
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, 1)
        os.close(null)


def complain(name: str, message: str, status: int) -> NoReturn:
    """Print one line on standard error and exit."""
    with suppress(OSError):  # standard error may be full, too
        click.echo(
            f"{name}: " + text.line(" ".join(message.split()), MAX_COMPLAINT_CHARACTERS), err=True
        )
    sys.exit(status)
