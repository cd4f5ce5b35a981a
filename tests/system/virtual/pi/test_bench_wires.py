"""Wires of `fishctl doctor --bench` on the virtual Pi: a loop to a pin, and a filter to the ADC."""

import math
from collections.abc import Iterator

import pigpio
import pytest
from rigs.pigpiod_client import GPIO, Bench, eventually, pigpiod_bench

from fishd.virtual.pi.pigpiod.commands import JITTER_S
from fishd.virtual.pi.pulse_train import PulseTrain
from fishd.virtual.pi.rc_filter import SUPPLY_V, RcFilter

LOOP = 23


@pytest.fixture
def bench() -> Iterator[Bench]:
    with pigpiod_bench() as bench:
        yield bench


def edges_of_frames(bench: Bench, frames: int) -> list[tuple[int, int, int]]:
    """Return GPIO, level and tick of the edges that the true client reports for some frames."""
    bench.daemon.connect(LOOP, GPIO)
    edges: list[tuple[int, int, int]] = []
    callback = bench.pi.callback(
        LOOP, pigpio.EITHER_EDGE, lambda gpio, level, tick: edges.append((gpio, level, tick))
    )
    bench.pi.set_servo_pulsewidth(GPIO, 1500)
    bench.sleep(0.02 * frames)
    bench.pi.read(LOOP)
    assert eventually(lambda: len(edges) >= 2 * frames)
    callback.cancel()
    return edges


def test_the_true_client_gets_the_edges_of_a_looped_pin(bench: Bench) -> None:
    edges = edges_of_frames(bench, 50)
    assert [edge[:2] for edge in edges] == [(LOOP, 1), (LOOP, 0)] * 50
    rises, falls = edges[::2], edges[1::2]
    widths = {fall[2] - rise[2] for rise, fall in zip(rises, falls, strict=True)}
    assert widths <= {1499, 1500, 1501}
    assert rises[-1][2] - rises[0][2] == pytest.approx(49 * 20_000, abs=1)


def test_jitter_is_a_fault(bench: Bench) -> None:
    bench.faults.inject("pulse-jitter")
    edges = edges_of_frames(bench, 50)
    late = [tick % 20_000 for _, level, tick in edges if level]
    assert 0.5 * JITTER_S < max(late) * 1e-6 <= JITTER_S
    assert len(set(late)) > 25


def test_a_looped_pin_has_the_level_of_its_source_only_as_an_input(bench: Bench) -> None:
    bench.daemon.connect(LOOP, GPIO)
    bench.pi.write(GPIO, 1)
    assert bench.pi.read(LOOP) == 1
    bench.pi.set_mode(LOOP, pigpio.OUTPUT)
    assert bench.pi.read(LOOP) == 0


@pytest.mark.parametrize("tau", [0.0, 0.01, 0.1])
def test_a_filter_settles_at_the_mean_level_of_the_pin(tau: float) -> None:
    train = PulseTrain()
    train.set(0.0, 1500.0)
    filtered = RcFilter(train.edges, tau)
    start = max(0.1, round(15 * tau / 0.02) * 0.02)
    volts = [filtered.mean(start + t * 1e-3, start + (t + 1) * 1e-3) for t in range(20)]
    assert sum(volts) / 20 == pytest.approx(SUPPLY_V * 1500 / 20_000, rel=1e-5)
    ripple = max(volts) - min(volts)
    assert ripple == pytest.approx(SUPPLY_V if tau == 0.0 else ripple)
    if tau == 0.1:
        assert ripple < 0.05


def test_a_filter_rises_exponentially_at_a_constant_level() -> None:
    train = PulseTrain()
    train.set(0.0, 20_000.0)
    filtered = RcFilter(train.edges, 0.1)
    filtered.mean(0.0, 0.1)
    share = filtered.mean(0.1, 0.1 + 1e-6) / SUPPLY_V
    assert share == pytest.approx(1 - math.exp(-1), abs=1e-4)
