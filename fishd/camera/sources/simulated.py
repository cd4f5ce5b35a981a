"""Simulated camera above the fish of a running fishd, which draws the tail from telemetry.

fishd publishes a tick at its end, but the command of that tick is active until the next one. The
motion until then is therefore known: a model of the same fish is advanced by one tick from the true
state.
"""

import time
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import msgspec
import zmq
from msgspec import UNSET, Struct, UnsetType
from msgspec.structs import replace

from fishd.camera.clock_offset import ClockOffset, clock_reader
from fishd.camera.settings import SimulatedSettings
from fishd.camera.simulated import SimulatedCamera, Tail
from fishd.camera.sources.base import Shot, Sink, Timeline, Trouble
from fishd.client import Fish
from fishd.client.connection import LATE_ANSWER_WAIT_MS
from fishd.client.zmq_sockets import Subscription, connect_subscriber
from fishd.core.addresses import find_control_address
from fishd.core.camera_frames import TIME_TOLERANCE_S
from fishd.core.decoding import decoder
from fishd.core.errors import FishError
from fishd.core.robots import find_kind
from fishd.core.schema import Problem, convert
from fishd.core.signals import Status
from fishd.virtual.plant.base import PlantState
from fishd.virtual.plant.parameters import TETHERED, PlantParameters
from fishd.virtual.plant.tethered import TetheredFish

RETRY_PERIOD_S = 0.3
"""Time between two attempts to connect to fishd [s]."""
MAX_SILENCE_S = 1.0
"""Time without a tick after which the status of fishd is requested [s]."""
ANSWER_TIMEOUT_S = 1.0
"""Longest wait for an answer of fishd [s]."""


class TickTruth(Struct, frozen=True, gc=False):
    """Fields of a tick that the camera needs."""

    seq: int
    phi_c: float
    servo_on: bool
    time: float
    alpha: float | UnsetType = UNSET
    alpha_rate: float = 0.0
    phi: float = 0.0


class FishDescription(NamedTuple):
    """Description by fishd of its simulated fish."""

    tick: float
    """Period of fishd's loop [s]."""
    plant: PlantParameters
    sample_rate: float
    """Rate of the force samples, which sets the steps of the integration [1/s]."""
    lockstep: bool


class MotionPrediction:
    """Prediction of the tail's motion from each tick to the next."""

    def __init__(self, description: FishDescription) -> None:
        self._description = description
        self._fish = TetheredFish(description.plant)
        self._last_tick: TickTruth | None = None
        self._end = Tail(0.0, 0.0, 0.0)

    def follow(self, tick: TickTruth) -> list[tuple[Tail, Tail]]:
        """Return the parts of the motion that follow from a tick, as pairs of begin and end."""
        assert isinstance(tick.alpha, float)
        period, last_tick = self._description.tick, self._last_tick
        command = tick.phi_c if tick.servo_on else None
        now = Tail(tick.time, tick.alpha, tick.alpha_rate)
        parts = []
        if last_tick is None or tick.seq != last_tick.seq + 1:
            plant = self._description.plant
            self._fish = TetheredFish(plant, PlantState(phi=tick.phi))
            if plant.servo_delay:  # the commands within the servo's delay are unknown
                self._swim(command, plant.servo_delay + period)
        elif tick.time > self._end.time + TIME_TOLERANCE_S:  # after ticks that fishd has skipped
            self._swim(last_tick.phi_c if last_tick.servo_on else None, tick.time - self._end.time)
            parts.append((self._end, now))
        self._fish.state = PlantState(tick.phi, tick.alpha, tick.alpha_rate)
        end = tick.time + period
        if self._description.lockstep:  # on the grid of fishd's virtual clock
            end = (round(tick.time / period) + 1) * period
        self._swim(command, end - tick.time)
        state = self._fish.state
        self._last_tick, self._end = tick, Tail(end, state.alpha, state.alpha_rate)
        return [*parts, (now, self._end)]

    @property
    def end(self) -> float:
        """End of the predicted motion [s]."""
        return self._end.time

    def _swim(self, command: float | None, duration: float) -> None:
        duration = round(duration, 9)
        samples = max(1, round(self._description.sample_rate * duration))
        self._fish.advance(command, duration, samples)


class SimulatedSource:
    """Source of the frames above the fish of a fishd, also after fishd restarts."""

    def __init__(self, settings: SimulatedSettings, size: int) -> None:
        """size: height and width of a frame, of whose pixels is `off_axis` [px]"""
        scale = min(settings.width, settings.height) / size
        self._settings = replace(settings, off_axis=settings.off_axis * scale)
        self._decode: Callable[[bytes], TickTruth] = decoder(TickTruth)
        where = settings.fishd or find_control_address()
        self.device = f"a simulated camera above the fish at {where}"

    def run(self, sink: Sink, stopping: Callable[[float], bool]) -> None:
        """Draw frames until `stopping` returns true."""
        while not stopping(0.0):
            try:
                with Fish(self._settings.fishd, timeout=ANSWER_TIMEOUT_S) as fish:
                    self._follow(fish, sink, stopping)
            except FishError as error:
                sink.trouble(Trouble("waiting", str(error)))
            except Trouble as trouble:
                sink.trouble(trouble)
            stopping(RETRY_PERIOD_S)
            sink.alive()

    def _follow(self, fish: Fish, sink: Sink, stopping: Callable[[float], bool]) -> None:
        """Draw the fish of one fishd, until that ends or is replaced."""
        status = fish.status()
        description = _read_description(fish.config())
        view = _View(self._settings, description, sink)
        context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        try:
            connect = partial(connect_subscriber, context, access=fish.access)
            telemetry = Subscription(
                lambda address: connect(address, b"tick"),
                status.telemetry,
                f"the fishd at {fish.endpoint}",
            )
            offset = ClockOffset(clock_reader(fish))
            view.ahead = offset.update().seconds
            last_tick_time, last_seq = time.monotonic(), 0
            while not stopping(0.0):
                sink.alive()
                if telemetry.socket.poll(view.poll_timeout()):
                    topic, payload = (*telemetry.socket.recv_multipart(), b"")[:2]
                    telemetry.hear()
                    tick = self._decoded(payload) if topic == b"tick" else None
                    if tick is not None:
                        if tick.seq <= last_seq:
                            return  # from a fishd that has restarted
                        last_tick_time, last_seq = time.monotonic(), tick.seq
                        view.follow(tick, status)
                view.publish()
                if time.monotonic() - last_tick_time > MAX_SILENCE_S:
                    last_tick_time = time.monotonic()
                    if fish.status().pid != status.pid:
                        return
                    # With a waiting tick, it was this process that was delayed.
                    if not telemetry.socket.poll(LATE_ANSWER_WAIT_MS):
                        view.report_idle()
                        if telemetry.is_dead():
                            telemetry.replace(status.telemetry)
                view.ahead = offset.update().seconds
        finally:
            context.destroy(linger=0)

    def _decoded(self, payload: bytes) -> TickTruth | None:
        try:
            return self._decode(payload)
        except msgspec.DecodeError:
            return None


class _View:
    """View of the fish of one fishd, which puts each frame at its time."""

    def __init__(
        self, settings: SimulatedSettings, description: FishDescription, sink: Sink
    ) -> None:
        self._settings = settings
        self._camera = SimulatedCamera(settings, settings.width, settings.height)
        self._prediction = MotionPrediction(description)
        self._description = description
        self._sink = sink
        self._due: deque[Shot] = deque()
        self._last_seq = 0
        self.ahead = 0.0
        """Lead of fishd's clock over that of this machine [s]."""

    def follow(self, tick: TickTruth, status: Status) -> None:
        """Compute the frames until the next tick; raises `Trouble` without a simulated fish.

        status: status of the fishd that has ticked
        """
        kind = find_kind(status.robot)
        if kind.hides_from_camera or not isinstance(tick.alpha, float):
            is_real = kind.has_hardware and not kind.is_virtual
            raise Trouble(
                "unusable",
                kind.hides_from_camera or "this fishd does not publish the position of the tail",
                "use source: v4l2" if is_real else "start fishd with robot: simulated",
            )
        if not self._last_seq:
            self._begin(status)
        elif tick.seq > self._last_seq + 1:
            self._sink.lost(dropped=self._frames_in(tick.seq - self._last_seq - 1))
        self._last_seq = tick.seq
        for before, after in self._prediction.follow(tick):
            for frame in self._camera.frames(before, after):
                self._due.append(Shot(*frame, self._settings.exposure))
        if self._description.lockstep:
            while self._due:
                self._sink.put(self._due.popleft())
            self._sink.covered(self._prediction.end)

    def publish(self) -> None:
        """Put the frames that are due."""
        while self._due and self._due[0].available <= (now := self._now()):
            self._sink.put(self._due.popleft()._replace(available=now))

    def poll_timeout(self) -> int:
        """Return the longest wait for the next tick [ms]; wait here for a frame due within 1 ms."""
        if not self._due:
            return 200
        remaining = self._due[0].available - self._now()
        if remaining < 1e-3:
            time.sleep(max(0.0, remaining))
            return 0
        return min(200, int(remaining * 1e3))

    def report_idle(self) -> None:
        """Report that fishd answers, but does not tick."""
        reason = (
            "as in lockstep while it waits for its agent"
            if self._description.lockstep
            else "so far"
        )
        self._sink.trouble(Trouble("waiting", f"fishd answers, but does not tick, {reason}"))

    def _begin(self, status: Status) -> None:
        if self._description.lockstep:
            self._sink.begin(Timeline(True, status.boot_id, None))
        else:
            self._sink.begin(Timeline(False, status.boot_id, self._now))

    def _now(self) -> float:
        return time.monotonic() + self.ahead

    def _frames_in(self, ticks: int) -> int:
        rate = self._settings.rate
        return ticks if rate is None else round(ticks * self._description.tick * rate)


def _read_description(config: dict[str, Any]) -> FishDescription:
    """Return the fish of a configuration; raises `Trouble` where that is of another version."""
    try:
        plant = dict(config["plant"])
        if plant.get("model", TETHERED) != TETHERED:
            # Another model has other keys. Until the next tick, the tethered fish approximates it.
            plant = {name: plant[name] for name in PlantParameters.__struct_fields__}
        return FishDescription(
            tick=float(config["tick"]),
            plant=convert(plant, PlantParameters),
            sample_rate=float(config["simulation"]["sample_rate"]),
            lockstep=bool(config["lockstep"]),
        )
    except (Problem, KeyError, TypeError, ValueError) as error:
        raise Trouble(
            "unusable",
            f"the description of the fish by this fishd is not valid: {error}",
            "install the same version of fishd and fishd-camera",
        ) from None
