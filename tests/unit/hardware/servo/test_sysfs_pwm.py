"""Servo on the kernel's PWM: pulses, takeover of old pulses, release, last resort."""

import contextlib
from pathlib import Path

import pytest
from rigs.sysfs_pwm_rig import PI5, Bench

from fishd.core.calibration import ServoCalibration
from fishd.core.clock import VirtualClock
from fishd.core.errors import ServoError
from fishd.hardware.servo.calibrated_servo import CalibratedServo
from fishd.hardware.servo.sysfs_pwm import SysfsPwm, SysfsPwmSettings


@pytest.fixture
def bench() -> Bench:
    return Bench()


def test_opening_moves_nothing(bench: Bench) -> None:
    servo = bench.servo()
    bench.clock.sleep(1.0)
    assert bench.widths() == []
    servo.close()
    assert bench.exported() == []


@pytest.mark.parametrize("frequency", [50.0, 333.0])
def test_pulses_come_at_the_configured_frequency(bench: Bench, frequency: float) -> None:
    servo = bench.servo(SysfsPwmSettings(frequency=frequency))
    assert bench.write(servo, 1.2) == pytest.approx(2220.0)
    assert bench.kernel.pulses(PI5, 2).at(bench.clock.now).frame == pytest.approx(1 / frequency)


def test_release_ends_the_last_pulse_and_write_begins_again(bench: Bench) -> None:
    servo = bench.servo()
    bench.write(servo, 0.3)
    bench.go_into_a_pulse()
    servo.release()
    servo.release()
    bench.clock.sleep(0.02)
    assert bench.width() == 0.0
    bench.write(servo, 0.1)
    servo.close()
    assert set(bench.widths()) == {0.0, 1680.0, 1560.0}


def test_close_switches_the_channel_off_and_gives_it_back(bench: Bench) -> None:
    servo = bench.servo()
    bench.write(servo, 0.3)
    bench.go_into_a_pulse()
    servo.close()
    servo.close()
    assert bench.widths() == [1680.0, 0.0]  # and no shorter pulse in between
    assert bench.exported() == []


def test_what_a_killed_fishd_left_behind_is_taken_over(bench: Bench) -> None:
    killed = bench.servo(SysfsPwmSettings(frequency=100.0))
    bench.write(killed, 0.4)
    servo = bench.servo()
    assert bench.width() == 1740.0  # opening changes nothing
    assert bench.write(servo, 0.0) == 1500.0
    assert bench.kernel.pulses(PI5, 2).at(bench.clock.now).frame == 0.02
    servo.close()
    assert bench.exported() == []


def test_a_release_stops_pulses_that_a_killed_fishd_left_behind(bench: Bench) -> None:
    bench.write(bench.servo(), 0.4)
    servo = bench.servo()
    servo.release()
    bench.clock.sleep(0.02)
    assert bench.width() == 0.0


def test_a_channel_that_the_kernel_only_believes_to_be_on_gets_pulses(bench: Bench) -> None:
    careless = bench.servo()
    bench.write(careless, 0.0)
    bench.shell("pwmchip1/unexport", 2)
    bench.clock.sleep(0.1)
    assert bench.width() == 0.0
    servo = bench.servo()
    assert bench.write(servo, 0.0) == 1500.0


def test_the_last_resort_moves_to_neutral_then_stops(bench: Bench) -> None:
    bench.write(bench.servo(), 0.5)  # the pulses of a killed fishd
    bench.go_into_a_pulse()
    started = bench.clock.now
    assert bench.last_resort(1530.0) is True
    assert bench.widths() == [1800.0, 1530.0, 0.0]
    neutral, off = (time for time, _ in bench.kernel.pulses(PI5, 2).history[1:])
    assert neutral - started <= 0.02
    assert 0.28 <= off - neutral <= 0.32


def test_the_last_resort_leaves_a_servo_without_pulses_alone(bench: Bench) -> None:
    assert bench.last_resort() is False
    assert bench.widths() == []
    assert bench.exported() == []


def test_a_living_fishd_notices_the_last_resort(bench: Bench) -> None:
    servo = bench.servo()
    bench.write(servo, 0.5)
    assert bench.last_resort() is True
    assert bench.exported() == ["pwm2"]  # fishd still holds it
    with pytest.raises(ServoError, match="switched off from outside"):
        servo.write(0.5)


def test_the_last_resort_reports_pulses_that_another_program_starts_again(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench.write(bench.servo(), 0.5)
    sleep = bench.clock.sleep

    def sleep_while_another_program_writes(seconds: float) -> None:
        sleep(seconds)
        bench.shell("pwmchip1/pwm2/duty_cycle", 1_600_000)
        bench.shell("pwmchip1/pwm2/enable", 1)

    monkeypatch.setattr(bench.clock, "sleep", sleep_while_another_program_writes)
    with pytest.raises(ServoError, match="has pulses again: another program drives it"):
        bench.last_resort()


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """Return a folder of plain files with an exported channel."""
    device = tmp_path / "devices" / PI5
    chip = device / "pwm" / "pwmchip3"
    channel = chip / "pwm2"
    channel.mkdir(parents=True)
    (chip / "device").symlink_to(device)
    for name in ("export", "unexport"):
        (chip / name).write_text("")
    for name in ("period", "duty_cycle", "enable"):
        (channel / name).write_text("0\n")
    root = tmp_path / "class"
    root.mkdir()
    (root / "pwmchip3").symlink_to(chip)
    return root


def on_true_files(settings: SysfsPwmSettings) -> CalibratedServo:
    rest = (ServoCalibration(), VirtualClock())
    return CalibratedServo(SysfsPwm, settings, *rest, threaded=False, tick=0.05)


def open_files(tree: Path) -> int:
    """Return the number of files of this tree that this process has open."""
    count = 0
    for link in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(FileNotFoundError):  # the descriptor of the listing itself
            count += link.readlink().is_relative_to(tree.parent.resolve())
    return count


def number(path: Path) -> int:
    return int(path.read_text().split()[0])


def test_on_true_files_a_channel_is_driven_released_and_unexported(tree: Path) -> None:
    settings = SysfsPwmSettings(root=str(tree))
    servo = on_true_files(settings)
    channel = tree / "pwmchip3" / "pwm2"
    assert (channel / "enable").read_text() == "0\n"
    servo.write(1.0)
    assert open_files(tree) > 0
    written = [number(channel / name) for name in ("period", "duty_cycle", "enable")]
    assert written == [20_000_000, 2_100_000, 1]
    servo.write(-1.0)
    assert number(channel / "duty_cycle") == 900_000
    servo.release()
    assert number(channel / "duty_cycle") == 0
    servo.close()
    assert number(channel / "enable") == 0
    assert (tree / "pwmchip3" / "unexport").read_text() == "2\n"
    assert open_files(tree) == 0
