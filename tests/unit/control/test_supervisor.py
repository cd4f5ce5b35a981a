"""The supervisor: the changes of mode, and the latched reason."""

from itertools import pairwise

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from fishd.control.faults import FAULTS
from fishd.control.supervisor import Mode, Supervisor
from fishd.core.errors import Refused
from fishd.core.signals import Reason

COUNTED = [code for code, row in FAULTS.items() if row.in_a_row == 3]
counted = st.sampled_from(COUNTED)
codes = st.sampled_from([code for code, row in FAULTS.items() if not row.releases])


class Transitions(RuleBasedStateMachine):
    """A state machine: in any order of requests, a latched fish moves only after a clear."""

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
        self.supervisor.fail(code, "it broke")
        if self.latched is None:
            assert self.supervisor.reason.code == code
        self.latched = self.supervisor.reason

    @rule()
    def estop(self) -> None:
        self.supervisor.estop("the button was pressed")
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
    @rule(code=counted, bad=st.integers(0, 2))
    def a_few_failed_checks_are_no_fault(self, code: str, bad: int) -> None:
        for problem in (None, *["it failed"] * bad, None):
            self.supervisor.check(code, problem)

    @invariant()
    def latched_modes_have_a_reason_and_keep_it(self) -> None:
        assert (self.supervisor.mode in (Mode.FAULT, Mode.ESTOP)) is (self.latched is not None)
        assert self.supervisor.reason == self.latched


TestTransitions = Transitions.TestCase
TestTransitions.settings = settings(max_examples=30)


@pytest.mark.parametrize("code", COUNTED)
def test_three_failed_checks_in_a_row_are_a_fault(code: str) -> None:
    supervisor = Supervisor()
    latched = []
    for problem in ["odd", "odd", None, "odd", "odd", "odd", "odd"]:
        supervisor.check(code, problem)
        latched.append(supervisor.reason is not None)
    assert latched == [False] * 5 + [True] * 2
    assert supervisor.reason.code == code
    assert supervisor.reason.message == "odd, 3 times in a row"


def test_clearing_resets_all_counts() -> None:
    supervisor = Supervisor()
    for code in [*COUNTED] * 3:
        supervisor.check(code, "odd")
    supervisor.clear()
    for code in [*COUNTED] * 2:
        supervisor.check(code, "odd")
    assert supervisor.mode is Mode.IDLE


def test_up_to_twenty_overruns_in_a_hundred_ticks_are_tolerated_more_are_a_fault() -> None:
    supervisor = Supervisor()
    for seq in range(0, 1000, 5):
        supervisor.note_overrun(seq)
    assert supervisor.reason is None
    supervisor.note_overrun(1000)
    supervisor.note_overrun(1001)
    assert supervisor.reason.code == "overrun"


def test_every_change_of_mode_is_reported_once_with_the_mode_before() -> None:
    changes: list[tuple[Mode, Mode]] = []
    supervisor = Supervisor(lambda before: changes.append((before, supervisor.mode)))
    for request in (
        supervisor.start,
        supervisor.start,
        supervisor.stop,
        supervisor.stop,
        lambda: supervisor.fail("servo-link", "gone"),
        lambda: supervisor.fail("overrun", "late"),
        lambda: supervisor.estop("leak"),
        lambda: supervisor.estop("leak"),
        supervisor.clear,
        supervisor.clear,
    ):
        request()
    modes = [Mode.IDLE, Mode.RUNNING, Mode.IDLE, Mode.FAULT, Mode.ESTOP, Mode.IDLE]
    assert changes == [*pairwise(modes)]
