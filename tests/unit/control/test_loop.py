"""One tick: its inputs, its outputs, and failures of its parts."""

import math
from dataclasses import replace
from typing import Any

import pytest
from msgspec import UNSET, structs
from rigs.harness import Rig, Scripted, Wrapped, fragile_rig
from rigs.scripted_sensor import ScriptedSensor

from fishd.core.clock import VirtualClock
from fishd.core.errors import ControllerFault, Refused, SensorError, ServoError
from fishd.core.signals import Extremes, Measurement, Observation, Tick, Truth
from fishd.hardware.base import Robot


def test_at_rest_the_servo_is_held_at_neutral() -> None:
    rig, robot = fragile_rig()
    first, _, tick = rig.run(3)
    assert (first.seq, first.t, tick.seq) == (1, 0.0, 3)
    assert (tick.mode, tick.controller, tick.phi_c, tick.servo_on) == ("idle", "hold", 0.0, True)
    assert robot.log == [0.0, 0.0, 0.0]


def test_missed_slots_are_counted_and_the_next_observation_covers_them() -> None:
    seen: list[float] = []

    def note(observation: Observation) -> float:
        seen.append(round(observation.dt, 9))
        return 0.0

    rig = Rig().start(Scripted(note))
    rig.run(2)
    tick = rig.run(missed=3)[0]
    assert seen == [0.05, 0.05, 0.2]
    assert tick.missed_slots == 3
    assert tick.samples == 40
    assert rig.recorder.kinds().count("overrun") == 1


def test_stopping_fades_to_neutral_within_the_fade_time() -> None:
    rig = Rig().start("hold", angle=0.42)
    rig.run(2)
    rig.loop.stop()
    angles = [tick.phi_c for tick in rig.run(8)]
    assert angles == sorted(angles, reverse=True)
    assert max(a - b for a, b in zip([0.42, *angles], angles, strict=False)) <= 0.0526
    assert angles[-1] == 0.0
    assert rig.mode == "idle"
    assert rig.recorder.ticks[-1].servo_on


@pytest.mark.parametrize("tick", [0.002, 0.03, 0.2])
@pytest.mark.parametrize("fade_time", [0.1, 0.4])
@pytest.mark.parametrize("missed", [0, 7])
def test_in_fault_the_servo_gets_neutral_for_a_tenth_of_a_second_before_it_is_released(
    tick: float, fade_time: float, missed: int
) -> None:
    rig, robot = fragile_rig(f"tick={tick}", f"fade_time={fade_time}")
    rig.start("hold", angle=0.42)
    rig.run(3)
    rig.loop.supervisor.fail("controller-error", "a test")
    while robot.log[-1]:
        rig.run(1, missed=missed)  # as on an overloaded machine
    since = rig.now
    while robot.log[-1] is not None:
        rig.run(1)
    assert 0.1 - 1e-9 <= rig.now - since < 0.1 + tick - 1e-9


def test_a_tail_that_has_been_at_neutral_is_released_at_once_in_fault() -> None:
    rig, robot = fragile_rig()
    rig.run(4)
    rig.loop.supervisor.fail("controller-error", "a test")
    rig.run(1)
    assert robot.log[-1] is None


def test_an_emergency_stop_ends_the_pulses_before_the_next_tick() -> None:
    rig, robot = fragile_rig()
    rig.start("square")
    rig.run(3)
    rig.loop.estop("the tank leaks")
    assert robot.log[-1] is None
    assert rig.mode == "estop"
    sent = len(robot.log)
    assert not rig.run(5)[-1].servo_on
    assert set(robot.log[sent:]) == {None}  # each tick releases it again
    assert rig.recorder.events[-1].message == "running → estop: the tank leaks"


def test_an_emergency_stop_must_be_cleared_and_is_followed_by_a_fade() -> None:
    rig = Rig().start("hold", angle=0.42)
    rig.run(2)
    rig.loop.estop("test")
    rig.run(2)
    with pytest.raises(Refused, match="clear-fault"):
        rig.start("square")
    rig.loop.clear_fault()
    angles = [tick.phi_c for tick in rig.run(9)]
    assert angles[0] == pytest.approx(0.42 - 0.0525)
    assert angles[-1] == 0.0
    rig.start("square")
    assert rig.mode == "running"


def test_a_tick_that_takes_longer_than_a_period_is_blamed_on_its_slowest_phase() -> None:
    rig = Rig()
    delays = iter([0.12])

    def wait(_: Observation) -> float:
        rig.clock.now += next(delays, 0.0)
        return 0.0

    rig.start(Scripted(wait))
    assert rig.run()[0].busy_time_us == pytest.approx(120e3)
    (tick,) = rig.run(missed=2, lateness=2e-3)  # its missed slots are not reported again
    assert (tick.lateness_us, tick.busy_time_us) == (pytest.approx(2e3), 0.0)
    assert rig.loop.statistics.overruns == 1
    (event,) = (event for event in rig.recorder.events if event.kind == "overrun")
    assert event.message == "tick 1 took 120.0 ms of its 50 ms, 120.0 ms of it in update"


def test_one_or_two_failed_reads_are_bridged_with_the_last_measurement() -> None:
    rig, robot = fragile_rig()
    rig.start("swing")
    good = rig.run(10)[-1]
    robot.read_error = SensorError("no acknowledge")
    assert [(tick.fy, tick.samples) for tick in rig.run(2)] == [(good.fy, 0)] * 2
    robot.read_error = None
    rig.run(2)
    assert rig.mode == "running"


@pytest.mark.parametrize(
    ("breakage", "reason"),
    [
        ({"read_error": SensorError("no acknowledge")}, "sensor-stale"),
        ({"read_error": ZeroDivisionError()}, "sensor-stale"),
        ({"fx": math.nan}, "sensor-stale"),
        ({"delay": 0.11}, "sensor-stale"),
        ({"suspect": "F_x is clipped"}, "sensor-range"),
        ({"write_error": ServoError("pigpiod is gone")}, "servo-link"),
        ({"write_error": TypeError("my bug")}, "servo-link"),
    ],
)
def test_broken_hardware_is_a_fault_and_one_event(breakage: dict[str, Any], reason: str) -> None:
    rig, robot = fragile_rig()
    rig.start("swing")
    rig.run(20)
    for name, value in breakage.items():
        setattr(robot, name, value)
    rig.run(20)
    assert (rig.mode, rig.reason) == ("fault", reason)
    assert rig.recorder.kinds().count("fault") == 1
    assert rig.loop.active.name == "hold"


def test_clearing_a_fault_that_is_still_there_latches_it_again() -> None:
    rig, robot = fragile_rig()
    robot.write_error = ServoError("pigpiod is gone")
    for _ in range(2):
        rig.run(3)
        assert (rig.mode, rig.reason) == ("fault", "servo-link")
        rig.loop.clear_fault()
    assert rig.recorder.kinds().count("fault") == 2


def test_a_suspect_force_is_published_but_reaches_no_estimator() -> None:
    rig, robot = fragile_rig()
    seen: list[Observation] = []
    rig.start(Scripted(lambda observation: seen.append(observation) or 0.42))  # type: ignore[func-returns-value]
    good = rig.run(10)[-1]
    robot.fx, robot.fy, robot.suspect = 1.0, 5.0, "F_y is clipped"
    tick = rig.run(1)[-1]
    assert (tick.fx, tick.fy, tick.samples, tick.suspect) == (1.0, 5.0, 10, "F_y is clipped")
    assert (seen[-1].fx, seen[-1].fy, seen[-1].fy_rate) == (good.fx, good.fy, 0.0)
    robot.read_error = SensorError("no acknowledge")
    tick = rig.run(1)[-1]
    assert (tick.fx, tick.fy, tick.samples, tick.suspect) == (good.fx, good.fy, 0, UNSET)


def test_a_suspect_force_that_a_slow_sensor_repeats_reaches_no_estimator() -> None:
    rig, robot = fragile_rig(kind=SlowSensor)
    good = rig.run(10)[-1]
    robot.fx, robot.fy, robot.suspect = 1.0, 5.0, "F_y is clipped"
    rig.run(1)
    robot.suspect, robot.samples = None, 0
    tick = rig.run(1)[-1]
    assert (tick.fx, tick.fy, tick.samples) == (good.fx, good.fy, 0)
    assert tick.sample_age_ms < 10.0


def test_a_tick_says_when_its_force_was_sampled() -> None:
    tick = Rig().run(3)[-1]
    assert (tick.force_age_ms, tick.force_span_ms) == pytest.approx((25.0, 50.0))


def test_a_release_that_fails_is_tried_again_until_it_works() -> None:
    rig, robot = fragile_rig()
    rig.start("square")
    rig.run(2)
    robot.release_error = ServoError("stuck")
    rig.loop.estop("test")
    assert rig.run(3)[-1].servo_on
    warnings = [event.message for event in rig.recorder.events if event.kind == "servo"]
    assert warnings == ["it may still have pulses, and cannot be released: stuck"]
    robot.release_error = None
    assert not rig.run(1)[-1].servo_on
    assert robot.log[-1] is None


class Slow(Scripted):
    """A controller that takes longer than half a period."""

    def __init__(self, rig: Rig, then: Exception | None = None) -> None:
        """then: exception of the third update"""
        self._updates = 0

        def wait(_: Observation) -> float:
            self._updates += 1
            if then and self._updates == 3:
                raise then
            rig.clock.now += 0.03
            return 0.0

        super().__init__(wait)


@pytest.mark.parametrize("between", ["stop", "nothing"])
def test_a_controller_is_not_blamed_for_the_slow_updates_of_the_one_before(between: str) -> None:
    rig = Rig()
    for _ in range(3):
        rig.start(Slow(rig))
        rig.run(2)
        if between == "stop":
            rig.loop.stop()
            rig.run(20)
    assert rig.reason is None


def test_a_successor_is_not_blamed_for_the_slow_updates_of_the_controller_that_gave_up() -> None:
    rig = Rig()
    successor = ("slow", Slow(rig))
    rig.start(Slow(rig, then=ControllerFault("chatter", "a test", successor=successor)))
    rig.run(4)
    assert (rig.reason, rig.loop.active.name) == (None, "slow")
    rig.run(1)
    assert rig.reason == "controller-slow"


class Waiting(Scripted):
    """A controller that notes the last command of the servo when it is closed."""

    def __init__(self, robot: Wrapped) -> None:
        super().__init__(lambda _: 0.4)
        self._robot = robot
        self.closed_after: list[float | None] = []

    def close(self) -> None:
        self.closed_after.append(self._robot.log[-1])


def test_an_emergency_stop_releases_the_servo_before_it_closes_a_controller() -> None:
    rig, robot = fragile_rig()
    active, pending = Waiting(robot), Waiting(robot)
    rig.start(active)
    rig.loop.set_controller_after(10.0, "waiting", pending)
    rig.run(2)
    rig.loop.estop("test")
    assert (active.closed_after, pending.closed_after) == ([None], [None])


class SlowSensor(Wrapped):
    """A robot whose force sensor does not have a new sample in each tick."""

    samples = 10

    def read(self, now: float) -> Measurement:
        return structs.replace(super().read(now), samples=self.samples)


class Restless(Wrapped):
    """A robot whose values all differ from tick to tick."""

    clock = VirtualClock()
    reads = 0

    def robot(self) -> Robot:
        return replace(
            super().robot(),
            truth=lambda: Truth(*self.next_values(3)),
            sensors=(self.sensor,),
        )

    @property
    def sensor(self) -> ScriptedSensor:
        return ScriptedSensor(
            latest=lambda: {"water_temperature": (self.clock.now, self.next_values(1)[0])}
        )

    def next_values(self, count: int) -> list[float]:
        return [1e-3 * (self.reads**2 + k / 10) for k in range(count)]

    def read(self, now: float) -> Measurement:
        self.reads += 1
        self.clock.now += self.reads * 1e-6
        extremes = Extremes(*self.next_values(4))
        # A drift, so that the zero is known
        forces = (1e-3 * force for force in self.next_values(2))
        time = now - self.reads * 1e-6
        return Measurement(
            time, *forces, self.reads, "", extremes, mean_time=time - 0.02, span=time
        )


ABSENT = {"x", "y", "speed", "heading", "leak", "suspect", "fy_corrected"}
"""Fields that are absent with this robot and estimator, and with a normal force."""


@pytest.mark.parametrize(
    ("mode", "may_stay"), [("idle", {"servo_on"}), ("fault", set()), ("estop", {"phi_c"})]
)
def test_no_field_of_a_tick_keeps_a_value_of_the_controller(mode: str, may_stay: set[str]) -> None:
    rig, restless = fragile_rig(kind=Restless)
    restless.clock = rig.clock
    rig.run(60)  # so that the zero of the force is known
    rig.start("square", frequency=4.9)
    rig.run(39, missed=1, lateness=5e-3)
    rig.loop.perception.thrust.calibrate(70.0, 0.5)  # since these forces do not determine it
    running = rig.run(1, missed=1, lateness=5e-3)[-1]
    leave = {
        "idle": rig.loop.stop,
        "fault": lambda: rig.loop.supervisor.fail("controller-error", "a test"),
        "estop": lambda: rig.loop.estop("a test"),
    }
    leave[mode]()
    tick = rig.run(20, missed=1, lateness=4e-3)[-1]
    kept = {f for f in Tick.__struct_fields__ if getattr(tick, f) == getattr(running, f)}
    assert kept - ABSENT == may_stay
