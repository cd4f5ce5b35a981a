"""The lease of the experiment that drives the fish; it expires unless it is renewed.

The loop checks once a tick whether it has expired; requests take it, renew it and end it.
"""

import os
from collections.abc import Callable

from fishd.core.errors import Refused
from fishd.core.signals import LeaseHolder, Reason

MAX_STEP_S = 0.25
"""Longest time between two checks that counts against a lease [s].

A fishd that was suspended, by SIGSTOP for example, could receive no renewal meanwhile.
"""
MAX_REMEMBERED_LEASES = 16
"""Number of ended leases whose reason is kept, so that a late renewal is answered with it."""
RETURN_REASON = "it was given back"


class Lease:
    """The lease, held by at most one experiment; a manual request needs no lease, and ends it."""

    def __init__(self, now: Callable[[], float]) -> None:
        """now: the clock that measures the lease [s, monotonic]"""
        self.active = False
        """Whether an experiment holds the fish."""
        self.drives = False
        """Whether the holder set the active controller, which then stops with the lease."""
        self.expired: Reason | None = None
        """Reason why the fish rests, if the latest lease expired and no request came since."""
        self._now = now
        self._token = ""
        self._name = self._host = ""
        self._pid = 0
        self._seconds = self._time_left = 0.0
        self._taken = self._checked = 0.0
        self._dormant = False
        """Whether the lease expired while the fish was at rest; its holder may still renew it."""
        self._end_reasons: dict[str, str] = {}
        """Reason by token of each of the latest leases that ended."""

    @property
    def holder(self) -> LeaseHolder | None:
        """The experiment that holds the fish; None without a lease."""
        if not self.active:
            return None
        return LeaseHolder(self._name, self._host, self._pid, self._now() - self._taken)

    def check_free(self, token: str | None = None) -> None:
        """Raise `Refused` while an experiment holds the fish with a lease other than `token`."""
        holder = self.holder
        if holder and token != self._token:
            raise Refused("leased", holder.refusal())

    def take(self, name: str, host: str, pid: int, seconds: float) -> str:
        """Begin a lease, and return its token; seconds: time without renewal until it expires."""
        self.active, self._dormant, self.expired = True, False, None
        self.drives = False
        self._token = os.urandom(8).hex()  # differs from tokens of an earlier daemon
        self._name, self._host, self._pid, self._seconds = name, host, pid, seconds
        self._taken = self._now()
        self._restart_time()
        return self._token

    def renew(self, token: str) -> None:
        """Restart the time of the lease; raise `Refused` where the lease has ended.

        A lease that expired while the fish was at rest is renewed too, if no other client has
        controlled the fish since.
        """
        if token != self._token or not (self.active or self._dormant):
            why = self._end_reasons.get(token, "fishd was restarted, or it is long ago")
            raise Refused("no-lease", f"this program no longer holds the fish: {why}")
        self.active, self._dormant, self.expired = True, False, None
        self._restart_time()

    def end(self, why: str) -> LeaseHolder | None:
        """End the lease, if there is one, and return its holder."""
        former = self.holder
        if self.active or self._dormant:
            self._remember(why)
        self.active, self._dormant, self.expired = False, False, None
        return former

    def why_ended(self, token: str) -> str | None:
        """Return why a lease has ended; None while it is active."""
        if self.active and token == self._token:
            return None
        return self._end_reasons.get(token, "it ran out")

    def forget(self, token: str) -> None:
        """Prevent the holder of an expired lease from renewing it."""
        if token == self._token:
            self._dormant = False

    def end_if_expired(self, moving: bool) -> LeaseHolder | None:
        """End the active lease if its time is up, and return its holder; else return None.

        moving: whether a controller is active
        """
        now = self._now()
        self._time_left -= min(now - self._checked, MAX_STEP_S)
        self._checked = now
        if self._time_left > 0.0:
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

    def _restart_time(self) -> None:
        self._time_left, self._checked = self._seconds, self._now()

    def _remember(self, why: str) -> None:
        self._end_reasons[self._token] = why
        if len(self._end_reasons) > MAX_REMEMBERED_LEASES:
            del self._end_reasons[next(iter(self._end_reasons))]
