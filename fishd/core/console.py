"""What `fishd` and `fishctl` say in a terminal: one line a second, and one line for a mistake."""

import errno
import os
import resource
import sys
from contextlib import suppress
from typing import TYPE_CHECKING, NoReturn

import click

from fishd.core import text
from fishd.core.errors import ConfigError, FishdError

if TYPE_CHECKING:  # with msgspec, which help and most completions do without
    from fishd.core.signals import Status

INTERRUPTED = 130
"""Exit status after Ctrl-C, as shells give it: 128 and the number of SIGINT."""
_OUTPUT_ERRORS = {errno.ENOSPC, errno.EBADF, errno.EIO, errno.EFBIG, errno.EDQUOT, errno.EPIPE}
MAX_COMPLAINT = 5000
"""Length of the longest complaint, which lists all keys of the configuration [characters]."""


def status_line(status: "Status") -> str:
    """Mode, controller, frequency, mean thrust, power, lateness, missed ticks, a servo not reached.

    Of a swimmer its speed at that instant, instead of a thrust.
    """
    what = status.mode if status.mode == "idle" else f"{status.mode} {status.controller}"
    if status.reason:
        what = f"{status.mode} {status.reason.code}"
    what = text.quoted(what)
    servo = "  servo not reached" if status.servo_lost else ""
    got = f"thrust {thrust_words(status):>16}"
    if status.speed is not None:
        got = f"speed {status.speed * 1e3:6.1f} mm/s"
    power = "" if status.power is None else f"  power {power_words(status.power):>8}"
    return (
        f"{what:<16} {status.frequency:5.2f} Hz  {got}{power}  "
        f"late p50 {status.timing.lateness.p50:4.0f} p99 {status.timing.lateness.p99:4.0f} µs  "
        f"missed {status.missed} of {status.seq + status.missed} ticks{servo}"
    )


def thrust_words(status: "Status") -> str:
    """Thrust and half of its 95 % interval: `25.7 ± 1.8 mN`; `?` while the zero is not known."""
    unit = f"m{text.quoted(status.force_unit)}"
    if status.sensor_lost:
        return f"– {unit}"
    if status.thrust_error is None:
        return f"{1e3 * status.thrust:.2f} ± ? {unit}"
    return text.format_measured(status.thrust, status.thrust_error, status.force_unit)


def power_words(power: float) -> str:
    """Electrical power [W]: `1.23 W`."""
    return f"{power:.2f} W" if power >= 0.995 else f"{power * 1e3:.0f} mW"


def run(command: click.Command, name: str) -> int:
    """Run a command and return its exit status.

    One line, and exit status 2 for a wrong use, 78 for a wrong configuration, 1 for an output that
    cannot be written.
    """
    try:
        status = command(prog_name=name, standalone_mode=False)
    except click.exceptions.NoArgsIsHelpError as error:
        click.echo(error.format_message(), err=True)
        sys.exit(2)
    except click.UsageError as error:
        path = error.ctx.command_path if error.ctx else name
        complain(name, f"{error.format_message().rstrip('.')}; see '{path} --help'", 2)
    except click.ClickException as error:
        complain(name, error.format_message(), 1)
    except ConfigError as error:
        complain(name, str(error), os.EX_CONFIG)
    except click.Abort:
        complain(name, "interrupted", INTERRUPTED)
    except FishdError:  # of which some are an OSError, too
        raise
    except MemoryError:
        complain(name, f"there is not enough memory{_memory_limit()}", 1)
    except BrokenPipeError:  # the reader, `head` say, has seen enough
        lose_output()
        sys.exit(0)
    except OSError as error:
        if not error.filename:
            lose_output()
        complain(name, why_not_written(error), 1)
    return status if isinstance(status, int) else 0


def _memory_limit() -> str:
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    if limit == resource.RLIM_INFINITY:
        return ""
    return f": at most {limit / 2**20:.0f} MB of address space are permitted (ulimit -v)"


def why_not_written(error: OSError) -> str:
    """Return what to say of an error of a file, of the output, or of the working folder."""
    why = error.strerror or str(error)
    if error.filename:
        return f"{error.filename}: {why}"
    if error.errno == errno.ENOENT:
        return "the working folder was deleted; change into another one"
    return f"the output cannot be written: {why}" if error.errno in _OUTPUT_ERRORS else why


def lose_output() -> None:
    """Lose what waits for standard output, which takes nothing: else its last flush fails."""
    with suppress(OSError):
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, 1)
        os.close(null)


def complain(name: str, message: str, status: int) -> NoReturn:
    """Say one line on standard error and exit."""
    with suppress(OSError):  # standard error may be full, too
        click.echo(f"{name}: " + text.line(" ".join(message.split()), MAX_COMPLAINT), err=True)
    sys.exit(status)
