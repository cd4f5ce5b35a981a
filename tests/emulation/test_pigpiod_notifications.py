"""Reports of the emulated pigpiod to the true client's callbacks."""

import contextlib
import itertools
import socket
import struct
from collections.abc import Iterator

import pigpio
import pytest
from pigpiod_client import GPIO, PigpiodBench, eventually, pigpiod_bench

LED = 20
Seen = list[tuple[int, int, int]]


@pytest.fixture
def bench() -> Iterator[PigpiodBench]:
    with pigpiod_bench() as bench:
        bench.pi.set_mode(LED, pigpio.OUTPUT)
        yield bench


def watched(bench: PigpiodBench, gpio: int) -> Seen:
    """What the client's callback is told about a GPIO: (GPIO, level, tick)."""
    seen: Seen = []
    bench.pi.callback(gpio, pigpio.EITHER_EDGE, lambda *report: seen.append(report))
    return seen


def run_for(bench: PigpiodBench, seconds: float, step: float = 0.005) -> None:
    """Let time pass as in a loop that looks at the daemon now and then."""
    for _ in range(round(seconds / step)):
        bench.sleep(step)
        bench.daemon.level(GPIO)


def test_a_callback_is_told_of_each_change_with_its_tick(bench: PigpiodBench) -> None:
    seen = watched(bench, LED)
    for seconds, level in ((1.0, 1), (0.5, 0), (0.25, 0)):
        bench.sleep(seconds)
        bench.pi.write(LED, level)
    assert eventually(lambda: len(seen) == 2)
    assert seen == [(LED, 1, 1_000_000), (LED, 0, 1_500_000)]


def test_nothing_is_said_of_other_pins(bench: PigpiodBench) -> None:
    seen = watched(bench, LED)
    bench.pi.write(21, 1)
    bench.pi.write(LED, 1)
    assert eventually(lambda: bool(seen))
    assert [gpio for gpio, *_ in seen] == [LED]


def test_servo_pulses_can_be_measured_with_callbacks(bench: PigpiodBench) -> None:
    seen = watched(bench, GPIO)
    bench.pi.set_servo_pulsewidth(GPIO, 1600)
    run_for(bench, 0.1)
    assert eventually(lambda: len(seen) >= 10)
    rises = [tick for _, level, tick in seen if level]
    falls = [tick for _, level, tick in seen if not level]
    assert [fall - rise for rise, fall in zip(rises, falls, strict=False)] == pytest.approx(
        [1600] * len(falls), abs=1
    )
    assert [b - a for a, b in itertools.pairwise(rises)] == pytest.approx(
        [20_000] * (len(rises) - 1), abs=1
    )


def test_a_trigger_pulse_is_two_changes(bench: PigpiodBench) -> None:
    seen = watched(bench, LED)
    bench.sleep(1.0)
    bench.pi.gpio_trigger(LED, 50, 1)
    assert eventually(lambda: len(seen) == 2)
    assert seen == [(LED, 1, 1_000_000), (LED, 0, 1_000_050)]


def test_a_change_of_the_pull_is_seen_on_an_input(bench: PigpiodBench) -> None:
    seen = watched(bench, 17)
    bench.pi.set_pull_up_down(17, pigpio.PUD_UP)
    assert eventually(lambda: [level for _, level, _ in seen] == [1])


def test_a_watchdog_reports_silence_again_and_again(bench: PigpiodBench) -> None:
    seen = watched(bench, LED)
    bench.pi.set_watchdog(LED, 100)
    run_for(bench, 0.35)
    assert eventually(lambda: len(seen) == 3)
    assert [level for _, level, _ in seen] == [pigpio.TIMEOUT] * 3
    assert [tick for *_, tick in seen] == pytest.approx([100_000, 200_000, 300_000], abs=1)


def test_a_change_puts_the_watchdog_off(bench: PigpiodBench) -> None:
    seen = watched(bench, LED)
    bench.pi.set_watchdog(LED, 100)
    run_for(bench, 0.08)
    bench.pi.write(LED, 1)
    run_for(bench, 0.08)
    bench.pi.set_watchdog(LED, 0)
    run_for(bench, 1.0)
    assert eventually(lambda: len(seen) == 1)
    assert seen[0][:2] == (LED, 1)


def test_a_glitch_filter_hides_short_levels_and_delays_long_ones(bench: PigpiodBench) -> None:
    seen = watched(bench, LED)
    bench.pi.set_glitch_filter(LED, 5000)
    run_for(bench, 0.1)
    for seconds, level in ((0.0, 1), (0.002, 0), (0.1, 1)):
        run_for(bench, seconds, 0.001)
        bench.pi.write(LED, level)
    run_for(bench, 0.1)
    assert eventually(lambda: bool(seen))
    assert [level for _, level, _ in seen] == [1]
    assert seen[0][2] == pytest.approx(207_000, abs=1)


def test_a_noise_filter_reports_for_a_while_after_a_quiet_time(bench: PigpiodBench) -> None:
    seen = watched(bench, LED)
    bench.pi.set_noise_filter(LED, 50_000, 20_000)
    run_for(bench, 0.1)
    for level in (1, 0, 1, 0, 1, 0):
        bench.pi.write(LED, level)
        bench.sleep(0.008)
    bench.pi.set_noise_filter(LED, 0, 0)
    assert eventually(lambda: len(seen) >= 3)
    assert [level for _, level, _ in seen[:3]] == [1, 0, 1]
    assert len(seen) < 6


def test_events_reach_their_callbacks(bench: PigpiodBench) -> None:
    seen: list[tuple[int, int]] = []
    bench.pi.event_callback(5, lambda *report: seen.append(report))
    bench.sleep(1.0)
    bench.pi.event_trigger(4)
    bench.pi.event_trigger(5)
    assert eventually(lambda: seen == [(5, 1_000_000)])


def test_a_cancelled_callback_is_told_no_more(bench: PigpiodBench) -> None:
    seen: Seen = []
    callback = bench.pi.callback(LED, pigpio.EITHER_EDGE, lambda *report: seen.append(report))
    callback.cancel()
    others = watched(bench, LED)
    bench.pi.write(LED, 1)
    assert eventually(lambda: bool(others))
    assert seen == []


def handle_of(link: socket.socket) -> int:
    """Ask for a notification handle on a connection."""
    link.sendall(struct.pack("<4I", 99, 0, 0, 0))
    return struct.unpack("<3Ii", link.recv(16))[3]


def test_there_are_32_handles_and_a_client_that_leaves_gives_its_own_back(
    bench: PigpiodBench,
) -> None:
    address = ("127.0.0.1", bench.daemon.port)
    with contextlib.ExitStack() as stack:
        links = [stack.enter_context(socket.create_connection(address)) for _ in range(32)]
        # The bench's own client has the first one.
        assert [handle_of(link) for link in links] == [*range(1, 32), pigpio.PI_NO_HANDLE]
        links[6].close()
        assert eventually(lambda: handle_of(links[-1]) == 7)


def test_a_report_is_sequence_flags_tick_and_all_levels(bench: PigpiodBench) -> None:
    sent: list[bytes] = []
    commands = bench.daemon._commands
    handle = commands.open_handle(sent.append)
    bench.pi.notify_begin(handle, 1 << LED)
    bench.sleep(2.0)
    bench.pi.write(LED, 1)
    bench.pi.write(LED, 0)
    reports = [struct.unpack("<HHII", report) for report in sent]
    assert [report[:3] for report in reports] == [(0, 0, 2_000_000), (1, 0, 2_000_000)]
    assert [report[3] >> LED & 1 for report in reports] == [1, 0]
    assert reports[0][3] & 0x1FF == 0x1FF  # the pins that are pulled up at power-on


def test_long_ago_changes_are_not_reported_one_by_one(bench: PigpiodBench) -> None:
    seen = watched(bench, GPIO)
    bench.pi.set_servo_pulsewidth(GPIO, 1500)
    bench.sleep(3600.0)
    assert bench.daemon.level(GPIO) in (0, 1)
    assert eventually(lambda: len(seen) >= 90)
    assert len(seen) <= 110
