"""`fishctl calibrate servo` as an operator does it: a real fishd, the pulses of a virtual Pi."""

import re
import signal
import time

import pytest
from operator_rig import Bench, Talk, calibrations
from processes import PATIENCE, Daemon, Subscriber

from fishd.client import Fish
from fishd.protocol import LOAN


def test_the_servo_is_calibrated_by_small_steps_and_saved_after_a_yes(
    talk: Talk, pi: Bench, daemon: Daemon
) -> None:
    dialogue = talk(daemon, "calibrate", "servo")
    dialogue.answer("trim +0 µs> ", "++")
    dialogue.answer("trim +25 µs> ", "+")
    dialogue.answer("trim +30 µs> ", "?")
    assert "is needed" in dialogue.expect("trim +30 µs> ")
    pi.wait_for_pulse(1529, 1531)
    dialogue.answer("", "ok")
    dialogue.expect("y, n, or a for again: ")
    pi.wait_for_pulse(1589, 1591)
    dialogue.answer("", "n")
    dialogue.expect("y, n, or a for again: ")
    pi.wait_for_pulse(1469, 1471)
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
    assert dialogue.text.endswith(f"saved in {pi.files('servo')[-1]}\n")
    with Fish(daemon.endpoint) as fish:
        found = fish.calibrations()
        assert (found.servo.trim, found.servo.direction) == (30.0, -1)
        assert (found.servo.lowest, found.servo.highest) == (-1.2, 0.1)
        assert fish.status().mode == "idle"
    pi.wait_for_pulse(1529, 1531)


def test_the_servo_calibration_that_was_saved_is_in_force_in_the_next_daemon(
    talk: Talk, pi: Bench
) -> None:
    with pi.daemon() as daemon, Fish(daemon.endpoint) as fish:
        dialogue = talk(daemon, "calibrate", "servo")
        for prompt, line in (
            ("trim +0 µs> ", "--"),
            ("trim -25 µs> ", "ok"),
            ("again: ", "y"),
            ("rad> ", "ok"),  # at 0: the tail could not move at all
            ("first, or keep", ""),
            ("rad> ", "keep"),
            ("rad> ", "keep"),
            ("Save it?", "y"),
        ):
            dialogue.answer(prompt, line)
        assert dialogue.finish() == 0
        saved = fish.calibrations()
    with pi.daemon() as daemon, Fish(daemon.endpoint) as fish:
        assert fish.calibrations() == saved
        pi.wait_for_pulse(1474, 1476)


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGHUP, signal.SIGTERM, None])
def test_an_interrupted_servo_calibration_leaves_neutral_and_what_was_in_force(
    talk: Talk, pi: Bench, daemon: Daemon, how: int | None
) -> None:
    before = calibrations(daemon)
    dialogue = talk(daemon, "calibrate", "servo")
    dialogue.answer("trim +0 µs> ", "++")
    dialogue.answer("trim +25 µs> ", "ok")
    dialogue.expect("again: ")
    pi.wait_for_pulse(1584, 1586)
    if how is not None:
        dialogue.process.send_signal(how)
        dialogue.process.wait(20)
    assert dialogue.finish() == 130
    assert "the servo is at neutral; its calibration is as before\n" in dialogue.text
    assert "Traceback" not in dialogue.text
    assert calibrations(daemon) == before
    assert pi.files("servo") == []
    with Fish(daemon.endpoint) as fish:
        assert fish.status().mode == "idle"
    pi.wait_for_pulse(1499, 1501)


def test_a_calibration_whose_fishctl_is_killed_is_taken_back_by_fishd(
    talk: Talk, pi: Bench, daemon: Daemon
) -> None:
    before = calibrations(daemon)
    with Subscriber(daemon.telemetry, b"event") as events:
        dialogue = talk(daemon, "calibrate", "servo")
        dialogue.answer("trim +0 µs> ", "++")
        dialogue.answer("trim +25 µs> ", "ok")
        dialogue.expect("again: ")
        pi.wait_for_pulse(1584, 1586)
        dialogue.process.kill()
        assert "not renewed" in events.until(kind="calibration", level="warning")["message"]
    pi.wait_for_pulse(1499, 1501)
    assert calibrations(daemon) == before


def test_an_operator_may_take_time_and_nobody_else_moves_the_fish_meanwhile(
    talk: Talk, pi: Bench, daemon: Daemon
) -> None:
    dialogue = talk(daemon, "calibrate", "servo")
    dialogue.answer("trim +0 µs> ", "++")
    dialogue.expect("trim +25 µs> ")
    time.sleep(LOAN + 2.0)  # which is not renewed but by fishctl
    swim, second = daemon.fishctl("set-controller", "swing"), daemon.fishctl("calibrate", "servo")
    for ended in (swim, second):
        assert re.fullmatch(
            r"fishctl: the servo is being calibrated[^\n]* \[calibrating\]\n", ended.stderr
        )
    dialogue.answer("", "-")
    dialogue.expect("trim +20 µs> ")
    assert dialogue.finish() == 130


def test_status_shows_that_somebody_calibrates_the_servo(
    talk: Talk, pi: Bench, daemon: Daemon
) -> None:
    assert "calibrating" not in daemon.fishctl("status").stdout
    dialogue = talk(daemon, "calibrate", "servo")
    dialogue.expect("trim +0 µs> ")
    assert "\ncalibrating the servo, by a client\n" in daemon.fishctl("status").stdout
    assert dialogue.finish() == 130
    assert "calibrating" not in daemon.fishctl("status").stdout


def test_where_pulses_end_before_the_amplitude_the_limit_is_there_and_can_be_saved(
    talk: Talk, pi: Bench
) -> None:
    with pi.daemon("--set", "servo.centre=2300", "--set", "servo.highest=0.3") as daemon:
        dialogue = talk(daemon, "calibrate", "servo")
        for prompt, line in (
            ("trim +0 µs> ", "+"),  # 2305 µs: 195 µs, 0.325 rad are left
            ("trim +5 µs> ", "++"),  # 0.2833 rad are left, less than the limit of before
            ("trim +30 µs> ", "ok"),
            ("again: ", "y"),
            ("highest +0.00 rad> ", "keep"),
        ):
            dialogue.answer(prompt, line)
        dialogue.expect("highest is +0.2833 rad now, where the pulses of a servo end")
        dialogue.answer("lowest +0.00 rad> ", "keep")
        dialogue.answer("Save it?", "y")
        assert dialogue.finish() == 0
        found = calibrations(daemon).servo
    assert (found.highest, found.lowest) == (0.2833, -1.2)


def test_who_was_away_for_too_long_is_told_so_at_the_prompt(
    talk: Talk, pi: Bench, daemon: Daemon
) -> None:
    dialogue = talk(daemon, "calibrate", "servo")
    dialogue.answer("trim +0 µs> ", "++")
    dialogue.expect("trim +25 µs> ")
    pi.wait_for_pulse(1524, 1526)
    dialogue.process.send_signal(signal.SIGSTOP)
    pi.wait_for_pulse(1499, 1501)
    dialogue.process.send_signal(signal.SIGCONT)
    said = dialogue.expect("[no-loan]\n")
    assert "the servo is at neutral; its calibration is as before\n" in said
    assert re.search(r"\nfishctl: this loan has ended[^\n]+\n$", said)
    assert dialogue.process.wait(PATIENCE) == 1


def test_a_restart_of_fishd_is_told_at_the_prompt(talk: Talk, pi: Bench) -> None:
    with pi.daemon() as first:
        dialogue = talk(first, "calibrate", "servo")
        dialogue.answer("trim +0 µs> ", "++")
        dialogue.expect("trim +25 µs> ")
    with pi.daemon():
        assert "its calibration is as before" in dialogue.expect("[no-loan]\n")
        assert dialogue.process.wait(PATIENCE) == 1


def test_who_does_not_save_the_servo_calibration_keeps_the_one_before(
    talk: Talk, pi: Bench, daemon: Daemon
) -> None:
    before = calibrations(daemon)
    dialogue = talk(daemon, "calibrate", "servo")
    for line in ("++", "ok", "y", "keep", "keep", "n"):
        dialogue.answer(": " if line in "yn" else "> ", line)
    assert dialogue.finish() == 1
    assert "not saved" in dialogue.text
    assert calibrations(daemon) == before


def test_a_fault_in_the_middle_ends_it_in_one_line_with_the_calibration_of_before(
    talk: Talk, pi: Bench, daemon: Daemon
) -> None:
    before = calibrations(daemon)
    dialogue = talk(daemon, "calibrate", "servo")
    dialogue.answer("trim +0 µs> ", "++")
    dialogue.expect("trim +25 µs> ")
    pi.pi.inject("unplugged")
    with Fish(daemon.endpoint) as fish:
        for status in iter(fish.status, None):
            if status.mode == "fault":
                break
    dialogue.answer("", "+")
    assert dialogue.finish() == 1
    assert re.search(
        r"\nfishd is in fault, the servo is released; its calibration is as before\n"
        r"fishctl: fishd is in fault: [^\n]+clear-fault'\n$",
        dialogue.text,
    )
    assert pi.pi.pulse() == 0
    assert calibrations(daemon) == before


def test_the_death_of_the_daemon_ends_it_in_one_line(talk: Talk, pi: Bench, daemon: Daemon) -> None:
    dialogue = talk(daemon, "calibrate", "servo")
    dialogue.expect("trim +0 µs> ")
    daemon.process.kill()
    daemon.process.wait()
    dialogue.answer("", "+")
    assert dialogue.finish() == 1
    assert re.search(
        r"where the servo is cannot be told: [^\n]+\nfishctl: no fishd at [^\n]+\n$", dialogue.text
    )


def test_the_servo_is_not_calibrated_while_the_fish_swims_or_after_a_fault(
    pi: Bench, daemon: Daemon
) -> None:
    daemon.fishctl("set-controller", "swing")
    swimming = daemon.fishctl("calibrate", "servo")
    daemon.fishctl("estop", "a test")
    stopped = daemon.fishctl("calibrate", "servo")
    assert (swimming.returncode, stopped.returncode) == (1, 1)
    assert swimming.stderr == "fishctl: swing is in command; stop it with 'fishctl stop'\n"
    assert re.fullmatch(r"fishctl: fishd is in estop: a test; [^\n]+\n", stopped.stderr)


def test_a_trim_that_no_servo_takes_is_refused_and_the_dialogue_goes_on(
    talk: Talk,
    pi: Bench,
) -> None:
    with pi.daemon("--set", "servo.centre=2480", "--set", "servo.highest=0.02") as daemon:
        dialogue = talk(daemon, "calibrate", "servo")
        dialogue.answer("trim +0 µs> ", "++")
        assert "beyond 500 to 2500" in dialogue.expect("trim +0 µs> ")
        dialogue.answer("", "+")
        dialogue.expect("trim +5 µs> ")
        assert dialogue.finish() == 130
