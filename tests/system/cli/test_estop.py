"""`fishctl estop`: the pulses end by any way that works, and the verb names it."""

import json
import os
import signal
from pathlib import Path

import pytest
from rigs.gateway_processes import gateway
from rigs.operator_rig import Bench
from rigs.processes import Daemon, fishctl, one_line, running


def swim(pi: Bench, daemon: Daemon) -> None:
    assert daemon.fishctl("set-controller", "hold", "--angle", "0.2").returncode == 0
    pi.wait_for_pulse(1600, 1700)


def test_the_control_socket_is_asked_first(pi: Bench) -> None:
    with pi.daemon() as daemon:
        swim(pi, daemon)
        ended = daemon.fishctl("estop", "from a test")
        assert (ended.returncode, ended.stderr) == (0, "")
        assert ended.stdout.startswith("estop (from a test): hold")
        assert ended.stdout.endswith("\nstopped through: control socket\n")
        pi.wait_for_pulse(0, 0)
        state = json.loads(daemon.fishctl("estop", "--json").stdout)
    assert (state["way"], state["mode"]) == ("control socket", "estop")


def test_a_gateway_that_is_stopped_does_not_keep_the_pulses_on(pi: Bench) -> None:
    with pi.daemon() as daemon:
        swim(pi, daemon)
        os.kill(gateway(daemon), signal.SIGSTOP)
        ended = daemon.fishctl("estop")
        assert (ended.returncode, ended.stderr) == (0, "")
        assert (
            f"\nstopped through: fishd's own socket, {pi.folder}/control.estop, as the"
            in ended.stdout
        )
        pi.wait_for_pulse(0, 0)


@pytest.mark.parametrize("number", [signal.SIGSTOP, signal.SIGKILL])
def test_a_fishd_that_hangs_or_is_dead_keeps_no_pulses(pi: Bench, number: signal.Signals) -> None:
    with pi.daemon() as daemon:
        swim(pi, daemon)
        daemon.process.send_signal(number)
        try:
            ended = daemon.fishctl("estop")
            assert pi.pi.pulse() == 0
        finally:
            daemon.process.send_signal(signal.SIGCONT)
    assert (ended.returncode, ended.stderr) == (0, "")
    assert ended.stdout in (
        "pulses were on: neutral, then off\nstopped through: last resort\n",
        "there were no pulses\nstopped through: last resort\n",  # their countdown was faster
    )


def test_the_recipe_of_a_fishd_that_hangs_is_found_from_another_environment(pi: Bench) -> None:
    session = pi.folder / "session"
    session.mkdir()
    login = ("env", f"XDG_RUNTIME_DIR={session}")
    with running(pi.folder, *pi.settings, under=login) as daemon:
        swim(pi, daemon)
        cron = {name: value for name, value in os.environ.items() if name != "XDG_RUNTIME_DIR"}
        daemon.stop()
        try:
            hung = one_line(daemon.fishctl("status"))
            ended = daemon.fishctl_apart("estop", env=cron)
            assert pi.pi.pulse() == 0
        finally:
            daemon.process.send_signal(signal.SIGCONT)
    assert f"'fishctl estop --endpoint {daemon.endpoint}' ends the pulses without it" in hung
    assert (ended.returncode, ended.stderr) == (0, "")
    assert ended.stdout.endswith("\nstopped through: last resort\n")


def test_pulses_that_cannot_be_ended_are_no_success(pi: Bench) -> None:
    with pi.daemon() as daemon:
        swim(pi, daemon)
        daemon.kill()
        pi.pi.inject("pigpiod-frozen")
        line = one_line(daemon.fishctl("estop"))
    assert "the servo was not released and may still have pulses: cut its power" in line


def test_a_simulated_fish_that_hangs_has_no_pulses(tmp_path: Path) -> None:
    with running(tmp_path) as daemon:
        daemon.stop()
        try:
            ended = daemon.fishctl("estop")
        finally:
            daemon.process.send_signal(signal.SIGCONT)
    assert ended.returncode == 0
    assert ended.stdout.startswith("no pulses: the fish is simulated, and its fishd does not")


def test_without_a_fishd_and_without_a_servo_it_reports_that_it_did_nothing(tmp_path: Path) -> None:
    line = one_line(fishctl("--endpoint", f"ipc://{tmp_path}/control", "estop"))
    assert "nothing was released" in line
    assert "fishctl estop --config FILE" in line


def test_a_servo_of_this_machine_is_not_taken_for_that_of_another_machine(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "fish.yaml"
    file.write_text("robot: simulated\n")
    monkeypatch.setenv("FISHD_CONFIG", os.fspath(file))
    line = one_line(fishctl("--endpoint", "tcp://192.0.2.1:9", "estop"))
    assert "nothing was released: the servo is that of another machine" in line


def test_a_configuration_names_the_servo_of_a_fishd_without_a_recipe(pi: Bench) -> None:
    file = pi.folder / "fish.yaml"
    file.write_text(
        f"robot: virtual-pi\nstate_folder: {pi.folder}/state\n"
        f"virtual_pi: {{socket: {pi.folder}/virtual-pi}}\nservo: {{port: {pi.pi.port()}}}\n"
    )
    ended = fishctl("--endpoint", f"ipc://{pi.folder}/nowhere", "estop", "--config", str(file))
    assert (ended.returncode, ended.stderr) == (0, "")
    assert ended.stdout == "there were no pulses\nstopped through: last resort\n"
