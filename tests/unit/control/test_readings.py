"""The readings of sensors in the ticks, in status and for controllers; and sensors that fail."""

from dataclasses import replace

import pytest
from msgspec import UNSET
from rigs.harness import Rig, Scripted
from rigs.scripted_sensor import ScriptedSensor

from fishd.core.schema import Reading
from fishd.hardware.base import Robot


class SensorRig(Rig):
    """A simulated fish with scripted sensors."""

    def __init__(self, *sensors: ScriptedSensor) -> None:
        self.sensors = sensors or (ScriptedSensor(),)

        def wrap(robot: Robot) -> Robot:
            return replace(robot, sensors=self.sensors)

        super().__init__(wrap=wrap)

    def give(self, value: float, sensor: int = 0) -> None:
        """Let a sensor have a sample of this moment."""
        self.sensors[sensor].give(self.now, value)

    def swim(self, *values: float) -> None:
        """Run a tick for each value of the first sensor."""
        for value in values:
            self.give(value)
            self.run()

    @property
    def said(self) -> list[str]:
        """Messages of the events about sensors."""
        return [event.message for event in self.recorder.events if event.kind == "sensor"]


def test_every_tick_has_the_power_of_a_simulated_servo() -> None:
    rig = Rig()
    resting = rig.run(3)[-1].readings["power"]
    rig.start("square", frequency=2)
    swimming = [tick.readings["power"] for tick in rig.run(40)]
    assert resting == pytest.approx(0.06)
    assert min(swimming[1:]) > resting
    state = rig.loop.readings.states(rig.now)["power"]
    assert (state.unit, state.problem) == ("W", None)
    assert state.value == pytest.approx(sum(swimming) / 40)


def test_without_sensors_ticks_and_observations_have_no_readings() -> None:
    rig = Rig(wrap=lambda robot: replace(robot, sensors=()))
    assert rig.run(5)[-1].readings is UNSET
    assert rig.loop.perception.observation
    assert rig.loop.perception.observation.readings == {}
    assert rig.loop.readings.states(rig.now) == {}


def test_a_controller_sees_the_readings_of_its_tick() -> None:
    rig, seen = SensorRig(), []
    rig.start(Scripted(lambda o: seen.append(o.readings) or 0.0))
    rig.swim(20.0, 21.0)
    assert seen == [{"water_temperature": 20.0}, {"water_temperature": 21.0}]
    assert [tick.readings for tick in rig.recorder.ticks] == seen


def test_an_old_reading_disappears_without_a_fault_and_comes_back() -> None:
    rig = SensorRig()
    rig.start("square", frequency=2)
    rig.swim(20.0)
    rig.sensors[0].trouble = "nothing answers"
    ticks = rig.run(20)
    assert [tick.readings is not UNSET for tick in ticks] == [True] * 9 + [False] * 11
    assert {tick.mode for tick in ticks} == {"running"}
    state = rig.loop.readings.states(rig.now)["water_temperature"]
    assert state.value is None
    assert state.age == pytest.approx(1.05)
    assert state.problem == "sensors.water gives no water_temperature for 1.05 s: nothing answers"
    rig.swim(21.0)
    assert rig.recorder.ticks[-1].readings == {"water_temperature": 21.0}
    assert rig.said == [
        "sensors.water gives no water_temperature for 0.55 s: nothing answers",
        "sensors.water gives good readings again",
    ]
    assert rig.loop.readings.troubles == {}


def test_a_sensor_that_never_answers_is_reported_once_it_had_the_time() -> None:
    rig = SensorRig()
    rig.run(10)
    assert rig.said == []
    rig.run(20)
    assert rig.said == ["sensors.water gives no water_temperature for 0.55 s: it does not answer"]


def test_a_doubtful_reading_is_shown_with_one_warning() -> None:
    rig = SensorRig()
    rig.sensors[0].doubts = {"water_temperature": "water_temperature is 99 °C"}
    rig.swim(*[99.0] * 20)
    assert rig.recorder.ticks[-1].readings == {"water_temperature": 99.0}
    state = rig.loop.readings.states(rig.now)["water_temperature"]
    assert (state.value, state.problem) == (99.0, "water_temperature is 99 °C")
    assert rig.said == ["sensors.water: water_temperature is 99 °C"]
    assert rig.mode == "idle"


@pytest.mark.parametrize("doubtful", [False, True])
def test_only_an_old_reading_of_a_required_sensor_is_a_fault(doubtful: bool) -> None:
    flow = ScriptedSensor("pump", {"flow": Reading("m³/s", "Flow.")}, required=True)
    rig = SensorRig(ScriptedSensor(), flow)
    rig.start("square", frequency=2)
    for _ in range(20):
        flow.doubts = {"flow": "flow is much"} if doubtful else {}
        rig.give(1e-3, sensor=1)
        rig.run()
    assert rig.mode == "running"  # although sensors.water gives nothing
    rig.run(20)
    assert (rig.mode, rig.reason) == ("fault", "sensor-lost")
    assert rig.loop.supervisor.reason
    assert rig.loop.supervisor.reason.message.startswith("sensors.pump gives no flow for 0.55 s: ")
    rig.give(1e-3, sensor=1)
    rig.run()
    rig.loop.clear_fault()
    rig.run()
    assert rig.mode == "idle"
