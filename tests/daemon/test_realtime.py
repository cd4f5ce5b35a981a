import os
import subprocess
import sys

import pytest

ENTER_THEN_LEAVE_AS_ANOTHER_USER = """
import os
from fishd.daemon import realtime

granted = realtime.enter(1, lock_memory=False)
os.setuid(65534)  # as in the service: a user without capabilities
realtime.leave()
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
        pytest.skip("no real-time priority is permitted here")
    assert done.stdout.split() == ["True", "True"]
