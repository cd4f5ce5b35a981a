"""Offset between two clocks, as accurate as the shortest round trip."""

import random

import pytest

from fishd.camera.clock_offset import (
    MIN_UPDATE_TIMEOUT_S,
    NO_OFFSET,
    RETRY_PERIOD_S,
    UPDATE_PERIOD_S,
    ClockOffset,
    Reading,
)
from fishd.core.clock import read_boot_id
from fishd.core.errors import NoDaemon

AHEAD = 1234.5


class Network:
    """Network between two machines with random travel times."""

    def __init__(self, seed: int = 0, shortest: float = 1e-3, longest: float = 0.05) -> None:
        self.now = 100.0
        self.asked = 0
        self.down = False
        self._random = random.Random(seed)
        self._range = shortest, longest
        self.rate = 1.0
        self.ahead, self.boot = AHEAD, "another machine"
        self.patience: float | None = None

    def ask(self, patience: float | None = None) -> Reading:
        self.asked += 1
        self.patience = patience
        self.now += self._random.uniform(*self._range)
        if self.down:
            raise NoDaemon("no answer")
        reading = Reading(self.ahead + self.rate * self.now, self.boot)
        self.now += self._random.uniform(*self._range)
        return reading


@pytest.mark.parametrize("seed", range(2))
def test_an_offset_is_known_as_well_as_it_says(seed: int) -> None:
    network = Network(seed)
    offset = ClockOffset(network.ask, lambda: network.now).update()
    assert abs(offset.seconds - AHEAD) <= offset.uncertainty <= 0.05


def test_on_one_machine_it_is_exactly_zero_and_asked_once() -> None:
    asked = []

    def ask(_: float | None) -> Reading:
        asked.append(1)
        return Reading(123.0, read_boot_id())

    clock = ClockOffset(ask)
    assert [clock.update() for _ in range(3)] == [NO_OFFSET] * 3
    assert len(asked) == 1


def test_clocks_that_run_apart_are_followed() -> None:
    network = Network()
    clock = ClockOffset(network.ask, lambda: network.now)
    network.rate = 1.0 + 5e-5
    for _ in range(1000):
        network.now += 2.0
        offset = clock.update()
    true = AHEAD + (network.rate - 1.0) * network.now
    assert abs(offset.seconds - true) <= offset.uncertainty < 0.06


def test_it_is_asked_seldom_and_an_answer_that_fails_keeps_the_latest() -> None:
    network = Network()
    clock = ClockOffset(network.ask, lambda: network.now)
    before = clock.update()
    asked = network.asked
    clock.update()
    assert network.asked == asked
    network.down = True
    network.now += UPDATE_PERIOD_S + 1.0
    assert clock.update().seconds == before.seconds
    assert network.asked == asked + 1


@pytest.mark.parametrize("boot", ["its next start", ""])
def test_another_start_of_their_machine_begins_anew(boot: str) -> None:
    network = Network()
    clock = ClockOffset(network.ask, lambda: network.now)
    clock.update()
    network.ahead, network.boot = -50.0, boot
    network.now += UPDATE_PERIOD_S + 1.0
    offset = clock.update()
    assert abs(offset.seconds + 50.0) <= offset.uncertainty <= 0.05


@pytest.mark.parametrize(
    ("shortest", "longest", "timeout"),
    [(1e-3, 2e-3, MIN_UPDATE_TIMEOUT_S), (0.1, 0.11, pytest.approx(0.8, rel=0.1))],
)
def test_after_the_first_answer_a_network_is_given_the_time_that_it_takes(
    shortest: float, longest: float, timeout: float
) -> None:
    network = Network(shortest=shortest, longest=longest)
    clock = ClockOffset(network.ask, lambda: network.now)
    clock.update()
    network.now += UPDATE_PERIOD_S + 1.0
    clock.update()
    assert network.patience == timeout


def test_beginning_anew_is_tried_in_pauses() -> None:
    network = Network()
    clock = ClockOffset(network.ask, lambda: network.now)
    clock.update()
    clock.forget()
    network.down = True
    asked = network.asked
    for _ in range(10):
        with pytest.raises(NoDaemon):
            clock.update()
    assert network.asked == asked + 1
    network.down = False
    network.now += RETRY_PERIOD_S + 0.1
    offset = clock.update()
    assert abs(offset.seconds - AHEAD) <= offset.uncertainty
