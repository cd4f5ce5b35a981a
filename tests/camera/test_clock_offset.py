"""The offset between two clocks is as good as the shortest round trip."""

import random

import pytest

from fishd.camera.clock_offset import AGAIN, SAME, ClockOffset, Reading
from fishd.core.clock import boot_id
from fishd.core.errors import NoDaemon

AHEAD = 1234.5


class Network:
    """Two machines; there and back take random times."""

    def __init__(self, seed: int = 0, shortest: float = 1e-3, longest: float = 0.05) -> None:
        self.now = 100.0
        self.asked = 0
        self.down = False
        self._random = random.Random(seed)
        self._range = shortest, longest
        self.rate = 1.0

    def ask(self) -> Reading:
        self.asked += 1
        self.now += self._random.uniform(*self._range)
        if self.down:
            raise NoDaemon("no answer")
        reading = Reading(AHEAD + self.rate * self.now, "another machine")
        self.now += self._random.uniform(*self._range)
        return reading


@pytest.mark.parametrize("seed", range(5))
def test_an_offset_is_known_as_well_as_it_says(seed: int) -> None:
    network = Network(seed)
    offset = ClockOffset(network.ask, lambda: network.now).update()
    assert abs(offset.seconds - AHEAD) <= offset.uncertainty <= 0.05


def test_on_one_machine_it_is_exactly_zero_and_asked_once() -> None:
    asked = []

    def ask() -> Reading:
        asked.append(1)
        return Reading(123.0, boot_id())

    clock = ClockOffset(ask)
    assert [clock.update() for _ in range(3)] == [SAME] * 3
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
    network.now += AGAIN + 1.0
    assert clock.update().seconds == before.seconds
    assert network.asked == asked + 1


def test_a_first_answer_that_fails_is_told() -> None:
    network = Network()
    network.down = True
    with pytest.raises(NoDaemon):
        ClockOffset(network.ask, lambda: network.now).update()
