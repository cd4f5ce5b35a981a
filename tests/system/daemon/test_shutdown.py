"""Shutdown of a process that hangs in various ways."""

import asyncio
import dataclasses
import re
import subprocess
import sys
import time
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from signal import SIGHUP, SIGINT, SIGTERM
from types import SimpleNamespace
from typing import Any

import pytest
from rigs.harness import Wrapped, fragile_rig
from rigs.pigpio_rig import TICK, Bench
from rigs.processes import PATIENCE, Daemon

from fishd.config import Config
from fishd.config.configuration import ControlSettings, TelemetrySettings
from fishd.controllers.hold import Hold, HoldParameters
from fishd.daemon.main import Daemon as DaemonInProcess
from fishd.hardware.base import Robot

PROGRAM = """
import logging, sys, threading, time
from fishd.core.process import shutdown as module
from fishd.core.process.shutdown import Shutdown, exit_now

{limits}

shutdown = Shutdown()
asked = threading.Event()
shutdown.call_when_requested(asked.set)
shutdown.release = lambda: (print("released", flush=True), {release})
logging.basicConfig(format="%(message)s", stream=sys.stdout)
shutdown.last_words = sys.stdout.flush
{last}
print("up", flush=True)
{hang}
asked.wait()
exit_now(7)
"""
TIME_LIMIT_S = 3.0
SLOW_LAST_WORDS = "module._MESSAGE_TIMEOUT_S = 10.0"
"""Statement for tests of the message of the last resort, not of its time."""


def ends(*hangs: Mapping[str, Any]) -> list[tuple[int, str]]:
    """Return exit status and output of processes, each of which must end within 3 s of its signal.

    They run at the same time, since each of them only waits.
    """
    with ExitStack() as stack:
        processes = [stack.enter_context(start_process(**hang)) for hang in hangs]
        for process in processes:
            stack.callback(process.kill)
            assert process.stdout
            assert process.stdout.readline() == "up\n"
        time.sleep(0.1)
        pool = stack.enter_context(ThreadPoolExecutor(len(hangs)))
        numbers = [hang.get("number", SIGTERM) for hang in hangs]
        return list(pool.map(end_process, processes, numbers))


def start_process(
    hang: str = "", release: str = "None", number: int = SIGTERM, limits: str = "", last: str = ""
) -> "subprocess.Popen[str]":
    """Start a process. limits, last: statements before and after the last resort is set up"""
    program = PROGRAM.format(hang=hang, release=release, limits=limits, last=last)
    return subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True)


def end_process(process: "subprocess.Popen[str]", number: int) -> tuple[int, str]:
    """Send a signal; return exit status and output."""
    started = time.monotonic()
    process.send_signal(number)
    output = process.communicate(timeout=PATIENCE)[0]
    assert time.monotonic() - started <= TIME_LIMIT_S
    return process.returncode, output


@pytest.mark.realtime
def test_an_orderly_shutdown_needs_no_last_resort() -> None:
    signals = (SIGTERM, SIGINT, SIGHUP)
    assert ends(*({"number": number} for number in signals)) == [(7, "")] * 3


@pytest.mark.realtime
def test_a_process_that_hangs_lets_go_of_the_servo_and_ends() -> None:
    hangs = [
        "while True: pass",
        "time.sleep(60)",
        "threading.Lock().acquire(); import os; os.read(os.pipe()[0], 1)",
        "signal = __import__('signal'); signal.signal(15, lambda *_: None); time.sleep(60)",
    ]
    limits = f"{SLOW_LAST_WORDS}; module._RELEASE_TIMEOUT_S = 10.0"
    for status, output in ends(*({"hang": hang, "limits": limits} for hang in hangs)):
        assert (status, output.partition("\n")[0]) == (1, "released")
        message = r"fishd hangs in .+: the servo is released and the process is ended"
        assert re.search(message, output)


@pytest.mark.realtime
def test_a_servo_that_is_not_released_keeps_nobody_and_is_named() -> None:
    releases = ("time.sleep(60)", "1 / 0")
    hang = {"hang": "time.sleep(60)", "limits": SLOW_LAST_WORDS}
    for status, output in ends(*(hang | {"release": release} for release in releases)):
        assert (status, output.partition("\n")[0]) == (1, "released")
        assert "the servo may keep its pulses ('fishctl estop' ends them)" in output


@pytest.mark.realtime
def test_a_busy_machine_has_time_for_the_last_line() -> None:
    slow = "module.log.addFilter(lambda record: time.sleep(0.3) or True)"
    ((status, output),) = ends({"hang": "time.sleep(60)", "last": slow})
    assert status == 1
    assert "fishd hangs in" in output


@pytest.mark.realtime
def test_last_words_that_hang_keep_nobody() -> None:
    hang = {"hang": "time.sleep(60)", "release": "time.sleep(60)"}
    functions = ("module.log.critical", "shutdown.last_words")
    lasts = [f"{name} = lambda *arguments: time.sleep(60)" for name in functions]
    assert [status for status, _ in ends(*(hang | {"last": last} for last in lasts))] == [1, 1]


@pytest.mark.realtime
def test_a_thread_that_a_controller_left_behind_keeps_nobody() -> None:
    assert ends({"hang": "threading.Thread(target=time.sleep, args=(60,)).start()"}) == [(7, "")]


def test_below_nohup_a_terminal_that_closes_is_nothing(tmp_path: Path) -> None:
    daemon = Daemon(tmp_path, under=["nohup"]).wait_until_up()
    daemon.process.send_signal(SIGHUP)
    with pytest.raises(subprocess.TimeoutExpired):
        daemon.process.wait(0.5)
    assert daemon.end()[0] == 0


@pytest.mark.parametrize("countdown", [0.2, float("inf")])
def test_a_servo_without_a_countdown_comes_to_rest_before_it_is_released(countdown: float) -> None:
    class Robust(Wrapped):
        def robot(self) -> Robot:
            return dataclasses.replace(super().robot(), countdown=countdown)

    rig, robot = fragile_rig(kind=Robust)
    rig.start("hold", angle=0.3)
    rig.run(10)
    robot.log.clear()

    async def release() -> None:
        daemon = DaemonInProcess(Config(lockstep=True), print_status=False)
        daemon._loop = rig.loop
        daemon.release_at_once()

    asyncio.run(release())
    assert robot.log == ([None] if countdown == 0.2 else [0.0, 0.0, None])


def test_an_answer_of_pigpiod_that_is_late_just_then_keeps_no_tail_from_neutral() -> None:
    with ExitStack() as stack:
        bench = Bench(stack)
        servo = bench.servo()
        servo.write(0.5)
        bench.wait(TICK)
        assert bench.width == 1800
        bench.faults.inject("pigpiod-frozen")
        widths: list[float] = []

        class Thawing:
            """Servo whose pigpiod answers again after the first write has timed out."""

            def write(self, angle: float) -> None:
                servo.write(angle)
                bench.faults.clear()

        def rest(seconds: float) -> None:
            widths.append(bench.width)

        shown, robot = SimpleNamespace(on=True), SimpleNamespace(servo=Thawing())
        loop: Any = SimpleNamespace(servo=shown, instruction_angle=0.5, robot=robot)

        async def move_to_neutral() -> None:
            daemon = DaemonInProcess(Config(lockstep=True), print_status=False)
            daemon._loop, daemon._clock = loop, SimpleNamespace(sleep=rest)  # type: ignore
            daemon._move_to_neutral()

        asyncio.run(move_to_neutral())
        assert servo.driver.counters()["servo_late_answers"] == 1
        assert widths == [1500]


def test_where_fishd_fails_the_servo_is_released_before_a_controller_is_closed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    done: list[str] = []

    class Closing(Hold):
        def close(self) -> None:
            done.append("closed")  # a real `close` might never return

    async def fail() -> None:
        control = ControlSettings(address=f"ipc://{tmp_path}/control")
        telemetry = TelemetrySettings(address=f"ipc://{tmp_path}/telemetry")
        config = Config(lockstep=True, control=control, telemetry=telemetry)
        with DaemonInProcess(config, print_status=False) as daemon:
            loop = daemon._loop
            monkeypatch.setattr(loop.robot.servo, "release", lambda: done.append("released"))
            loop.set_controller("hold", Closing(HoldParameters(), loop.limits))
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        asyncio.run(fail())
    assert done == ["released", "closed"]
