"""`fishctl calibrate servo` as an operator does it: a real fishd, the pulses of a virtual Pi."""

import contextlib
import re
import signal
import time
from collections.abc import Iterator
from typing import cast

import pytest
from rigs.operator_rig import Bench, Dialogue, Talk, calibrations
from rigs.processes import LEASE, PATIENCE, Daemon, Subscriber
from rigs.virtual_daemon import VirtualDaemon

from fishd.cli.calibrate import servo
from fishd.client import Fish
from fishd.core.calibration import ServoCalibration
from fishd.core.signals import Tick


def test_the_servo_is_calibrated_by_small_steps(talk: Talk, rig: Bench, daemon: Daemon) -> None:
    dialogue = talk(daemon, "calibrate", "servo")
    dialogue.answer("trim +0 µs> ", "++")
    dialogue.answer("trim +25 µs> ", "+")
    dialogue.answer("trim +30 µs> ", "?")
    assert "is needed" in dialogue.expect("trim +30 µs> ")
    rig.wait_for_pulse(1529, 1531)
    dialogue.answer("", "ok")
    dialogue.expect("y, n, or a for again: ")
    rig.wait_for_pulse(1589, 1591)
    dialogue.answer("", "n")
    dialogue.expect("y, n, or a for again: ")
    rig.wait_for_pulse(1469, 1471)
    dialogue.answer("", "y")
    dialogue.answer("highest +0.00 rad> ", "++")
    dialogue.answer("highest +0.10 rad> ", "+")
    dialogue.answer("highest +0.12 rad> ", "-")
    dialogue.answer("highest +0.10 rad> ", "ok")
    for angle in ("0.00", "0.10", "0.20", "0.30", "0.40"):
        dialogue.answer(f"lowest {'-' if float(angle) else '+'}{angle} rad> ", "++")
    assert "amplitude_limit" in dialogue.expect("lowest -0.42 rad> ")
    dialogue.answer("", "ok")
    assert "lowest stays at -1.2" in dialogue.answer("Save it?", "y")
    assert dialogue.finish() == 0
    assert dialogue.text.endswith(f"saved in {rig.files('servo')[-1]}\n")
    with Fish(daemon.endpoint, timeout=PATIENCE) as fish:
        calibrations = fish.calibrations()
        assert (calibrations.servo.trim, calibrations.servo.direction) == (30.0, -1)
        assert (calibrations.servo.lowest, calibrations.servo.highest) == (-1.2, 0.1)
        assert fish.status().mode == "idle"
    rig.wait_for_pulse(1529, 1531)


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGHUP, signal.SIGTERM, None])
def test_an_interrupted_servo_calibration_leaves_neutral_and_the_previous_calibration(
    talk: Talk, rig: Bench, daemon: Daemon, how: int | None
) -> None:
    before = calibrations(daemon)
    dialogue = begin_trim_of_25(talk, rig, daemon)
    dialogue.answer("", "ok")
    dialogue.expect("again: ")
    rig.wait_for_pulse(1584, 1586)
    if how is not None:
        dialogue.process.send_signal(how)
        dialogue.process.wait(PATIENCE)
    assert dialogue.finish() == 130
    assert "the servo is at neutral; its calibration is as before\n" in dialogue.text
    assert "Traceback" not in dialogue.text
    assert calibrations(daemon) == before
    assert rig.files("servo") == []
    with Fish(daemon.endpoint, timeout=PATIENCE) as fish:
        assert fish.status().mode == "idle"
    rig.wait_for_pulse(1499, 1501)


def test_a_calibration_ends_with_a_killed_fishctl(talk: Talk, rig: Bench, daemon: Daemon) -> None:
    before = calibrations(daemon)
    with Subscriber(daemon.telemetry, b"event") as events:
        dialogue = begin_trim_of_25(talk, rig, daemon)
        dialogue.answer("", "ok")
        dialogue.expect("again: ")
        rig.wait_for_pulse(1584, 1586)
        dialogue.process.kill()
        assert "not renewed" in events.until(kind="calibration", level="warning")["message"]
    rig.wait_for_pulse(1499, 1501)
    assert calibrations(daemon) == before


def test_an_operator_may_take_time_and_no_other_program_moves_the_fish_meanwhile(
    talk: Talk, rig: Bench, daemon: Daemon
) -> None:
    dialogue = begin_trim_of_25(talk, rig, daemon)
    time.sleep(LEASE + 2.0)  # only fishctl renews the lease
    assert "\ncalibrating the servo, by a client\n" in daemon.fishctl("status").stdout
    swim, second = daemon.fishctl("set-controller", "swing"), daemon.fishctl("calibrate", "servo")
    assert re.fullmatch(r"fishctl: the servo is being calibrated.* \[calibrating\]\n", swim.stderr)
    assert re.fullmatch(r"fishctl: the fish is taken[^\n]* \[leased\]\n", second.stderr)
    dialogue.answer("", "-")
    dialogue.expect("trim +20 µs> ")
    assert dialogue.finish() == 130
    assert "calibrating" not in daemon.fishctl("status").stdout


def test_where_pulses_end_before_the_amplitude_the_limit_is_there_and_saved_after_a_yes(
    talk: Talk, pi: Bench
) -> None:
    with pi.daemon("--set", "servo.centre=2480", "--set", "servo.highest=0.02") as daemon:
        before = calibrations(daemon)
        for answer, status in (("n", 1), ("y", 0)):
            assert calibrations(daemon) == before
            dialogue = talk(daemon, "calibrate", "servo")
            dialogue.answer("trim +0 µs> ", "++")
            assert "beyond 500 to 2500" in dialogue.expect("trim +0 µs> ")
            for line in ("+", "+", "ok"):  # 10 µs are left, 0.0167 rad: less than the limit
                dialogue.answer("" if line == "+" else "trim +10 µs> ", line)
            dialogue.answer("again: ", "y")
            dialogue.answer("highest +0.00 rad> ", "ok")
            dialogue.answer("could not go this way at all; go to its limit first, or keep", "keep")
            dialogue.expect("highest is +0.0166 rad now, where the pulses of a servo end")
            dialogue.answer("lowest +0.00 rad> ", "keep")
            dialogue.answer("Save it?", answer)
            assert dialogue.finish() == status
        calibration = calibrations(daemon).servo
    assert (calibration.trim, calibration.highest, calibration.lowest) == (10.0, 0.0166, -1.2)


def test_a_lease_that_ends_meanwhile_is_reported(talk: Talk, rig: Bench, daemon: Daemon) -> None:
    dialogue = begin_trim_of_25(talk, rig, daemon)
    dialogue.process.send_signal(signal.SIGSTOP)
    rig.wait_for_pulse(1499, 1501)
    check_end_of_lease(dialogue)


def test_a_lease_that_ends_with_its_fishd_is_reported_at_the_prompt(talk: Talk, pi: Bench) -> None:
    with pi.daemon() as first:
        dialogue = begin_trim_of_25(talk, pi, first)
        # So that its first request goes to the second fishd
        dialogue.process.send_signal(signal.SIGSTOP)
    with pi.daemon():
        check_end_of_lease(dialogue)


def begin_trim_of_25(talk: Talk, rig: Bench, daemon: Daemon) -> Dialogue:
    dialogue = talk(daemon, "calibrate", "servo")
    dialogue.answer("trim +0 µs> ", "++")
    dialogue.expect("trim +25 µs> ")
    rig.wait_for_pulse(1524, 1526)
    return dialogue


def check_end_of_lease(stopped: Dialogue) -> None:
    stopped.process.send_signal(signal.SIGCONT)
    output = stopped.expect("[no-lease]\n")
    assert "the servo is at neutral; its calibration is as before\n" in output
    assert re.search(r"\nfishctl: this program no longer holds the fish[^\n]+\n$", output)
    assert stopped.process.wait(PATIENCE) == 1


def test_a_fault_in_the_middle_ends_it_in_one_line_with_the_calibration_of_before(
    talk: Talk, rig: Bench, daemon: Daemon
) -> None:
    before = calibrations(daemon)
    dialogue = begin_trim_of_25(talk, rig, daemon)
    rig.pi.inject("unplugged")
    with Fish(daemon.endpoint, timeout=PATIENCE) as fish:
        for status in iter(fish.status, None):
            if status.mode == "fault":
                break
    with contextlib.suppress(BrokenPipeError):  # the end of its lease may have ended it first
        dialogue.answer("", "+")
    assert dialogue.finish() == 1
    refused = r"fishd is in fault: [^\n]+clear-fault'"
    lease_lost = r"this program no longer holds the fish: fault: [^\n]+ \[no-lease\]"
    assert re.search(
        r"\nfishd is in fault, the servo is released; its calibration is as before\n"
        rf"fishctl: ({refused}|{lease_lost})\n$",
        dialogue.text,
    )
    assert rig.pi.pulse() == 0
    assert calibrations(daemon) == before


def test_the_death_of_the_daemon_ends_it_in_one_line(talk: Talk, pi: Bench) -> None:
    with pi.daemon() as daemon:
        dialogue = talk(daemon, "calibrate", "servo")
        dialogue.expect("trim +0 µs> ")
        daemon.kill()
    dialogue.answer("", "+")
    assert dialogue.finish() == 1
    unknown = r"the position of the servo is unknown: .+\nfishctl: no fishd at .+\n$"
    assert re.search(unknown, dialogue.text)


def test_no_servo_is_calibrated_while_it_swims_or_after_a_fault(rig: Bench, daemon: Daemon) -> None:
    daemon.fishctl("set-controller", "swing")
    swimming = daemon.fishctl("calibrate", "servo")
    daemon.fishctl("estop", "a test")
    stopped = daemon.fishctl("calibrate", "servo")
    assert (swimming.returncode, stopped.returncode) == (1, 1)
    assert swimming.stderr.startswith("fishctl: swing is the active controller; stop it with 'fish")
    assert re.fullmatch(r"fishctl: fishd is in estop: a test; [^\n]+\n", stopped.stderr)


class LaggingDaemon(VirtualDaemon):
    """Daemon with delayed telemetry: a new subscriber first receives some earlier ticks."""

    def ticks(self) -> Iterator[Tick]:
        yield from self._kept.ticks[-5:]
        yield from super().ticks()


def test_a_tick_from_before_a_request_is_not_taken_for_a_tail_that_stands_still(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(servo, "MOVE_INTERVAL_S", 0.0)
    daemon = LaggingDaemon()
    for _ in range(10):
        daemon.run.tick()
    tail = servo.Tail(cast(Fish, daemon), ServoCalibration())
    assert tail.move_to(0.1)
    assert (tail.angle, daemon.run.loop.instruction_angle) == (
        pytest.approx(0.1),
        pytest.approx(0.1),
    )
    tail.go_to_neutral()
    assert (tail.angle, daemon.run.loop.instruction_angle) == (0.0, 0.0)
