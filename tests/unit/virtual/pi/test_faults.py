"""Faults of the virtual Pi: named, timed, repeatable."""

from collections.abc import Callable
from functools import partial

import pytest

from fishd.core.clock import VirtualClock
from fishd.virtual.pi.faults import INSTANTANEOUS, TRANSFER_ERRORS, Faults


@pytest.fixture
def clock() -> VirtualClock:
    return VirtualClock()


@pytest.fixture
def faults(clock: VirtualClock) -> Faults:
    return Faults(clock)


def test_a_fault_lasts_till_its_end_or_for_its_time(faults: Faults, clock: VirtualClock) -> None:
    assert faults.listing() == {}
    faults.inject("stuck-busy")
    faults.inject("nack", 0.5)
    clock.sleep(0.4)
    assert faults.transfer_error() == "nack"
    clock.sleep(0.2)
    assert faults.transfer_error() is None
    clock.sleep(1e6)
    assert faults.active("stuck-busy")
    faults.clear("stuck-busy")
    assert not faults.active("stuck-busy")


def test_clearing_all_ends_random_errors_too(faults: Faults) -> None:
    faults.inject("clipped")
    faults.error_rate = 1.0
    faults.clear()
    assert faults.listing() == {}
    assert faults.transfer_error() is None


@pytest.mark.parametrize("call", [Faults.inject, Faults.clear])
def test_the_nearest_name_is_offered(faults: Faults, call: Callable[[Faults, str], None]) -> None:
    with pytest.raises(ValueError, match="no fault is called 'brownout'; did you mean 'brown-out'"):
        call(faults, "brownout")


def test_a_fault_that_happens_at_once_tells_its_listeners_and_is_over(faults: Faults) -> None:
    for name in INSTANTANEOUS:
        heard: list[str] = []
        faults.listen(name, partial(heard.append, name))
        faults.inject(name)
        assert heard == [name]
        assert not faults.active(name)
        with pytest.raises(ValueError, match="takes no seconds"):
            faults.inject(name, 1.0)


def test_random_errors_have_the_share_asked_for_and_are_of_every_kind(faults: Faults) -> None:
    faults.error_rate = 0.1
    drawn = [faults.transfer_error() for _ in range(10_000)]
    errors = [name for name in drawn if name]
    assert 900 < len(errors) < 1100
    assert set(errors) == set(TRANSFER_ERRORS)


def test_the_same_seed_gives_the_same_errors(clock: VirtualClock) -> None:
    def draw(seed: int) -> list[str | None]:
        faults = Faults(clock, seed)
        faults.error_rate = 0.2
        return [faults.transfer_error() for _ in range(200)]

    assert draw(3) == draw(3)
    assert draw(3) != draw(4)
