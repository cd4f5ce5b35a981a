"""`fishctl release`: releases the servo when fishd can no longer do that itself."""

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
from fishd.core.addresses import find_control_address
from fishd.core.errors import ConfigError, FishError, ServoError, StartupError
from fishd.core.process.interruption import SIGNALS, handle_signals
from fishd.core.process.kernel_names import Holder
from fishd.hardware.release_recipe import NOT_RELEASED, describe_outcome

_NO_FOLDER = "/proc/self/no-calibrations"
"""Folder that cannot exist, which stands for a machine without calibrations."""
_ANSWER_S = 0.3
"""Longest wait for an answer of a fishd that drives the servo [s]."""


@click.command()
@service_option
@set_option
@json_option
def release(file: Path | None, overrides: tuple[str, ...], as_json: bool) -> int:
    """Send the servo to neutral and stop its pulses, without the daemon.

    If a fishd still drives the servo, it first gets an emergency stop. A fishd that does not answer
    will be in mode fault when it resumes.

    systemd runs this when the service has ended (ExecStopPost). A servo without pulses is not
    touched. Exit status 1 when the servo cannot be reached or has pulses at the end, and when no
    configuration names a servo: the defaults are those of a simulated fish. If a file says that the
    fish is simulated, there is nothing to release, which is a success. Ctrl-C or a
    lost session does not interrupt it.
    """
    config, source = _load_without_bad_folder(file, overrides)
    service_result = os.environ.get("SERVICE_RESULT")
    prefix = f"the service ended with '{service_result}': " if service_result else ""
    if config.kind.has_hardware:
        done = prefix + _release(config)
        with output_may_fail(done):
            _print(done, as_json)
        return 0
    if source is None:
        raise click.ClickException(
            f"{prefix}nothing was released: without a configuration file (${FILE_VARIABLE}, else "
            f"{SERVICE_FILE}) the robot is simulated; name the one that fishd runs with: "
            "fishctl release --config FILE"
        )
    _print(f"{prefix}a simulated fish, by {source}, has nothing to release", as_json)
    return 0


def _print(done: str, as_json: bool) -> None:
    if as_json:
        print_json({"done": done})
    else:
        echo(done)


def release_by_config(no_answer: FishError, file: Path | None) -> str:
    """Do as the verb, for a fishd that does not answer; return what was done, in words.

    no_answer: error to report if no configuration names a servo
    """
    config, source = _load_without_bad_folder(file, ())
    if config.kind.has_hardware:
        return _release(config)
    if source is None:
        raise click.ClickException(
            f"{no_answer}; nothing was released: without a configuration file (${FILE_VARIABLE}, "
            f"else {SERVICE_FILE}) no servo is known; fishctl estop --config FILE names one"
        )
    return f"a simulated fish, by {source}, has no pulses; its fishd does not answer ({no_answer})"


def _release(config: Config) -> str:
    """Stop a fishd that drives the servo, or end the pulses; return what was done, in words."""
    try:
        with handle_signals(SIGNALS, signal.SIG_IGN):
            driver = _find_driver(config)
            if driver and (summary := _stop_fishd(config, driver)):
                return summary
            done = describe_outcome(_end_pulses(config))
    except ServoError as error:
        raise ServoError(f"{error}; {NOT_RELEASED}") from None
    if not driver:
        return done
    return (
        f"fishd (pid {driver}) drives the servo and did not answer at {_endpoint(config)}: {done}"
    )


def _find_driver(config: Config) -> Holder | None:
    """Return the fishd that drives this servo; None if there is none."""
    from fishd.assembly import parts_of
    from fishd.hardware.ownership import find_owner

    with suppress(StartupError):  # invalid place of a virtual Pi: the release reports it
        return find_owner(parts_of(config))
    return None


def _endpoint(config: Config) -> str:
    return config.control.address or find_control_address()


def _stop_fishd(config: Config, driver: Holder) -> str:
    """Send a fishd an emergency stop, and read the pulses back; empty unless they have ended."""
    from fishd.assembly import read_pulses

    try:
        with Fish(_endpoint(config), timeout=_ANSWER_S) as fish:
            if fish.status(_ANSWER_S).pid != driver.pid:
                return ""
            state = fish.estop("fishctl release", timeout=_ANSWER_S)
        pulses = read_pulses(config)
    except (FishError, ServoError, StartupError):
        return ""
    if pulses:
        return ""
    pulse_state = (
        "there are no pulses" if pulses is False else "whether there are pulses is not known"
    )
    return f"fishd (pid {driver}) was asked: mode {state.mode}, {pulse_state}"


def _load_without_bad_folder(
    file: Path | None, overrides: tuple[str, ...]
) -> tuple[Config, Path | None]:
    """Do as `load_service`, but ignore a state folder if that is all that is wrong."""
    try:
        return load_service(file, overrides)
    except ConfigError as error:
        file = file or service_file()
        try:
            config = load(file, (*overrides, f"state_folder={_NO_FOLDER}"))
        except ConfigError:
            raise error from None
        _report_skipped(error)
        return config, file


def _end_pulses(config: Config) -> bool:
    """End the pulses; return whether there were any.

    With an unreadable calibration, neutral lacks its trim.
    """
    from fishd.assembly import end_pulses

    try:
        return end_pulses(config)
    except ServoError:
        raise
    except (OSError, ValueError) as error:  # ConfigError is a ValueError
        _report_skipped(error)
        return end_pulses(replace(config, state_folder=_NO_FOLDER))


def _report_skipped(error: Exception) -> None:
    with suppress(OSError):  # the terminal may be gone
        click.echo(f"fishctl: {text.line(str(error))}; going on without it", err=True)
