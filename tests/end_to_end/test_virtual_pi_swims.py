"""The daemon on a virtual Pi in a process of its own, as the README shows it."""

import json
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from processes import FISHCTL, PATIENCE, Daemon, Subscriber, running

PANEL = ["--set", "panel.estop_gpio=17", "--set", "panel.led_gpio=27"]
SHIPPED = str(Path(__file__).parents[2] / "config" / "virtual-pi.yaml")


class Pi:
    """A running `fishctl virtual-pi run`."""

    def __init__(self, folder: Path) -> None:
        self._place = ["--set", f"virtual_pi.socket={folder}/pi"]
        self.process = subprocess.Popen(
            [
                *(FISHCTL, "virtual-pi", "run", "--config", SHIPPED, *self._place, *PANEL),
                *("--set", "virtual_pi.pigpio_port=0"),
            ],
            stdout=subprocess.PIPE,
            text=True,
        )
        assert self.process.stdout
        port = self.process.stdout.readline().partition("127.0.0.1:")[2].split()[0]
        self.settings = [
            *("--config", SHIPPED, *self._place),
            *("--set", f"servo.pigpio.port={port}"),
            *("--set", "servo.pigpio.timeout=0.1"),  # machines that run tests may stall
            *("--set", f"state_folder={folder}"),
            *PANEL,
        ]

    def control(self, *arguments: str) -> str:
        command = [FISHCTL, "virtual-pi", *arguments, *self._place, *PANEL]
        run = subprocess.run(command, capture_output=True, text=True, check=False, timeout=PATIENCE)
        assert run.returncode == 0, run.stderr
        return run.stdout

    def pulse(self) -> float:
        found: float = json.loads(self.control("status", "--json"))["pulse"]
        return found


@contextmanager
def virtual_pi(folder: Path) -> Iterator[Pi]:
    pi = Pi(folder)
    try:
        yield pi
    finally:
        pi.process.terminate()
        pi.process.communicate(timeout=PATIENCE)


@pytest.fixture(scope="module")
def swimming(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Pi, Daemon]]:
    folder = tmp_path_factory.mktemp("pi")
    with virtual_pi(folder) as pi, running(folder, *pi.settings) as daemon:
        yield pi, daemon


def test_the_shipped_configuration_swims_through_the_whole_hardware_path(
    swimming: tuple[Pi, Daemon],
) -> None:
    _, daemon = swimming
    with Subscriber(daemon.telemetry, b"tick") as subscriber:
        while (tick := subscriber.message())["thrust"] < 0.02:
            assert tick["mode"] == "running", daemon.fishctl("status").stdout
    assert tick["samples"] >= 4
    assert 1.2 < tick["frequency"] < 2.2
    status = json.loads(daemon.fishctl("status", "--json").stdout)
    assert status["robot"] == "virtual-pi"
    assert any("not calibrated" in line for line in status["degraded"])


def test_a_sensor_that_is_pulled_out_is_a_fault_that_a_clear_ends(
    swimming: tuple[Pi, Daemon],
) -> None:
    pi, daemon = swimming
    with Subscriber(daemon.telemetry, b"tick") as ticks:
        pi.control("inject", "unplugged")
        ticks.until(mode="fault", servo_on=False)
        assert pi.pulse() == 0.0
        reason = json.loads(daemon.fishctl("status", "--json").stdout)["reason"]
        assert reason["code"] == "sensor-stale"
        assert "check" in reason["message"]
        pi.control("clear", "unplugged")
        ticks.until(samples=0)
        while ticks.message()["samples"] < 2:
            pass
        daemon.fishctl("clear-fault")
        daemon.fishctl("set-controller", "swing")
        ticks.until(mode="running", servo_on=True)


def test_the_button_of_the_panel_stops_the_pulses_until_it_is_released_and_the_stop_cleared(
    swimming: tuple[Pi, Daemon],
) -> None:
    pi, daemon = swimming
    with Subscriber(daemon.telemetry, b"tick") as ticks:
        pi.control("press")
        ticks.until(mode="estop", servo_on=False)
        assert pi.pulse() == 0.0
        assert daemon.fishctl("set-controller", "swing").returncode == 1
        daemon.fishctl("clear-fault")
        ticks.until(mode="estop", servo_on=False)
        pi.control("unpress")
        daemon.fishctl("clear-fault")
        ticks.until(mode="idle", servo_on=True)
