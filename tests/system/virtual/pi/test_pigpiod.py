"""The emulated pigpiod, driven by the real pigpio client: commands and connections."""

import socket
import struct
from collections.abc import Iterator

import pigpio
import pytest
from rigs.pigpiod_client import GPIO, Bench, dispose, eventually, pigpiod_bench

from fishd.virtual.pi.pigpiod.daemon import Pigpiod


@pytest.fixture
def bench() -> Iterator[Bench]:
    with pigpiod_bench() as bench:
        yield bench


def test_the_true_client_finds_a_pi_4(bench: Bench) -> None:
    assert bench.pi.get_pigpio_version() == 79
    assert bench.pi.get_hardware_revision() == 0xC03112
    before = bench.pi.get_current_tick()
    bench.sleep(1.5)
    assert pigpio.tickDiff(before, bench.pi.get_current_tick()) == 1_500_000
    bench.pi.write(4, 1)
    assert bench.pi.read_bank_1() >> 4 & 1 == 1


def test_pulses_are_rounded_down_to_five_microseconds(bench: Bench) -> None:
    bench.pi.set_servo_pulsewidth(GPIO, 1504)
    assert bench.settled_width == 1500
    assert bench.pi.get_servo_pulsewidth(GPIO) == 1504


@pytest.mark.parametrize(
    ("method", "arguments", "number"),
    [
        ("set_servo_pulsewidth", (99, 1500), pigpio.PI_BAD_USER_GPIO),
        ("set_servo_pulsewidth", (30, 1500), pigpio.PI_NOT_PERMITTED),
        ("set_servo_pulsewidth", (GPIO, 499), pigpio.PI_BAD_PULSEWIDTH),
        ("get_servo_pulsewidth", (GPIO,), pigpio.PI_NOT_SERVO_GPIO),
        ("get_PWM_dutycycle", (GPIO,), pigpio.PI_NOT_PWM_GPIO),
        ("set_PWM_dutycycle", (4, 256), pigpio.PI_BAD_DUTYCYCLE),
        ("hardware_PWM", (4, 50, 75_000), pigpio.PI_NOT_HPWM_GPIO),
        ("run_script", (0,), pigpio.PI_BAD_SCRIPT_ID),
        ("store_script", (b"jmp 5",), pigpio.PI_BAD_TAG),
    ],
)
def test_what_cannot_be_done_is_answered_with_pigpios_error(
    bench: Bench, method: str, arguments: tuple[object, ...], number: int
) -> None:
    assert bench.result(method, *arguments) == number


def test_what_is_not_emulated_is_refused(bench: Bench, caplog: pytest.LogCaptureFixture) -> None:
    assert bench.result("set_pull_up_down", 4, 2) == pigpio.PI_UNKNOWN_COMMAND
    assert bench.result("store_script", b"tag 0 inr p0 jmp 0") == pigpio.PI_BAD_SCRIPT_CMD
    command, instruction = caplog.messages
    assert "command PUD (2) is not emulated" in command
    assert "'inr' is not one of the emulated instructions: tag, " in instruction


def test_ending_software_pwm_cuts_the_pulse_under_way(bench: Bench) -> None:
    bench.pi.set_PWM_dutycycle(GPIO, 204)  # four fifths of 1250 µs
    assert bench.pi.get_PWM_dutycycle(GPIO) == 204
    assert bench.settled_width == 1000
    bench.sleep(0.0007)
    bench.pi.set_PWM_dutycycle(GPIO, 0)
    assert bench.width == pytest.approx(700)
    assert bench.settled_width == 0


@pytest.mark.parametrize("off", [("hardware_PWM", GPIO, 0, 0), ("set_servo_pulsewidth", GPIO, 0)])
def test_hardware_pwm_sends_duty_times_period_to_end(bench: Bench, off: tuple[str, int]) -> None:
    for width in (1500, 1600):
        bench.pi.hardware_PWM(GPIO, 333, 333 * width)
        assert bench.pi.get_PWM_dutycycle(GPIO) == 333 * width
        bench.sleep(0.0031)  # within its own short frame
        assert bench.width == pytest.approx(width, abs=0.01)
    method, *arguments = off
    getattr(bench.pi, method)(*arguments)
    assert bench.settled_width == 0


@pytest.mark.parametrize("command", [("write", 0), ("set_mode", pigpio.INPUT)])
def test_another_use_of_the_pin_ends_its_pulses(bench: Bench, command: tuple[str, int]) -> None:
    bench.pi.set_servo_pulsewidth(GPIO, 1500)
    bench.sleep(0.05)
    getattr(bench.pi, command[0])(GPIO, command[1])
    assert bench.settled_width == 0
    assert bench.result("get_servo_pulsewidth", GPIO) == pigpio.PI_NOT_SERVO_GPIO


def test_there_is_room_for_32_scripts_until_one_is_deleted(bench: Bench) -> None:
    assert [bench.pi.store_script(b"mils 1") for _ in range(32)] == list(range(32))
    assert bench.result("store_script", b"mils 1") == pigpio.PI_NO_SCRIPT_ROOM
    bench.pi.delete_script(7)
    assert bench.pi.script_status(7) == (pigpio.PI_BAD_SCRIPT_ID, ())
    assert bench.pi.store_script(b"mils 1") == 7


def test_commands_may_arrive_in_any_pieces(bench: Bench) -> None:
    with socket.create_connection(("127.0.0.1", bench.daemon.port)) as link:
        commands = struct.pack("<4I", 8, GPIO, 1500, 0) + struct.pack("<5I", 86, GPIO, 50, 4, 75000)
        for byte in commands:
            link.sendall(bytes([byte]))
        replies = b""
        while len(replies) < 32:
            replies += link.recv(64)
    assert struct.unpack("<8I", replies) == (8, GPIO, 1500, 0, 86, GPIO, 50, 0)


@pytest.mark.parametrize("garbage", [b"\xff" * 16, b"GET / HTTP/1.1\r\n\r\n"], ids=len)
def test_garbage_costs_its_sender_the_link_and_nobody_else(bench: Bench, garbage: bytes) -> None:
    with socket.create_connection(("127.0.0.1", bench.daemon.port), timeout=60) as link:
        link.sendall(garbage)
        assert link.recv(64) == b""
    assert bench.pi.set_servo_pulsewidth(GPIO, 1500) == 0


def test_closing_ends_every_connection_and_the_thread(bench: Bench) -> None:
    with socket.create_connection(("127.0.0.1", bench.daemon.port)) as link:
        dispose(bench.pi)
        bench.daemon.close()
        bench.daemon.close()
        assert link.recv(64) == b""
    assert eventually(lambda: not bench.daemon._thread.is_alive())
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.1", bench.daemon.port))


def test_a_port_that_is_taken_is_an_error_at_once(bench: Bench) -> None:
    another = Pigpiod(bench.clock, bench.faults, bench.daemon.port)
    with pytest.raises(OSError, match="in use"):
        another.start()
    another.close()
