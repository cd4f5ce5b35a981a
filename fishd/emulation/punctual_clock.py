"""The machine's clock for modelled times: its sleeps are right on average, even very short ones."""

import time

_LONGEST_LATENESS = 2e-4
_MEMORY = 0.05


class PunctualClock:
    """Wakes up early by as much as the machine lately woke it up late, tens of microseconds."""

    monotonic = staticmethod(time.monotonic)
    wall = staticmethod(time.time)

    def __init__(self) -> None:
        self._lateness = 0.0

    def sleep(self, seconds: float) -> None:
        """Let time pass."""
        asked = max(0.0, seconds - self._lateness)
        begun = time.monotonic()
        time.sleep(asked)
        late = min(time.monotonic() - begun - asked, _LONGEST_LATENESS)
        self._lateness += _MEMORY * (late - self._lateness)
