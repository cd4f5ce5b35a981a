"""fishd in virtual time behind the methods of a client, which a test can disturb."""

from collections.abc import Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any, cast

import msgspec

from fishd.config import Config
from fishd.core.errors import LeaseLost, ParameterError, Refused
from fishd.core.protocol import State
from fishd.core.signals import Event, Status, Tick
from fishd.lab.simulation import KeepingPublisher, VirtualRun


class VirtualStatus:
    """Fields of a status that a `LiveSession` uses."""

    def __init__(self, run: VirtualRun, pid: int) -> None:
        loop = run.loop
        self.pid, self.robot, self.tick = pid, "simulated", run.config.tick
        self.uptime = loop.seq * run.config.tick
        self.force_unit = "N"
        self.lease = None
        self.amplitude_limit = run.config.amplitude_limit
        self.mode, self.controller = loop.supervisor.mode.value, loop.active.name
        self.reason, self.fallback = loop.supervisor.reason, loop.active.fallback

    def shows_restart_since(self, earlier: "VirtualStatus") -> bool:
        return Status.shows_restart_since(cast(Status, self), cast(Status, earlier))


class VirtualDaemon:
    """Replacement of a `Fish` whose ticks run when they are read."""

    def __init__(self, config: Config | None = None) -> None:
        self.config_of_run = config or Config()
        self.lost: set[int] = set()
        """Numbers of ticks that are not delivered."""
        self.pid = 0
        self.restart()

    def restart(self) -> None:
        """Restart like a service manager."""
        self.pid += 1
        self._token = ""
        self._kept = KeepingPublisher()
        self.run = VirtualRun(self.config_of_run, self._kept)

    def status(self) -> VirtualStatus:
        return VirtualStatus(self.run, self.pid)

    def config(self) -> dict[str, Any]:
        return cast(dict[str, Any], msgspec.to_builtins(self.config_of_run))

    @contextmanager
    def lease(self, name: str, take: bool = False, **_: Any) -> Iterator[SimpleNamespace]:
        self._token = token = self.run.loop.lease.take(name, "", 0, 2.0)
        try:
            yield SimpleNamespace(token=token)
        finally:
            self._token = ""
            if self.run.loop.lease.end("it was given back"):
                self.stop()

    def renew_lease(self, lease: str) -> State:
        try:
            self.run.loop.lease.renew(lease)
        except Refused as error:
            raise LeaseLost(error.code, str(error)) from None
        return self._state()

    def set_by_hand(self, name: str) -> None:
        """Let a client without the lease set a controller."""
        self.run.set_controller(name, {})
        self.run.loop.lease.end(f"{name} was set by hand")

    def set_controller(self, name: str, /, **parameters: Any) -> State:
        if self._token:
            self.renew_lease(self._token)
        try:
            self.run.set_controller(name, parameters)
        except ParameterError as error:
            raise Refused("bad-parameter", str(error)) from None
        return self._state()

    def stop(self) -> State:
        self.run.loop.stop()
        return self._state()

    def ticks_and_events(self) -> Iterator[Tick | Event]:
        return iter(self.ticks())

    def ticks(self) -> Iterator[Tick]:
        while True:
            if self.run.loop.lease.active:
                self.renew_lease(self._token)
            self.run.tick()
            if self._kept.ticks[-1].seq not in self.lost:
                yield self._kept.ticks[-1]

    def _state(self) -> State:
        loop = self.run.loop
        mode = loop.supervisor.mode.value
        return State(loop.seq + 1, mode, None, loop.active.name, loop.active.parameters)
