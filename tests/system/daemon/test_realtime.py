import os
import subprocess
import sys

import pytest

from fishd.core.process import realtime

ENTER_THEN_LEAVE_AS_ANOTHER_USER = """
import os
from fishd.core.process import realtime

granted = realtime.enter(1, lock_memory=False)
os.setuid(65534)  # as in the service: a user without capabilities
realtime.drop_priority()
print(granted, os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK == os.SCHED_OTHER)
"""


@pytest.mark.slow
@pytest.mark.skipif(os.geteuid() != 0, reason="needs root, to be another user")
def test_a_user_without_privileges_can_give_the_real_time_priority_back() -> None:
    done = subprocess.run(
        [sys.executable, "-c", ENTER_THEN_LEAVE_AS_ANOTHER_USER],
        capture_output=True,
        text=True,
        check=True,
        timeout=60,
    )
    if done.stdout.startswith("False"):
        pytest.skip("no real-time priority is permitted here: run as root, or raise RLIMIT_RTPRIO")
    assert done.stdout.split() == ["True", "True"]


@pytest.mark.parametrize(
    ("priority", "permitted", "remedy"),
    [
        (50, 51, ""),
        (50, 50, "let LimitRTPRIO= of its service be 51, or set realtime.priority: 49"),
        (99, 99, "set realtime.priority: 98"),
    ],
)
def test_a_limit_that_leaves_nothing_above_the_loop_is_one_warning_with_the_right_one(
    priority: int,
    permitted: int,
    remedy: str,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    def schedule(thread: int, policy: int, parameters: os.sched_param) -> None:
        assert (thread, policy) == (7, os.SCHED_FIFO)
        if parameters.sched_priority > permitted:
            raise PermissionError(1, "Operation not permitted")
        granted.append(parameters.sched_priority)

    granted: list[int] = []
    monkeypatch.setattr(os, "sched_setscheduler", schedule)
    realtime.raise_priority(7, priority)
    lines = [record.getMessage() for record in caplog.records]
    if not remedy:
        assert (granted, lines) == ([51], [])
        return
    assert len(lines) == 1
    assert lines[0].startswith(f"realtime.priority: {priority} is the highest that is permitted: ")
    assert lines[0].endswith(f"; {remedy}")
