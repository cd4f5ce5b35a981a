"""Daemon: it runs the fish that a configuration describes until a signal ends it."""

import asyncio
import dataclasses
import itertools
import logging
import math
import os
import signal
import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from functools import partial
from pathlib import Path

import click

from fishd import __version__, assembly
from fishd.config import Config, load
from fishd.control.lease import Lease
from fishd.control.loop import AT_NEUTRAL_TIME_S
from fishd.control.supervisor import Mode
from fishd.controllers import registry
from fishd.controllers.policy.runtime import preload
from fishd.core import addresses, local_daemons
from fishd.core.clock import Clock, SlowClock, SystemClock, Ticker, VirtualClock
from fishd.core.console import log_format_option, run, status_line
from fishd.core.errors import ConfigError, FishdError, ServoError
from fishd.core.process import kernel_names, realtime
from fishd.core.process.logs import UNHURRIED_FLUSH_TIMEOUT_S, LogWriter
from fishd.core.process.shutdown import Shutdown, exit_now
from fishd.core.process.systemd_notify import SystemdNotifier
from fishd.daemon.calibration_requests import CalibrationRequests
from fishd.daemon.control_server import ControlServer
from fishd.daemon.direct_sockets import open_at_file, open_in_kernel
from fishd.daemon.gateway.gateways import Gateways, Telemetry, read_keys
from fishd.daemon.requests import Access, Operations, Restart
from fishd.daemon.socket_files import SocketWatch
from fishd.daemon.virtual_pace import Lockstep, SlowMotion
from fishd.hardware.base import Robot
from fishd.hardware.servo.pulses import NEUTRAL_TIME_S

log = logging.getLogger(__name__)
console = logging.getLogger("console")

MAX_FADE_S = 0.5
"""Longest time of fading to neutral after a signal [s]."""
STATUS_PERIOD_S = 1.0
"""Time between two status messages [s]."""


class Daemon:
    """All objects that live as long as the process; used as a context manager.

    Raises `StartupError` when an address is in use or the robot's drivers are missing. Leaving the
    context always releases the servo first and closes the rest afterwards; every step is done even
    if another step fails.
    """

    def __init__(
        self,
        config: Config,
        print_status: bool,
        file: Path | None = None,
        overrides: Sequence[str] = (),
    ) -> None:
        """file, overrides: what the configuration was read from"""
        self._config = config
        self._file = file
        self._overrides = overrides
        self._restarts = False
        """Whether a client requested that systemd starts fishd again."""
        self._print_status = print_status
        self._slow: SlowMotion | None = None
        if not config.kind.is_real_time:
            self._slow = SlowMotion(config.tick, config.kind.slow_motion(config))
        self._clock = SlowClock() if self._slow else _clock(config)
        self._virtual = isinstance(self._clock, VirtualClock)
        self._events = asyncio.get_running_loop()
        self._housekeeping = itertools.cycle(
            (self._report, self._check_sockets, self._collect_garbage, self._check_sockets)
        )
        self._next_housekeeping = 0.0
        self._stack = ExitStack()

    def __enter__(self) -> "Daemon":
        with ExitStack() as stack:
            config = self._config
            self._notifier = SystemdNotifier()
            stack.callback(self._notifier.close)
            address = config.control.address or addresses.control_address()
            stack.enter_context(addresses.claim_address(address))
            stack.enter_context(addresses.claim_address(config.telemetry.address))
            network = config.network if config.network.keys else None
            self._gateways = Gateways(address, config.telemetry.address, stack, network)
            # Before the gateways end, after the servo is released.
            stack.callback(realtime.drop_priority)
            self._telemetry = Telemetry(self._gateways)
            controllers = registry.describe_all()  # imports the controllers of other packages
            if not self._virtual:
                preload()  # importing it later would delay ticks
            robot = assembly.open_robot(
                config, self._clock, stack, self._file, addresses.socket_path(address)
            )
            if self._slow:
                robot = _with_slow_motion(robot, self._slow)
            self._loop = assembly.build_loop(
                config, robot, self._clock, self._telemetry, self._ticked
            )
            if self._virtual:  # the programs that hold a lease run in real time
                self._loop.lease = Lease(time.monotonic)
            stack.callback(self._loop.close)
            stack.callback(self._release)
            stack.callback(self._move_to_neutral)
            if robot.panel:
                robot.panel.on_press = self._on_press
            calibration_requests = CalibrationRequests(
                self._loop, self._clock, config, assembly.state_folder(config)
            )
            self.is_realtime = not self._virtual and realtime.enter(
                config.realtime.priority, config.realtime.lock_memory
            )
            self._operations = Operations(
                self._loop,
                self._clock,
                calibration_requests,
                config,
                controllers,
                self.is_realtime,
                self._access,
                self._find_restart,
            )
            self._server = ControlServer(self._operations.perform, config.tick)
            self._gateways.serve(self._server, self._loop.reporter)
            stack.callback(self._server.close)
            answer = self._server.reply_directly, config.tick
            if direct := open_in_kernel(local_daemons.name_of_this(address), *answer):
                stack.callback(direct.close)
            self._sockets = SocketWatch(
                self._loop,
                self._gateways,
                config.control.address,
                lambda path: open_at_file(path, *answer),
            )
            stack.callback(self._sockets.close)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, _: object, error: BaseException | None, __: object) -> None:
        """Release and close everything; raise `ServoError` if the servo could not be released."""
        try:
            self._stack.close()
        except ServoError as failure:
            if isinstance(error, Exception):  # the exception below replaces it
                log.critical("fishd failed", exc_info=error)
            address = self._config.control.address
            option = f" --endpoint {address}" if address else ""
            raise ServoError(
                f"the servo could not be released and may keep its pulses: {failure}; "
                f"once it can be reached, 'fishctl estop{option}' ends them"
            ) from None

    async def run(self, stopping: asyncio.Event) -> None:
        """Tick until `stopping` is set, then fade to neutral."""
        log.info(
            "fishd %s drives the %s robot every %g ms%s; control %s, telemetry %s%s",
            __version__,
            self._loop.robot.name,
            self._config.tick * 1e3,
            " of virtual time" if self._virtual else "",
            self._gateways.control.address,
            self._gateways.telemetry.address,
            f"; with keys {keyed}" if (keyed := self._gateways.keyed_control) else "",
        )
        realtime.freeze_garbage_collector()
        if self._slow:
            self._slow.stopping = stopping
            self._slow.while_waiting = self._between_ticks
        clock, lockstep = self._clock, None
        if isinstance(clock, VirtualClock):
            lockstep = Lockstep(self._loop, clock, self._config.tick, self._slow)
        ticker = lockstep or Ticker(self._config.tick)

        def poll() -> None:
            self._between_ticks()
            if stopping.is_set():
                self._loop.stop()

        try:
            async for slot in ticker:
                if lockstep:
                    await lockstep.tick(slot, poll)
                else:
                    self._loop.tick(slot)
                self._between_ticks()
                if stopping.is_set():
                    break
            self._notifier.stopping()
            if self._slow:  # it has no servo to release, and a fade would take long
                log.info("stopping")
                return
            log.info("stopping: fading to neutral")
            self._loop.stop()
            deadline = self._clock.monotonic() + MAX_FADE_S + AT_NEUTRAL_TIME_S
            async for slot in ticker:
                if self._loop.has_settled or slot.now > deadline:
                    break
                self._loop.tick(slot)
                self._server.end_tick()
        finally:
            ticker.close()

    def _find_restart(self) -> Restart | None:
        has_systemd = self._notifier.is_service
        return Restart(self._check_config, self._end_for_restart) if has_systemd else None

    def _check_config(self) -> None:
        """Read the files of the next start, with their keys; raise `ConfigError`."""
        config = load(self._file, self._overrides)
        if config.network.keys:
            read_keys(config.network.keys)
        if config.kind.has_hardware:
            assembly.read_calibrations(config)

    def _end_for_restart(self) -> None:
        log.info("a restart was requested")
        self._restarts = True
        signal.raise_signal(signal.SIGTERM)  # the way of each end, also of a loop that hangs

    def shall_restart(self) -> bool:
        """Return whether systemd shall start fishd again, once it has ended."""
        if self._restarts and self._loop.supervisor.mode is Mode.ESTOP:
            log.warning(
                "an emergency stop came during the restart, so fishd is not started again; start "
                "it with 'sudo systemctl start fishd'"
            )
            return False
        return self._restarts

    def _between_ticks(self) -> None:
        """Do housekeeping, one job at a time, so that it fits between two ticks of 2 ms."""
        self._server.end_tick()
        now = time.monotonic()
        if self._virtual:  # the next tick may wait for an agent, or for slow motion
            self._notifier.ticked(now)
            if self._loop.lease.active:
                self._loop.expire_lease()
        if now >= self._next_housekeeping:
            self._next_housekeeping = now + STATUS_PERIOD_S / 4
            next(self._housekeeping)()

    def _collect_garbage(self) -> None:
        realtime.collect_garbage(thorough=self._loop.supervisor.mode is not Mode.RUNNING)

    def _check_sockets(self) -> None:
        self._sockets.check()
        self._gateways.check()
        kernel_names.drop_readers()

    def _access(self) -> Access:
        gateways, sockets = self._gateways, self._sockets
        return Access(
            sockets.control,
            gateways.telemetry.address,
            gateways.keyed_telemetry,
            sockets.limitation,
            {**gateways.counters(), "sockets_restored": sockets.restored},
        )

    def _ticked(self, now: float) -> None:
        """Notify systemd of a tick; `now` is its start on the loop's clock [s]."""
        self._notifier.ticked(time.monotonic() if self._virtual else now)

    def _move_to_neutral(self) -> None:
        """Send neutral and wait until the servo is there, if fishd failed and could not fade."""
        if self._loop.servo.on and self._loop.instruction_angle != 0.0:
            with suppress(Exception):  # closing the servo comes later, and reports errors
                servo = self._loop.robot.servo
                servo.write(0.0)
                servo.write(0.0)  # a driver may not have sent the first after a late answer
                self._clock.sleep(NEUTRAL_TIME_S)

    def _release(self) -> None:
        """Release the servo before a controller is closed, because that may never return."""
        with suppress(ServoError):  # closing the servo comes later, and reports errors
            self._loop.robot.servo.release()

    def release_at_once(self) -> None:
        """Release the servo from another thread, while the main thread hangs.

        If the servo has a countdown, that has ended the pulses already, and they are not started
        again.
        """
        if self._loop.robot.countdown == math.inf:
            self._move_to_neutral()
        self._loop.robot.servo.close()

    def _on_press(self) -> None:
        """Stop the fish at once, between ticks; called from a thread of the driver."""
        self._events.call_soon_threadsafe(self._loop.estop, "the E-stop button was pressed")

    def _report(self) -> None:
        status = self._operations.status()
        self._telemetry.status(status)
        line = status_line(status)
        self._notifier.status(line)
        if self._print_status:
            console.info("%s", line)


def _clock(config: Config) -> Clock:
    return VirtualClock() if config.lockstep else SystemClock()


def _with_slow_motion(robot: Robot, slow: SlowMotion) -> Robot:
    """Return the robot with a line about slow motion in its `limitations`."""
    return dataclasses.replace(
        robot, limitations=lambda: (*robot.limitations(), slow.limitations())
    )


async def swim(
    config: Config,
    print_status: bool,
    shutdown: Shutdown,
    file: Path | None = None,
    overrides: Sequence[str] = (),
) -> bool:
    """Run a daemon until a signal, which may also come before the servo is driven.

    file, overrides: what the configuration was read from
    Return whether systemd shall start it again.
    """
    stopping = asyncio.Event()
    events = asyncio.get_running_loop()
    shutdown.call_when_requested(partial(events.call_soon_threadsafe, stopping.set))
    with Daemon(config, print_status, file, overrides) as daemon:
        shutdown.release = daemon.release_at_once
        if daemon.is_realtime:
            shutdown.raise_priority(config.realtime.priority)
        await asyncio.sleep(0)  # lets an earlier signal set `stopping`
        if not stopping.is_set():
            await daemon.run(stopping)
    return daemon.shall_restart()


@click.command(context_settings={"help_option_names": ["-h", "--help"]})
@click.option(
    "--config",
    "path",
    type=click.Path(path_type=Path, readable=False),
    help="Configuration file (YAML); without it, a simulated fish at rest.",
)
@click.option(
    "--set",
    "overrides",
    multiple=True,
    metavar="KEY=VALUE",
    help="Override one key of the configuration, such as plant.omega0=10. Repeatable.",
)
@click.option(
    "--print-status/--no-print-status",
    default=None,
    help="Print a status line every second; the default if standard output is a terminal.",
)
@log_format_option
@click.version_option(__version__, prog_name="fishd")
def fishd(
    path: Path | None, overrides: tuple[str, ...], print_status: bool | None, log_format: str
) -> int:
    """Run the robotic fish until SIGINT (Ctrl-C), SIGTERM or SIGHUP.

    Exit status: 0 after a clean stop, 1 when something failed, 2 for a wrong option, 75 to be
    started again, 78 when the configuration is wrong.
    """
    config = load(path, overrides)
    logs = LogWriter(log_format)
    shutdown = Shutdown()
    shutdown.last_words = logs.close
    show = bool(sys.stdout and sys.stdout.isatty()) if print_status is None else print_status
    try:
        restarts = asyncio.run(swim(config, show, shutdown, path, overrides))
    except ConfigError as error:  # in a calibration file
        log.critical("%s", error)
        return os.EX_CONFIG
    except FishdError as error:
        log.critical("%s", error)
        return 1
    except BaseException:  # an unexpected exit is a failure too
        log.critical("fishd failed; the servo is released", exc_info=True)
        return 1
    finally:
        if shutdown.release:
            logs.close()
        else:  # fishd has driven nothing, and the log holds only the reason
            logs.close(UNHURRIED_FLUSH_TIMEOUT_S)
    return os.EX_TEMPFAIL if restarts else 0


def main() -> None:
    """Run the `fishd` command."""
    exit_now(run(fishd, "fishd"))
