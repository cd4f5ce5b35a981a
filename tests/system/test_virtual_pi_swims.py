"""The daemon on a virtual Pi in a separate process, as the README shows it."""

from collections.abc import Iterator

import pytest
from rigs.processes import Daemon, Subscriber, running
from rigs.virtual_pi_process import Pi, virtual_pi


@pytest.fixture(scope="module")
def swimming(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Pi, Daemon]]:
    folder = tmp_path_factory.mktemp("pi")
    with virtual_pi(folder) as pi, running(folder, *pi.settings) as daemon:
        yield pi, daemon


def test_the_shipped_configuration_swims_on_all_hardware(swimming: tuple[Pi, Daemon]) -> None:
    _, daemon = swimming
    with Subscriber(daemon.telemetry, b"tick") as subscriber:
        while (tick := subscriber.message())["thrust"] < 0.02 or tick["samples"] < 4:
            assert tick["mode"] == "running", daemon.fishctl("status").stdout
    assert 1.2 < tick["frequency"] < 2.2
    status = daemon.status()
    assert status.robot == "virtual-pi"
    assert any("not calibrated" in line for line in status.limitations)


def test_a_sensor_pulled_out_is_a_fault_that_a_clear_ends(swimming: tuple[Pi, Daemon]) -> None:
    pi, daemon = swimming
    with Subscriber(daemon.telemetry, b"tick") as ticks:
        pi.control("inject", "unplugged")
        ticks.until(mode="fault", servo_on=False)
        pi.wait_until_released()
        reason = daemon.status().reason
        assert reason
        assert reason.code == "sensor-stale"
        assert "check" in reason.message
        ticks.until(samples=0)
        pi.control("clear", "unplugged")
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
        pi.wait_until_released()
        assert daemon.fishctl("set-controller", "swing").returncode == 1
        daemon.fishctl("clear-fault")
        while "button is pressed" not in daemon.fishctl("status", "--json").stdout:  # not: was
            ticks.message()
        pi.control("release-button")
        for _ in range(100):  # until fishd has read the pin
            daemon.fishctl("clear-fault")
            if [ticks.message()["mode"] for _ in range(5)] == ["idle"] * 5:
                break
        ticks.until(mode="idle", servo_on=True)
