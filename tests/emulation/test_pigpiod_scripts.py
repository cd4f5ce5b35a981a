"""Scripts inside the emulated pigpiod, stored and run by the true client in virtual time."""

from collections.abc import Iterator

import pigpio
import pytest
from pigpiod_client import GPIO, PigpiodBench, pigpiod_bench

COUNTDOWN = "tag 0 mils 10 lda p0 cmp 0 jz 0 dcr p0 jnz 0 s p1 p2 jmp 0"
RELEASE = (
    "tag 0 mils 10 lda p0 cmp 0 jz 0 dcr p0 jnz 0 s p1 p2 mils 500 lda p0 cmp 0 jnz 0 s p1 0 jmp 0"
)
NEUTRAL = 1500
FRAME = 0.02


@pytest.fixture
def bench() -> Iterator[PigpiodBench]:
    with pigpiod_bench() as bench:
        yield bench


def armed(bench: PigpiodBench, text: str) -> int:
    """Run a countdown and swim for half a second; gives the script's number."""
    number = bench.stored(text)
    bench.pi.run_script(number, [20, GPIO, NEUTRAL])
    for tick in range(10):
        bench.pi.update_script(number, [20])
        bench.pi.set_servo_pulsewidth(GPIO, 1700 if tick % 2 else 1300)
        bench.sleep(0.05)
    return number


def changes_after(bench: PigpiodBench, seconds: float) -> list[tuple[float, float]]:
    """What becomes of the pulses in the next seconds: (how long from now, width)."""
    now = bench.clock.monotonic()
    bench.sleep(seconds)
    return [(time - now, width) for time, width in bench.daemon.history(GPIO) if time > now + FRAME]


def test_the_countdown_leaves_an_armed_servo_alone(bench: PigpiodBench) -> None:
    armed(bench, COUNTDOWN)
    assert {width for _, width in bench.daemon.history(GPIO)} == {1300, 1700}


def test_the_countdown_makes_the_servo_neutral_200_ms_after_the_last_update(
    bench: PigpiodBench,
) -> None:
    armed(bench, COUNTDOWN)
    ((time, width),) = changes_after(bench, 10.0)
    assert width == NEUTRAL
    # The last update was one tick ago.
    assert 0.19 <= time + 0.05 <= 0.21 + FRAME


def test_the_release_script_ends_the_pulses_half_a_second_later(bench: PigpiodBench) -> None:
    armed(bench, RELEASE)
    (neutral, neutral_width), (off, off_width) = changes_after(bench, 10.0)
    assert (neutral_width, off_width) == (NEUTRAL, 0)
    assert off - neutral == pytest.approx(0.5, abs=FRAME + 1e-6)


def test_arming_again_before_the_release_keeps_the_pulses(bench: PigpiodBench) -> None:
    number = armed(bench, RELEASE)
    bench.sleep(0.4)
    bench.pi.update_script(number, [20])
    bench.sleep(0.4)
    assert bench.width == NEUTRAL


def test_a_script_goes_through_its_states(bench: PigpiodBench) -> None:
    number = bench.pi.store_script(b"mils 100 wait 0x100000 mils 10")
    states = [bench.pi.script_status(number)[0]]
    for seconds in (0.002, 0.05, 0.1):
        bench.sleep(seconds)
        states.append(bench.pi.script_status(number)[0])
        if len(states) == 2:
            bench.pi.run_script(number)
    bench.pi.write(20, 1)
    states.append(bench.pi.script_status(number)[0])
    bench.sleep(0.02)
    states.append(bench.pi.script_status(number)[0])
    assert states == [
        pigpio.PI_SCRIPT_INITING,
        pigpio.PI_SCRIPT_HALTED,
        pigpio.PI_SCRIPT_RUNNING,
        pigpio.PI_SCRIPT_WAITING,
        pigpio.PI_SCRIPT_RUNNING,
        pigpio.PI_SCRIPT_HALTED,
    ]


def test_a_failed_script_says_so(bench: PigpiodBench) -> None:
    number = bench.stored("ret")
    bench.pi.run_script(number)
    bench.sleep(0.001)
    assert bench.pi.script_status(number)[0] == pigpio.PI_SCRIPT_FAILED


def test_status_gives_the_ten_parameters(bench: PigpiodBench) -> None:
    number = bench.stored("dcr p1")
    bench.pi.run_script(number, [7, 0])
    bench.sleep(0.001)
    assert bench.pi.script_status(number) == (pigpio.PI_SCRIPT_HALTED, (7, -1) + 8 * (0,))


def test_a_script_cannot_run_before_it_is_ready(bench: PigpiodBench) -> None:
    number = bench.pi.store_script(b"halt")
    assert bench.result("run_script", number) == pigpio.PI_SCRIPT_NOT_READY


def test_a_stopped_countdown_does_nothing_more(bench: PigpiodBench) -> None:
    number = armed(bench, COUNTDOWN)
    bench.pi.stop_script(number)
    assert changes_after(bench, 10.0) == []
    assert bench.pi.script_status(number)[0] == pigpio.PI_SCRIPT_HALTED


def test_a_deleted_script_does_nothing_more_and_is_unknown(bench: PigpiodBench) -> None:
    number = armed(bench, COUNTDOWN)
    bench.pi.delete_script(number)
    assert changes_after(bench, 10.0) == []
    for method in ("run_script", "update_script", "stop_script", "delete_script"):
        assert bench.result(method, number) == pigpio.PI_BAD_SCRIPT_ID
    assert bench.pi.script_status(number) == (pigpio.PI_BAD_SCRIPT_ID, ())


@pytest.mark.parametrize(
    ("text", "number"),
    [
        (b"frob 1", pigpio.PI_BAD_SCRIPT_CMD),
        (b"jmp 5", pigpio.PI_BAD_TAG),
        (b"tag 1 tag 1", pigpio.PI_DUP_TAG),
    ],
)
def test_a_bad_script_is_refused(bench: PigpiodBench, text: bytes, number: int) -> None:
    assert bench.result("store_script", text) == number


def test_there_is_room_for_32_scripts(bench: PigpiodBench) -> None:
    assert [bench.pi.store_script(b"halt") for _ in range(32)] == list(range(32))
    assert bench.result("store_script", b"halt") == pigpio.PI_NO_SCRIPT_ROOM
    bench.pi.delete_script(7)
    assert bench.pi.store_script(b"halt") == 7


def test_more_than_ten_parameters_are_refused(bench: PigpiodBench) -> None:
    number = bench.stored("halt")
    assert bench.result("run_script", number, list(range(11))) == pigpio.PI_TOO_MANY_PARAM


def test_several_scripts_run_side_by_side(bench: PigpiodBench) -> None:
    first = bench.stored("mils 30 s 18 1300 mils 60 s 18 1500")
    second = bench.stored("mils 60 s 18 1700")
    for number in (first, second):
        bench.pi.run_script(number)
    bench.sleep(1.0)
    bench.pi.script_status(first)
    assert [width for _, width in bench.daemon.history(GPIO)] == [1300, 1700, 1500]


def test_a_script_can_drive_hardware_pwm(bench: PigpiodBench) -> None:
    number = bench.stored("hp 18 333 p0")
    bench.pi.run_script(number, [333 * 1500])
    assert bench.settled_width == pytest.approx(1500, abs=0.01)


def test_a_script_without_end_or_pause_hangs_nobody(bench: PigpiodBench) -> None:
    bench.pi.run_script(bench.stored("tag 0 inr p0 jmp 0"))
    bench.sleep(3600)
    assert bench.pi.set_servo_pulsewidth(GPIO, NEUTRAL) == 0


def test_a_script_can_wait_for_an_event(bench: PigpiodBench) -> None:
    number = bench.stored("evtwt 4 sta p0")
    bench.pi.run_script(number)
    bench.sleep(0.01)
    bench.pi.event_trigger(1)
    bench.sleep(0.01)
    assert bench.pi.script_status(number)[0] == pigpio.PI_SCRIPT_WAITING
    bench.pi.event_trigger(2)
    bench.sleep(0.01)
    assert bench.pi.script_status(number) == (pigpio.PI_SCRIPT_HALTED, (4,) + 9 * (0,))
