"""The emulated pigpiod's commands, driven by the true pigpio client."""

from collections.abc import Iterator

import pigpio
import pytest
from pigpiod_client import GPIO, PigpiodBench, dispose, pigpiod_bench


@pytest.fixture
def bench() -> Iterator[PigpiodBench]:
    with pigpiod_bench() as bench:
        yield bench


def test_the_true_client_connects_and_finds_a_pi_4(bench: PigpiodBench) -> None:
    assert bench.pi.connected
    assert bench.pi.get_pigpio_version() == 79
    assert bench.pi.get_hardware_revision() == 0xC03112


def test_servo_pulses_begin_change_and_end(bench: PigpiodBench) -> None:
    bench.pi.set_servo_pulsewidth(GPIO, 1500)
    assert bench.settled_width == 1500
    bench.pi.set_servo_pulsewidth(GPIO, 1600)
    assert bench.settled_width == 1600
    bench.pi.set_servo_pulsewidth(GPIO, 0)
    assert bench.settled_width == 0
    assert [width for _, width in bench.daemon.history(GPIO)] == [1500, 1600, 0]


def test_a_new_width_waits_for_the_next_frame(bench: PigpiodBench) -> None:
    bench.pi.set_servo_pulsewidth(GPIO, 1500)
    bench.sleep(0.025)
    bench.pi.set_servo_pulsewidth(GPIO, 1600)
    bench.sleep(0.0149)
    assert bench.width == 1500
    bench.sleep(0.0002)
    assert bench.width == 1600


def test_the_pin_is_high_during_its_pulse_only(bench: PigpiodBench) -> None:
    bench.pi.set_servo_pulsewidth(GPIO, 1500)
    bench.sleep(0.041)
    assert bench.pi.read(GPIO) == bench.daemon.level(GPIO) == 1
    bench.sleep(0.001)
    assert bench.pi.read(GPIO) == bench.daemon.level(GPIO) == 0


def test_pulses_are_rounded_down_to_five_microseconds(bench: PigpiodBench) -> None:
    bench.pi.set_servo_pulsewidth(GPIO, 1504)
    assert bench.settled_width == 1500
    assert bench.pi.get_servo_pulsewidth(GPIO) == 1504


@pytest.mark.parametrize(
    ("method", "arguments", "number"),
    [
        ("set_servo_pulsewidth", (99, 1500), pigpio.PI_BAD_USER_GPIO),
        ("set_servo_pulsewidth", (30, 1500), pigpio.PI_NOT_PERMITTED),
        ("set_servo_pulsewidth", (GPIO, 499), pigpio.PI_BAD_PULSEWIDTH),
        ("set_servo_pulsewidth", (GPIO, 2501), pigpio.PI_BAD_PULSEWIDTH),
        ("get_servo_pulsewidth", (GPIO,), pigpio.PI_NOT_SERVO_GPIO),
        ("get_servo_pulsewidth", (32,), pigpio.PI_BAD_USER_GPIO),
        ("get_PWM_dutycycle", (GPIO,), pigpio.PI_NOT_PWM_GPIO),
        ("read", (54,), pigpio.PI_BAD_GPIO),
        ("get_mode", (54,), pigpio.PI_BAD_GPIO),
        ("set_mode", (4, 8), pigpio.PI_BAD_MODE),
        ("write", (4, 2), pigpio.PI_BAD_LEVEL),
        ("write", (40, 1), pigpio.PI_NOT_PERMITTED),
        ("set_pull_up_down", (4, 3), pigpio.PI_BAD_PUD),
        ("set_PWM_dutycycle", (4, 256), pigpio.PI_BAD_DUTYCYCLE),
        ("set_PWM_range", (4, 24), pigpio.PI_BAD_DUTYRANGE),
        ("set_PWM_range", (4, 40_001), pigpio.PI_BAD_DUTYRANGE),
        ("set_watchdog", (4, 60_001), pigpio.PI_BAD_WDOG_TIMEOUT),
        ("gpio_trigger", (4, 101, 1), pigpio.PI_BAD_PULSELEN),
        ("hardware_PWM", (4, 50, 75_000), pigpio.PI_NOT_HPWM_GPIO),
        ("hardware_PWM", (GPIO, 187_500_001, 0), pigpio.PI_BAD_HPWM_FREQ),
        ("hardware_PWM", (GPIO, 50, 1_000_001), pigpio.PI_BAD_HPWM_DUTY),
        ("notify_begin", (31, 1), pigpio.PI_BAD_HANDLE),
        ("set_glitch_filter", (4, 300_001), pigpio.PI_BAD_FILTER),
        ("set_noise_filter", (4, 1, 1_000_001), pigpio.PI_BAD_FILTER),
        ("event_trigger", (32,), pigpio.PI_BAD_EVENT_ID),
        ("set_bank_1", (1 << 31,), pigpio.PI_SOME_PERMITTED),
        ("stop_script", (0,), pigpio.PI_BAD_SCRIPT_ID),
        ("i2c_open", (1, 0x48), pigpio.PI_UNKNOWN_COMMAND),
    ],
)
def test_what_cannot_be_done_is_answered_with_pigpios_error(
    bench: PigpiodBench, method: str, arguments: tuple[int, ...], number: int
) -> None:
    assert bench.result(method, *arguments) == number


def test_an_error_is_an_exception_of_the_client(bench: PigpiodBench) -> None:
    with pytest.raises(pigpio.error, match="pulsewidth not 0 or 500-2500"):
        bench.pi.set_servo_pulsewidth(GPIO, 100)


def test_modes_and_levels_are_kept(bench: PigpiodBench) -> None:
    assert bench.pi.get_mode(4) == pigpio.INPUT
    bench.pi.write(4, 1)
    assert (bench.pi.get_mode(4), bench.pi.read(4)) == (pigpio.OUTPUT, 1)
    bench.pi.set_mode(4, pigpio.ALT2)
    assert bench.pi.get_mode(4) == pigpio.ALT2


def test_an_input_follows_its_pull(bench: PigpiodBench) -> None:
    bench.pi.set_pull_up_down(17, pigpio.PUD_UP)
    assert bench.pi.read(17) == 1
    assert bench.pi.read_bank_1() >> 17 & 1 == 1
    bench.pi.set_pull_up_down(17, pigpio.PUD_DOWN)
    assert bench.pi.read(17) == 0


def test_banks_set_and_clear_several_outputs(bench: PigpiodBench) -> None:
    for gpio in (20, 21):
        bench.pi.set_mode(gpio, pigpio.OUTPUT)
    bench.pi.set_bank_1(0b11 << 20)
    assert bench.pi.read_bank_1() >> 20 & 0b11 == 0b11
    bench.pi.clear_bank_1(0b01 << 20)
    assert bench.pi.read_bank_1() >> 20 & 0b11 == 0b10


def test_software_pwm_has_duty_range_and_frequency(bench: PigpiodBench) -> None:
    pi = bench.pi
    assert (pi.get_PWM_range(GPIO), pi.get_PWM_frequency(GPIO)) == (255, 800)
    assert pi.set_PWM_frequency(GPIO, 55) == 50
    assert pi.set_PWM_range(GPIO, 20_000) == pi.get_PWM_real_range(GPIO) == 4000
    pi.set_PWM_dutycycle(GPIO, 1500)
    assert pi.get_PWM_dutycycle(GPIO) == 1500
    assert bench.settled_width == 1500


def test_ending_software_pwm_cuts_the_pulse_under_way(bench: PigpiodBench) -> None:
    bench.pi.set_PWM_frequency(GPIO, 50)
    bench.pi.set_PWM_range(GPIO, 20_000)
    bench.pi.set_PWM_dutycycle(GPIO, 1500)
    bench.sleep(0.0407)
    bench.pi.set_PWM_dutycycle(GPIO, 0)
    assert bench.width == pytest.approx(700)
    assert bench.settled_width == 0


def test_servo_0_lets_the_pulse_under_way_end_by_itself(bench: PigpiodBench) -> None:
    bench.pi.set_servo_pulsewidth(GPIO, 1500)
    bench.sleep(0.0407)
    bench.pi.set_servo_pulsewidth(GPIO, 0)
    assert bench.width == 1500
    assert bench.settled_width == 0


def test_hardware_pwm_sends_duty_times_period(bench: PigpiodBench) -> None:
    bench.pi.hardware_PWM(GPIO, 333, 333 * 1500)
    bench.sleep(0.004)
    assert bench.width == pytest.approx(1500, abs=0.01)
    assert bench.pi.get_PWM_dutycycle(GPIO) == 333 * 1500
    assert bench.pi.get_PWM_frequency(GPIO) == 333
    assert bench.pi.get_PWM_range(GPIO) == 1_000_000


def test_hardware_pwm_takes_a_new_width_within_its_own_short_frame(bench: PigpiodBench) -> None:
    bench.pi.hardware_PWM(GPIO, 333, 333 * 1500)
    bench.sleep(0.1)
    bench.pi.hardware_PWM(GPIO, 333, 333 * 1600)
    bench.sleep(0.0031)
    assert bench.width == pytest.approx(1600, abs=0.01)


@pytest.mark.parametrize("off", [("hardware_PWM", GPIO, 0, 0), ("set_servo_pulsewidth", GPIO, 0)])
def test_hardware_pwm_ends(bench: PigpiodBench, off: tuple[str, int]) -> None:
    bench.pi.hardware_PWM(GPIO, 333, 333 * 1500)
    bench.sleep(0.1)
    method, *arguments = off
    getattr(bench.pi, method)(*arguments)
    assert bench.settled_width == 0


@pytest.mark.parametrize("command", [("write", 0), ("set_mode", pigpio.INPUT)])
def test_another_use_of_the_pin_ends_its_pulses(
    bench: PigpiodBench, command: tuple[str, int]
) -> None:
    bench.pi.set_servo_pulsewidth(GPIO, 1500)
    bench.sleep(0.05)
    getattr(bench.pi, command[0])(GPIO, command[1])
    assert bench.settled_width == 0
    assert bench.result("get_servo_pulsewidth", GPIO) == pigpio.PI_NOT_SERVO_GPIO


def test_ticks_are_the_clock_in_microseconds(bench: PigpiodBench) -> None:
    before = bench.pi.get_current_tick()
    bench.sleep(1.5)
    assert pigpio.tickDiff(before, bench.pi.get_current_tick()) == pytest.approx(1.5e6, abs=1)


def test_pulses_go_on_when_the_client_is_gone(bench: PigpiodBench) -> None:
    bench.pi.set_servo_pulsewidth(GPIO, 1500)
    dispose(bench.pi)
    bench.sleep(3600)
    assert bench.width == 1500
