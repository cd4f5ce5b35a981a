"""`fishctl release`: the last resort, when fishd can no longer release the servo itself."""

import os
import signal
from contextlib import suppress
from pathlib import Path

import click
from msgspec.structs import replace

from fishd.cli.config import load_service, service_option, set_option
from fishd.cli.options import json_option
from fishd.cli.output import echo, output_may_fail, print_json
from fishd.client import Fish
from fishd.config import FILE_VARIABLE, SERVICE_FILE, Config, load, service_file
from fishd.core import text
from fishd.core.addresses import find_control
from fishd.core.errors import ConfigError, FishError, NoDaemon, ServoError, StartupError
from fishd.core.process.interruption import SIGNALS, handled
from fishd.hardware.release_recipe import NOT_RELEASED, outcome

_NO_FOLDER = "/proc/self/no-calibrations"
"""A folder that cannot be made: as on a machine where nothing was ever calibrated."""
_ANSWER_S = 0.3
"""Longest time for a fishd that drives the servo to answer [s]."""


@click.command()
@service_option
@set_option
@json_option
def release(file: Path | None, overrides: tuple[str, ...], as_json: bool) -> int:
    """Send the servo to neutral and stop its pulses, without the daemon.

    A fishd that still drives the servo is asked first for an emergency stop; one that does not
    answer is in fault when it goes on.

    systemd runs this when the service has ended (ExecStopPost). A servo without pulses is not
    touched. Exit status 1 when the servo cannot be reached or has pulses at the end, and when no
    configuration says where a servo is: the defaults are those of a simulated fish. One that a file
    says is simulated has nothing to release, which is a success. Once it has begun, neither a
    lost session nor Ctrl-C ends it halfway.
    """
    config, source = _loaded(file, overrides)
    ended = os.environ.get("SERVICE_RESULT")
    why = f"the service ended with '{ended}': " if ended else ""
    if config.has_hardware:
        done = why + _release(config)
        with output_may_fail(done):
            _print(done, as_json)
        return 0
    if source is None:
        raise click.ClickException(
            f"{why}nothing was released: without a configuration file (${FILE_VARIABLE}, else "
            f"{SERVICE_FILE}) the robot is simulated; name the one that fishd runs with: "
            "fishctl release --config FILE"
        )
    _print(f"{why}a simulated fish, by {source}, has nothing to release", as_json)
    return 0


def _print(done: str, as_json: bool) -> None:
    if as_json:
        print_json({"done": done})
    else:
        echo(done)


def release_by_config(silence: NoDaemon, file: Path | None) -> str:
    """Do as the verb, for a fishd that does not answer; returns what was done, in words.

    silence: what is said where no configuration names a servo
    """
    config, source = _loaded(file, ())
    if config.has_hardware:
        return _release(config)
    if source is None:
        raise click.ClickException(
            f"{silence}; nothing was released: without a configuration file (${FILE_VARIABLE}, "
            f"else {SERVICE_FILE}) no servo is known; fishctl estop --config FILE names one"
        )
    return f"a simulated fish, by {source}, has no pulses; its fishd does not answer ({silence})"


def _release(config: Config) -> str:
    """Ask a fishd that drives the servo, or end the pulses; returns what was done, in words."""
    try:
        with handled(SIGNALS, signal.SIG_IGN):
            driver = _driver(config)
            if driver and (said := _ask(config, driver)):
                return said
            done = outcome(_end_pulses(config))
    except ServoError as error:
        raise ServoError(f"{error}; {NOT_RELEASED}") from None
    if not driver:
        return done
    return (
        f"fishd (pid {driver}) drives the servo and did not answer at {_endpoint(config)}: {done}"
    )


def _driver(config: Config) -> str:
    """Return the pid of a fishd that drives this servo; empty where there is none."""
    from fishd.assembly import parts_of
    from fishd.hardware.ownership import owner_pid

    with suppress(StartupError):  # no good place for a virtual Pi: the release says so
        return owner_pid(parts_of(config))
    return ""


def _endpoint(config: Config) -> str:
    return config.control.address or find_control()


def _ask(config: Config, driver: str) -> str:
    """Ask a fishd for an emergency stop, and read the pulses back; empty unless they have ended."""
    from fishd.assembly import read_pulses

    try:
        with Fish(_endpoint(config), timeout=_ANSWER_S) as fish:
            if str(fish.status(_ANSWER_S).pid) != driver:
                return ""
            state = fish.estop("fishctl release", timeout=_ANSWER_S)
        pulses = read_pulses(config)
    except (FishError, ServoError, StartupError):
        return ""
    if pulses:
        return ""
    seen = "there are no pulses" if pulses is False else "whether there are pulses is not known"
    return f"fishd (pid {driver}) was asked: mode {state.mode}, {seen}"


def _loaded(file: Path | None, overrides: tuple[str, ...]) -> tuple[Config, Path | None]:
    """Do as `load_service`, but leave out a state folder that alone is wrong."""
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
    """Return whether there were any; with an unreadable calibration, neutral lacks its trim."""
    from fishd.assembly import end_pulses

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
