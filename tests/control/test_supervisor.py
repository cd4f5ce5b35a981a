"""The supervisor: which mode follows which, and that a reason once latched stays."""

import pytest
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from fishd.errors import Refused
from fishd.signals import Reason
from fishd.supervisor import Mode, Supervisor

codes = st.sampled_from(["sensor-stale", "servo-link", "controller-error"])


class Transitions(RuleBasedStateMachine):
    """Whatever is done in whatever order, a latched fish moves only after an explicit clear."""

    def __init__(self) -> None:
        super().__init__()
        self.supervisor = Supervisor()
        self.latched: Reason | None = None

    @rule()
    def start(self) -> None:
        if self.latched:
            with pytest.raises(Refused, match="clear-fault"):
                self.supervisor.start()
        else:
            self.supervisor.start()
            assert self.supervisor.mode is Mode.RUNNING

    @rule()
    def stop(self) -> None:
        self.supervisor.stop()
        assert self.supervisor.mode is not Mode.RUNNING

    @rule(code=codes)
    def fail(self, code: str) -> None:
        assert self.supervisor.fail(code, "it broke") is (self.latched is None)
        self.latched = self.supervisor.reason

    @rule()
    def estop(self) -> None:
        self.supervisor.estop("somebody pressed")
        assert self.supervisor.mode is Mode.ESTOP
        self.latched = self.supervisor.reason

    @rule()
    def clear(self) -> None:
        was_latched = self.latched is not None
        self.supervisor.clear()
        self.latched = None
        assert self.supervisor.reason is None
        assert not was_latched or self.supervisor.mode is Mode.IDLE

    @precondition(lambda self: self.latched is None)
    @rule(bad=st.integers(0, 2))
    def a_few_bad_reads_are_no_fault(self, bad: int) -> None:
        assert not self.supervisor.sensor(None)
        assert not any(self.supervisor.sensor("nothing came") for _ in range(bad))
        assert not self.supervisor.sensor(None)

    @invariant()
    def latched_modes_have_a_reason_and_keep_it(self) -> None:
        assert (self.supervisor.mode in (Mode.FAULT, Mode.ESTOP)) is (self.latched is not None)
        assert self.supervisor.reason == self.latched


TestTransitions = Transitions.TestCase


def test_three_bad_reads_in_a_row_are_a_fault() -> None:
    supervisor = Supervisor()
    assert [supervisor.sensor("silent") for _ in range(4)] == [False, False, True, False]
    assert supervisor.reason == Reason("sensor-stale", "silent, 3 times in a row")


def test_clearing_starts_all_counts_anew() -> None:
    supervisor = Supervisor()
    for _ in range(3):
        supervisor.sensor("silent")
        supervisor.suspect("clipped")
    supervisor.clear()
    assert not supervisor.sensor("silent")
    assert not supervisor.suspect("clipped")
    assert supervisor.mode is Mode.IDLE


def test_up_to_twenty_overruns_in_a_hundred_ticks_are_tolerated() -> None:
    supervisor = Supervisor()
    pattern = ([True] + [False] * 4) * 200
    assert not any(supervisor.overrun(overran) for overran in pattern)


def test_more_than_twenty_overruns_in_a_hundred_ticks_are_a_fault() -> None:
    supervisor = Supervisor()
    for _ in range(20):
        assert not supervisor.overrun(True)
    assert supervisor.overrun(True)
    assert supervisor.reason is not None
    assert supervisor.reason.code == "overrun"


def test_a_slow_update_now_and_then_is_tolerated_three_in_a_row_are_not() -> None:
    supervisor = Supervisor()
    times = [0.03, 0.03, 0.01, 0.03, 0.03, 0.03]
    assert [supervisor.update_time(t, 0.025, "slug") for t in times] == [False] * 5 + [True]
