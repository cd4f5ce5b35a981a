"""Verbs that run a virtual Raspberry Pi and inject faults."""

import contextlib
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import click
from click.shell_completion import CompletionItem

from fishd.cli.config import fish_options
from fishd.cli.options import for_option, json_option
from fishd.cli.output import echo, echo_rows, print_json
from fishd.cli.prompts import caught_signals
from fishd.config import Config, load
from fishd.core.addresses import virtual_pi_socket
from fishd.core.console import complain
from fishd.core.process import realtime
from fishd.hardware.settings import PanelSettings
from fishd.virtual.pi.faults import FAULTS
from fishd.virtual.pi.link import RemotePi
from fishd.virtual.pi.link_server import LinkServer
from fishd.virtual.pi.virtual_pi import PiState, PunctualClock, VirtualPi

CHIP_PRIORITY = 60
"""SCHED_FIFO priority of a virtual Pi, above that of the fishd that drives it."""


def _complete_fault(_: click.Context, __: click.Parameter, incomplete: str) -> list[CompletionItem]:
    return [
        CompletionItem(name, help=about)
        for name, about in FAULTS.items()
        if name.startswith(incomplete)
    ]


@contextmanager
def _connect(config: Config) -> Iterator[RemotePi]:
    """Yield the running virtual Pi; print a refused request as one line and exit with 2."""
    with RemotePi(virtual_pi_socket(config.virtual_pi.socket)) as pi:
        try:
            yield pi
        except ValueError as error:
            complain("fishctl", str(error), 2)
        except OSError as error:
            complain("fishctl", error.strerror or str(error), 1)


@click.group()
def virtual_pi() -> None:
    """Run a virtual Raspberry Pi with sensor, servo and fish, and inject faults.

    fishd drives it with robot: virtual-pi, through the same drivers as on the robot.
    """


@virtual_pi.command()
@fish_options
def run(file: Path | None, overrides: tuple[str, ...]) -> None:
    """Run a virtual Pi until Ctrl-C or SIGTERM."""
    config = load(file, overrides)
    with contextlib.suppress(OSError):  # if permitted: chips must not wait for a busy machine
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(CHIP_PRIORITY))
    realtime.enter(priority=0, lock_memory=False)  # for the sleeps that stand for bus time
    settings = config.virtual_pi
    path = virtual_pi_socket(settings.socket)
    pi = VirtualPi(settings, config.plant, config.simulation, config.tick, PunctualClock())
    if config.panel.estop_gpio is not None:
        pi.set_level(config.panel.estop_gpio, _pin_level(config.panel, pressed=False))
    with caught_signals() as stopped, LinkServer(pi, path):
        echo(
            f"virtual Pi on {path}: ADS1115 {settings.address:#04x} on I2C bus {settings.bus}, "
            f"pigpiod on 127.0.0.1:{pi.pigpiod.port} with the servo on GPIO {settings.servo_gpio}"
        )
        realtime.freeze_garbage_collector()
        while not stopped(1.0):
            realtime.collect_garbage()
            state = pi.state()  # also advances the fish while no driver reads the sensor
            if sys.stdout.isatty():
                echo(_format_line(state))


@virtual_pi.command()
@click.argument("name", shell_complete=_complete_fault)
@for_option("Duration of the fault [s]; by default it lasts until 'clear'.", kind=click.FLOAT)
@fish_options
def inject(name: str, seconds: float | None, file: Path | None, overrides: tuple[str, ...]) -> None:
    """Begin the fault NAME; 'virtual-pi faults' lists them."""
    with _connect(load(file, overrides)) as pi:
        pi.inject(name, seconds)


@virtual_pi.command()
@click.argument("name", required=False, shell_complete=_complete_fault)
@fish_options
def clear(name: str | None, file: Path | None, overrides: tuple[str, ...]) -> None:
    """End the fault NAME, or all faults."""
    with _connect(load(file, overrides)) as pi:
        pi.clear(name)


@virtual_pi.command()
@json_option
def faults(as_json: bool) -> None:
    """List the faults that can be injected."""
    if as_json:
        print_json(FAULTS)
        return
    for name, about in FAULTS.items():
        click.echo(f"{click.style(f'{name:<18}', bold=True)}{about}")


@virtual_pi.command()
@fish_options
@json_option
def status(file: Path | None, overrides: tuple[str, ...], as_json: bool) -> None:
    """Show pulses, fish and faults of the running virtual Pi."""
    with _connect(load(file, overrides)) as pi:
        state = pi.state()
    if as_json:
        print_json(state)
        return
    truth = state.truth
    rows = [
        ("pulses", _format_pulses(state)),
        ("wheel", f"{truth.phi:+.3f} rad"),
        ("fin", f"{truth.alpha:+.3f} rad, {truth.alpha_rate:+.2f} rad/s"),
        ("faults", _format_faults(state) or "none"),
        ("pigpiod", f"127.0.0.1:{state.pigpio_port}"),
    ]
    echo_rows(rows)


@virtual_pi.command()
@fish_options
def press(file: Path | None, overrides: tuple[str, ...]) -> None:
    """Press the E-stop button and keep it pressed."""
    _set_button(load(file, overrides), pressed=True)


@virtual_pi.command()
@fish_options
def release_button(file: Path | None, overrides: tuple[str, ...]) -> None:
    """Release the E-stop button."""
    _set_button(load(file, overrides), pressed=False)


def _set_button(config: Config, pressed: bool) -> None:
    panel = config.panel
    if panel.estop_gpio is None:
        complain("fishctl", "no E-stop button: panel.estop_gpio is null, its GPIO is needed", 1)
    with _connect(config) as pi:
        pi.set_level(panel.estop_gpio, _pin_level(panel, pressed))


def _pin_level(panel: PanelSettings, pressed: bool) -> int:
    """Return the level to which the E-stop button drives its pin."""
    return int(pressed == (panel.estop_pressed == "high"))


def _format_line(state: PiState) -> str:
    faults = _format_faults(state)
    return f"pulses {_format_pulses(state):<24} fin {state.truth.alpha:+.3f} rad" + (
        f"  faults: {faults}" if faults else ""
    )


def _format_pulses(state: PiState) -> str:
    return "none" if state.phi_c is None else f"{state.pulse:.0f} µs, {state.phi_c:+.3f} rad"


def _format_faults(state: PiState) -> str:
    return ", ".join(
        name if left is None else f"{name} ({left:.1f} s left)"
        for name, left in state.faults.items()
    )
