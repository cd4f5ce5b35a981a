"""`fishctl doctor --bench`: its figures and verdicts, in virtual time."""

import math
from collections.abc import Callable

import pytest

from fishd.cli.doctor.bench import analog, cyclictest, pulses
from fishd.cli.doctor.bench.report import Bus, Ending, Filter
from fishd.core.clock import VirtualClock
from fishd.hardware.checks import Result
from fishd.hardware.servo.pigpio_edges import Edge
from fishd.virtual.pi.pulse_train import PulseTrain
from fishd.virtual.pi.rc_filter import RcFilter

FRAME = 0.02
WIDTHS = [2220.0, 1860.0, 1500.0, 1140.0, 780.0]


def measured(
    tau: float | None = 0.1,
    change: Callable[[float], float] = lambda volts: volts,
    stalls: tuple[float, float] = (0.0, 0.0),
) -> Filter | Result:
    """Return the measurement through a filter; tau: None without a wire; change: the ADC's error

    stalls: how long the program stands still before and after a conversion, once, soon after the
        first pulse [s]
    """
    clock, train = VirtualClock(), PulseTrain()
    rc = RcFilter(train.edges, tau or 0.0)
    first_pulse = math.inf
    naps = iter([stalls])

    def read_volts() -> float:
        soon_after = clock.now > first_pulse + 0.03
        before, after = next(naps, (0.0, 0.0)) if soon_after else (0.0, 0.0)
        clock.sleep(before)
        start = clock.now
        clock.sleep(1 / 860)
        volts = 0.0 if tau is None else rc.mean(start, clock.now)
        clock.sleep(after)
        return change(volts)

    def write(width: float) -> None:
        nonlocal first_pulse
        first_pulse = min(first_pulse, clock.now)
        train.set(clock.now, width)

    return analog.measure_filter(read_volts, write, WIDTHS, FRAME, 0.05, clock)


def test_a_good_adc_follows_the_duty_of_the_pulses() -> None:
    good = measured()
    assert good.high_level == pytest.approx(3.3, abs=0.005)
    assert abs(good.offset) < 1e-3
    assert good.time_constant == pytest.approx((0.1, 0.1), abs=FRAME)
    assert analog.judge_filter(good).level == "ok"


@pytest.mark.parametrize("stalls", [(0.3, 0.0), (0.0, 0.3), (2.0, 0.0), (0.0, 2.0)])
def test_a_stall_during_the_rise_is_not_blamed_on_the_filter(stalls: tuple[float, float]) -> None:
    good = measured(stalls=stalls)
    low, high = good.time_constant
    assert low < 0.1 < high
    assert analog.judge_filter(good).level == "ok"


@pytest.mark.parametrize(
    ("tau", "change", "level", "words"),
    [
        (None, lambda volts: volts, "FAIL", "no wire leads to it"),
        (0.0, lambda volts: volts, "FAIL", "without the resistor and the capacitor"),
        (0.02, lambda volts: volts, "warning", "not 0.1 s"),
        (0.3, lambda volts: volts, "warning", "not 0.1 s"),
        (0.1, lambda volts: 1.1 * volts, "FAIL", "+10.0%"),
        (0.1, lambda volts: volts + 0.03, "warning", "+30.0 mV without pulses"),
        (0.1, lambda volts: volts + 0.02 * (volts > 0.22), "warning", "mV off a line"),
    ],
    ids=["no wire", "no filter", "small filter", "large filter", "gain", "offset", "a step"],
)
def test_a_fault_between_pulses_and_adc_is_named(
    tau: float | None, change: Callable[[float], float], level: str, words: str
) -> None:
    result = measured(tau, change)
    result = analog.judge_filter(result) if isinstance(result, Filter) else result
    assert result.level == level
    assert words in result.message


@pytest.mark.parametrize(
    ("rate", "configured", "level"),
    [(395e3, 400e3, "ok"), (250e3, 400e3, "warning"), (100e3, None, "ok")],
)
def test_the_bit_rate_is_compared_with_the_device_tree(
    rate: float, configured: float | None, level: str
) -> None:
    assert analog.judge_bus(Bus(rate, configured, 1e-4)).level == level


@pytest.mark.parametrize(
    ("bounds", "level"), [((0.95, 1.0), "ok"), ((0.7, 0.8), "FAIL"), ((1.2, 1.3), "FAIL")]
)
def test_an_oscillator_beyond_its_tolerance_fails(bounds: tuple[float, float], level: str) -> None:
    assert analog.judge_conversion(Bus(4e5, 4e5, 1e-4, bounds)).level == level


def train_of(widths: list[float], late: float = 0.0, skip: int | None = None) -> list[Edge]:
    """Return the edges of pulses; every second one is `late` [s], and `skip` is missing."""
    edges = []
    for index, width in enumerate(widths):
        start = index * FRAME + (late if index % 2 else 0.0)
        if index != skip:
            edges += [Edge(start, 1), Edge(start + width * 1e-6, 0)]
    return edges


@pytest.mark.parametrize(
    ("edges", "level"),
    [
        (train_of([1500.0] * 50), "ok"),
        (train_of([1500.0] * 50, late=2e-5), "warning"),
        (train_of([1500.0] * 50, late=1e-4), "FAIL"),
        (train_of([1500.0, 1600.0] * 25), "FAIL"),
        (train_of([1500.0] * 50, skip=20), "FAIL"),
    ],
    ids=["good", "jitter", "much jitter", "wrong widths", "a missing pulse"],
)
def test_pulses_are_judged_by_widths_and_periods(edges: list[Edge], level: str) -> None:
    assert pulses.judge(pulses.summarise(pulses.find_pulses(edges), [1500.0])).level == level


def test_half_a_pulse_at_either_end_is_left_out() -> None:
    edges = [Edge(0.001, 0), *train_of([0.0, 1500.0])[2:], Edge(0.04, 1)]
    assert [round(pulse.width) for pulse in pulses.find_pulses(edges)] == [1500]


@pytest.mark.parametrize(
    ("widths", "now", "expected", "level"),
    [
        ([1750.0] * 20 + [1500.0] * 25, 3.0, Ending(0.2, 0.6815), "ok"),
        ([1750.0] * 60 + [1500.0] * 25, 3.0, Ending(1.0, 1.4815), "FAIL"),
        ([1750.0] * 60, 1.2, Ending(None, None), "FAIL"),
        ([1750.0] * 60, 3.0, Ending(None, 0.98175), "FAIL"),
    ],
    ids=["as promised", "late", "they go on", "not at neutral"],
)
def test_the_end_of_the_pulses_is_compared_with_the_promise(
    widths: list[float], now: float, expected: Ending, level: str
) -> None:
    ending = pulses.find_ending(pulses.find_pulses(train_of(widths)), 1500.0, 0.2, now)
    assert ending.neutral == pytest.approx(expected.neutral)
    assert ending.off == pytest.approx(expected.off)
    assert pulses.judge_ending(ending, 0.2, "SIGKILL").level == level


def test_the_histogram_of_cyclictest_is_read() -> None:
    output = "# Histogram\n000003 2\n000050 000001\n# Max Latencies: 00051\n"
    assert cyclictest.parse(output + "# Histogram Overflows: 00001\n")[1] == 51.0
    assert len(cyclictest.parse(output + "# Histogram Overflows: 00001\n")[0]) == 4
