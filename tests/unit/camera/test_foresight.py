"""What the simulated camera believes of the motion until the next tick is what happens."""

import random
from itertools import pairwise
from typing import Any, cast

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace
from rigs.recordings import status, swum

from fishd.camera.settings import SimulatedSettings
from fishd.camera.simulated.camera import Tail
from fishd.camera.sources import simulated
from fishd.camera.sources.base import Shot, Timeline, Trouble
from fishd.camera.sources.simulated import Foresight, SimulatedSource, Swimmer, TickTruth
from fishd.client import Fish
from fishd.config import Config
from fishd.core.signals import Status, Tick
from fishd.virtual.fish import SimulatedFish
from fishd.virtual.imperfections import SimulationSettings
from fishd.virtual.plant.parameters import PlantParameters

TICK = 0.05


class Swim:
    """A simulated fish under random commands, and what a camera would hear of it."""

    def __init__(self, plant: PlantParameters, seed: int) -> None:
        self._fish = SimulatedFish(plant, SimulationSettings(), TICK)
        self._random = random.Random(seed)
        self._slot = self._seq = 0
        self.command = 0.0

    def tick(self, slots: int = 1, *, released: bool = False) -> TickTruth:
        """slots: how many periods after the previous one"""
        self._slot += slots
        self._seq += 1
        now = self._slot * TICK
        self._fish.read(now)
        truth = self._fish.truth()
        self.command = self._random.uniform(-0.42, 0.42)
        if released:
            self._fish.release()
        else:
            self._fish.write(self.command)
        state = {"alpha": truth.alpha, "alpha_rate": truth.alpha_rate, "phi": truth.phi}
        return TickTruth(self._seq, self.command, not released, now, **state)


def foresight(plant: PlantParameters, **options: Any) -> Foresight:
    return Foresight(Swimmer(TICK, plant, 200.0, options.get("lockstep", True)))


@settings(max_examples=20)
@given(
    seed=st.integers(0, 1000),
    delay=st.sampled_from([0.0, 0.03, 0.12]),
    backlash=st.sampled_from([0.0, 0.05]),
    slack=st.sampled_from([0.0, 0.03]),
)
def test_the_next_tick_is_known_to_the_last_bit(
    seed: int, delay: float, backlash: float, slack: float
) -> None:
    plant = PlantParameters(servo_delay=delay, backlash=backlash, cable_slack=slack)
    swim, ahead = Swim(plant, seed), foresight(plant)
    believed = Tail(0.0, 0.0, 0.0)
    for number in range(40):
        tick = swim.tick(released=number in (20, 21))
        # What was under way to the servo at first has arrived, and the tail has been taken along to
        # both sides: where it had been within its play, nobody knows.
        if number > 12:
            assert believed == (tick.time, tick.alpha, tick.alpha_rate)
        ((_, believed),) = ahead.follow(tick)
    assert ahead.end == believed.time


def test_slots_that_fishd_skips_leave_no_hole() -> None:
    swim, ahead = Swim(PlantParameters(), 1), foresight(PlantParameters(), lockstep=False)
    course = []
    for slots in (1, 1, 3, 1, 2, 1):
        course += ahead.follow(swim.tick(slots))
    for (_, left), (right, _) in pairwise(course):
        assert right.time == pytest.approx(left.time)
        assert right.alpha == pytest.approx(left.alpha, abs=1e-6)


def test_after_ticks_that_nobody_heard_it_begins_anew_from_the_true_state() -> None:
    plant = PlantParameters(servo_delay=0.08)
    swim, ahead = Swim(plant, 2), foresight(plant)
    ahead.follow(swim.tick())
    for _ in range(5):
        swim.tick()
    tick = swim.tick()
    ((begin, _),) = ahead.follow(tick)
    assert (begin.time, begin.alpha) == (tick.time, tick.alpha)
    for _ in range(4):  # until what was under way to the servo has arrived
        ((_, believed),) = ahead.follow(swim.tick())
    assert swim.tick().alpha == pytest.approx(believed.alpha, abs=1e-9)


class Heard:
    """Ticks that a process finds only at its second look, as it was held up itself."""

    def __init__(self, ticks: list[TickTruth]) -> None:
        self._ticks = ticks
        self.looks = 0

    def poll(self, _: int) -> int:
        self.looks += 1
        return int(self.looks > 1)

    def recv_multipart(self) -> list[bytes]:
        return [b"tick", msgspec.json.encode(self._ticks.pop(0))]


class Told:
    """A sink that keeps what it is told, until there are frames."""

    def __init__(self) -> None:
        self.troubles: list[str] = []
        self.frames = 0

    def begin(self, timeline: Timeline, degraded: tuple[str, ...] = ()) -> None:
        pass

    def put(self, shot: Shot) -> None:
        self.frames += 1

    def covered(self, until: float) -> None:
        pass

    def lost(self, dropped: int = 0, broken: int = 0) -> None:
        pass

    def trouble(self, trouble: Trouble) -> None:
        self.troubles.append(str(trouble))

    def alive(self) -> None:
        pass


class Fishd:
    """What a camera asks of a fishd."""

    def __init__(self, tick: Tick) -> None:
        self._status = replace(status(tick, pid=1), clock=0.0, boot="here")

    def status(self, _: float | None = None) -> Status:
        return self._status

    def config(self) -> dict[str, Any]:
        return dict(msgspec.to_builtins(Config()) | {"lockstep": True})


def test_a_camera_that_was_held_up_itself_does_not_say_that_fishd_does_not_tick(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    swim, sink = Swim(PlantParameters(), 3), Told()
    heard = Heard([swim.tick() for _ in range(20)])
    monkeypatch.setattr(simulated, "SILENCE", -1.0)  # it has been as long at each look
    monkeypatch.setattr(simulated, "subscriber", lambda *_: heard)
    source, fishd = SimulatedSource(SimulatedSettings(), 84), Fishd(swum(0.2).recorder.ticks[0])
    source._follow(cast(Fish, fishd), sink, lambda _: sink.frames > 3)
    assert sink.frames > 3
    assert sink.troubles == []
