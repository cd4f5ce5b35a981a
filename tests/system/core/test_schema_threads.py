"""Types that several threads validate for the first time at once."""

import subprocess
import sys

MANY_AT_ONCE = """
import sys, threading
from msgspec import Struct, defstruct
from fishd.core.schema import convert

sys.setswitchinterval(1e-5)
for number in range(400):
    inner = [defstruct(f"Inner{i}", [(f"x{j}", float) for j in range(20)]) for i in range(5)]
    outer = defstruct("Outer", [(f"part{i}", kind) for i, kind in enumerate(inner)])
    data = {f"part{i}": {f"x{j}": 1.0 for j in range(20)} for i in range(5)}
    start = threading.Barrier(4)

    def work():
        start.wait(20)
        convert(data, outer)

    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(20)
"""


def test_threads_that_see_a_type_for_the_first_time_together_crash_nothing() -> None:
    command = [sys.executable, "-c", MANY_AT_ONCE]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stderr) == (0, "")
