"""The lease of the experiment that drives the fish; it ends unless it is renewed.

The loop asks once a tick whether it has run out; requests take it, renew it and end it.
"""

import os
from collections.abc import Callable

from fishd.core.errors import Refused
from fishd.core.signals import LeaseHolder, Reason

MAX_STEP = 0.25
"""Longest time between two looks at the clock that counts [s].

A fishd that stood still, by SIGSTOP say, could hear no renewal meanwhile.
"""
KEPT = 16
"""Number of leases that are remembered after their end, to tell their holders why they ended."""
RETURNED = "it was given back"


class Lease:
    """At most one experiment holds it; requests by hand need none, and end it."""

    def __init__(self, now: Callable[[], float]) -> None:
        """now: the clock by which holders live and die [s]"""
        self.active = False
        """True while an experiment holds the fish."""
        self.drives = False
        """Whether what is active was set by its holder: that ends with the lease."""
        self.expired: Reason | None = None
        """Why the fish rests, where the latest lease ran out and nothing has come since."""
        self._now = now
        self._token = ""
        self._name = self._host = ""
        self._pid = 0
        self._seconds = self._left = 0.0
        self._taken = self._seen = 0.0
        self._dormant = False
        """Whether it ran out while the fish was at rest: then its holder may go on with it."""
        self._ends: dict[str, str] = {}
        """Why each of the latest leases ended, by its token."""

    @property
    def holder(self) -> LeaseHolder | None:
        """The experiment that holds the fish."""
        if not self.active:
            return None
        return LeaseHolder(self._name, self._host, self._pid, self._now() - self._taken)

    def check_free(self, token: str | None = None) -> None:
        """Raise `Refused` while an experiment holds the fish with a lease other than `token`."""
        holder = self.holder
        if holder and token != self._token:
            raise Refused("leased", holder.refusal())

    def take(self, name: str, host: str, pid: int, seconds: float) -> str:
        """Begin a lease, and return its token. seconds: that it lasts without a renewal"""
        self.active, self._dormant, self.expired = True, False, None
        self.drives = False
        self._token = os.urandom(8).hex()  # another one than that of a daemon before this one
        self._name, self._host, self._pid, self._seconds = name, host, pid, seconds
        self._taken = self._now()
        self._fill()
        return self._token

    def renew(self, token: str) -> None:
        """Let the lease last for its full time again; raise `Refused` where it has ended.

        One that ran out while the fish was at rest goes on, if no other client has had the fish
        since.
        """
        if token != self._token or not (self.active or self._dormant):
            why = self._ends.get(token, "fishd was restarted, or it is long ago")
            raise Refused("no-lease", f"this program no longer holds the fish: {why}")
        self.active, self._dormant, self.expired = True, False, None
        self._fill()

    def end(self, why: str) -> LeaseHolder | None:
        """End the lease, if there is one, and return its holder."""
        former = self.holder
        if self.active or self._dormant:
            self._remember(why)
        self.active, self._dormant, self.expired = False, False, None
        return former

    def why_ended(self, token: str) -> str | None:
        """Return why a lease has ended; None while it lasts."""
        if self.active and token == self._token:
            return None
        return self._ends.get(token, "it ran out")

    def forget(self, token: str) -> None:
        """Let the holder of a lease that ran out not go on with it."""
        if token == self._token:
            self._dormant = False

    def run_out(self, moving: bool) -> LeaseHolder | None:
        """End the lease, which is active, where its time is up, and return its holder then.

        moving: whether a controller is active
        """
        now = self._now()
        self._left -= min(now - self._seen, MAX_STEP)
        self._seen = now
        if self._left > 0.0:
            return None
        former = self.holder
        self.expired = Reason(
            "lease-expired",
            f"{former} has not renewed its lease of the fish for {self._seconds:g} s",
            "look after the program, or the link to it, then start it again",
        )
        self._remember(f"it was not renewed for {self._seconds:g} s")
        self.active, self._dormant = False, not moving
        return former

    def _fill(self) -> None:
        self._left, self._seen = self._seconds, self._now()

    def _remember(self, why: str) -> None:
        self._ends[self._token] = why
        if len(self._ends) > KEPT:
            del self._ends[next(iter(self._ends))]
