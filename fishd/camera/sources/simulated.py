"""A simulated camera above the fish of a running fishd: draws its tail from telemetry.

fishd publishes a tick at its end, but the command of that tick holds until the next one. So the
motion until then is known: a model of the same fish swims one tick ahead from the true state.
"""

import math
import time
from collections import deque
from collections.abc import Callable
from typing import Any, NamedTuple

import msgspec
import zmq
from msgspec import UNSET, Struct, UnsetType

from fishd.camera.clock_offset import ClockOffset, clock_of
from fishd.camera.settings import SimulatedSettings
from fishd.camera.simulated.camera import SimulatedCamera, Tail
from fishd.camera.sources.base import Shot, Sink, Timeline, Trouble
from fishd.client import Fish
from fishd.client.connection import SECOND_LOOK
from fishd.client.zmq_sockets import subscriber
from fishd.core.addresses import find_control
from fishd.core.camera_frames import EQUAL
from fishd.core.decoding import decoder
from fishd.core.errors import FishError
from fishd.core.schema import Problem, convert
from fishd.core.signals import Status
from fishd.virtual.plant.base import PlantState
from fishd.virtual.plant.parameters import TETHERED, PlantParameters
from fishd.virtual.plant.tethered import TetheredFish

AGAIN = 0.3
"""Time between two looks for a fishd [s]."""
SILENCE = 1.0
"""After so long without a tick, fishd is asked whether it is there [s]."""
ANSWER = 1.0
"""How long fishd may take for an answer [s]."""


class TickTruth(Struct, frozen=True, gc=False):
    """What is needed of a tick."""

    seq: int
    phi_c: float
    servo_on: bool
    time: float = math.nan
    alpha: float | UnsetType = UNSET
    alpha_rate: float = 0.0
    phi: float = 0.0


class Swimmer(NamedTuple):
    """What fishd says of the fish that it simulates."""

    tick: float
    """Period of its loop [s]."""
    plant: PlantParameters
    sample_rate: float
    """Force samples per second, which decide the steps of the integration."""
    lockstep: bool


class Foresight:
    """The course of the tail from each tick to the next."""

    def __init__(self, swimmer: Swimmer) -> None:
        self._swimmer = swimmer
        self._fish = TetheredFish(swimmer.plant)
        self._latest: TickTruth | None = None
        self._end = Tail(0.0, 0.0, 0.0)

    def follow(self, tick: TickTruth) -> list[tuple[Tail, Tail]]:
        """The parts of the course that a tick makes known, one after the other."""
        assert isinstance(tick.alpha, float)
        period, latest = self._swimmer.tick, self._latest
        command = tick.phi_c if tick.servo_on else None
        now = Tail(tick.time, tick.alpha, tick.alpha_rate)
        parts = []
        if latest is None or tick.seq != latest.seq + 1:
            self._fish = TetheredFish(self._swimmer.plant, PlantState(phi=tick.phi))
            if self._swimmer.plant.servo_delay:  # what is under way to the servo is not known
                self._swim(command, self._swimmer.plant.servo_delay + period)
        elif tick.time > self._end.time + EQUAL:  # after slots that fishd has skipped
            self._swim(latest.phi_c if latest.servo_on else None, tick.time - self._end.time)
            parts.append((self._end, now))
        self._fish.state = PlantState(tick.phi, tick.alpha, tick.alpha_rate)
        end = tick.time + period
        if self._swimmer.lockstep:  # as fishd's own clock counts
            end = (round(tick.time / period) + 1) * period
        self._swim(command, end - tick.time)
        state = self._fish.state
        self._latest, self._end = tick, Tail(end, state.alpha, state.alpha_rate)
        return [*parts, (now, self._end)]

    @property
    def end(self) -> float:
        """Until when the course is known [s]."""
        return self._end.time

    def _swim(self, command: float | None, duration: float) -> None:
        duration = round(duration, 9)
        samples = max(1, round(self._swimmer.sample_rate * duration))
        self._fish.advance(command, duration, samples)


class SimulatedSource:
    """Follows a fishd, through any restart of it."""

    def __init__(self, settings: SimulatedSettings, size: int) -> None:
        """size: height and width of a picture [px]"""
        self._settings = settings
        self._size = size
        self._decode: Callable[[bytes], TickTruth] = decoder(TickTruth)
        where = settings.fishd or find_control()
        self.device = f"a simulated camera above the fish at {where}"

    def run(self, sink: Sink, stopping: Callable[[float], bool]) -> None:
        """Draw until told to stop."""
        while not stopping(0.0):
            try:
                with Fish(self._settings.fishd, timeout=ANSWER) as fish:
                    self._follow(fish, sink, stopping)
            except FishError as error:
                sink.trouble(Trouble("waiting", str(error)))
            except Trouble as trouble:
                sink.trouble(trouble)
            stopping(AGAIN)
            sink.alive()

    def _follow(self, fish: Fish, sink: Sink, stopping: Callable[[float], bool]) -> None:
        """Draw what one fishd does, until it is gone or another one."""
        status = fish.status()
        swimmer = _swimmer(fish.config())
        view = _View(self._settings, self._size, swimmer, sink)
        context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        try:
            socket = subscriber(context, status.telemetry, b"tick")
            offset = ClockOffset(clock_of(fish))
            view.ahead = offset.update().seconds
            heard, latest = time.monotonic(), 0
            while not stopping(0.0):
                sink.alive()
                if socket.poll(view.patience()):
                    topic, payload = (*socket.recv_multipart(), b"")[:2]
                    tick = self._decoded(payload) if topic == b"tick" else None
                    if tick is not None:
                        if tick.seq <= latest:
                            return  # of a fishd that was started again
                        heard, latest = time.monotonic(), tick.seq
                        view.follow(tick, status)
                view.publish()
                if time.monotonic() - heard > SILENCE:
                    heard = time.monotonic()
                    if fish.status().pid != status.pid:
                        return
                    if not socket.poll(SECOND_LOOK):  # else this process itself was held up
                        view.idle()
                view.ahead = offset.update().seconds
        finally:
            context.destroy(linger=0)

    def _decoded(self, payload: bytes) -> TickTruth | None:
        try:
            return self._decode(payload)
        except msgspec.DecodeError:
            return None


class _View:
    """What a camera sees of one fishd, each frame at its time."""

    def __init__(
        self, settings: SimulatedSettings, size: int, swimmer: Swimmer, sink: Sink
    ) -> None:
        self._settings = settings
        self._camera = SimulatedCamera(settings, size)
        self._foresight = Foresight(swimmer)
        self._swimmer = swimmer
        self._sink = sink
        self._due: deque[Shot] = deque()
        self._latest = 0
        self.ahead = 0.0
        """Of fishd's clock over that of this machine [s]."""

    def follow(self, tick: TickTruth, status: Status) -> None:
        """Take the frames until the next tick; raises `Trouble` where there is no simulated fish.

        status: of the fishd that has ticked
        """
        if status.robot == "swimmer" or not isinstance(tick.alpha, float):
            raise _blind(status.robot)
        if math.isnan(tick.time):
            raise Trouble(
                "unusable",
                f"fishd {status.version} does not tell the times of its ticks: it is older than "
                "this camera",
                "let both be of the same version",
            )
        if not self._latest:
            self._begin(status)
        elif tick.seq > self._latest + 1:
            self._sink.lost(dropped=self._frames_in(tick.seq - self._latest - 1))
        self._latest = tick.seq
        for before, after in self._foresight.follow(tick):
            for frame in self._camera.frames(before, after):
                self._due.append(Shot(*frame, self._settings.exposure))
        if self._swimmer.lockstep:
            while self._due:
                self._sink.put(self._due.popleft())
            self._sink.covered(self._foresight.end)

    def publish(self) -> None:
        """Hand over the frames that are due."""
        while self._due and self._due[0].available <= (now := self._now()):
            self._sink.put(self._due.popleft()._replace(available=now))

    def patience(self) -> int:
        """How long to wait for the next tick [ms]."""
        if not self._due:
            return 200
        left = self._due[0].available - self._now()
        if left < 1e-3:
            time.sleep(max(0.0, left))
            return 0
        return min(200, int(left * 1e3))

    def idle(self) -> None:
        """Tell that fishd answers, but does not tick."""
        why = "as in lockstep while it waits for its agent" if self._swimmer.lockstep else "so far"
        self._sink.trouble(Trouble("waiting", f"fishd answers, but does not tick, {why}"))

    def _begin(self, status: Status) -> None:
        if self._swimmer.lockstep:
            self._sink.begin(Timeline(True, status.boot, None))
        else:
            self._sink.begin(Timeline(False, status.boot, self._now))

    def _now(self) -> float:
        return time.monotonic() + self.ahead

    def _frames_in(self, ticks: int) -> int:
        rate = self._settings.rate
        return ticks if rate is None else round(ticks * self._swimmer.tick * rate)


def _swimmer(config: dict[str, Any]) -> Swimmer:
    """Raises `Trouble` where the configuration is of another version."""
    try:
        plant = dict(config["plant"])
        if plant.get("model", TETHERED) != TETHERED:
            # It has keys of its own. Until the next tick it goes on as the tethered fish would.
            plant = {name: plant[name] for name in PlantParameters.__struct_fields__}
        return Swimmer(
            tick=float(config["tick"]),
            plant=convert(plant, PlantParameters),
            sample_rate=float(config["simulation"]["sample_rate"]),
            lockstep=bool(config["lockstep"]),
        )
    except (Problem, KeyError, TypeError, ValueError) as error:
        raise Trouble(
            "unusable",
            f"this fishd describes its fish in another way: {error}",
            "let fishd and fishd-camera be of the same version",
        ) from None


def _blind(robot: str) -> Trouble:
    """Why nothing can be drawn."""
    why = {
        "virtual-pi": "a virtual Pi does not tell where the tail is",
        "swimmer": "a swimmer swims out of its sight",
    }.get(robot)
    if why:
        return Trouble("unusable", why, "let fishd drive robot: simulated")
    return Trouble("unusable", "this fishd drives a real fish", "use source: v4l2")
