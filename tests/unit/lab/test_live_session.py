"""Sessions with the fish of a running fishd, here in virtual time: stops and lost ticks."""

import math
from typing import Any, cast

import pytest
from rigs.virtual_daemon import VirtualDaemon, VirtualStatus

from fishd.client import Fish
from fishd.core.calibration import ForceCalibration, ServoCalibration
from fishd.core.errors import NoDaemon
from fishd.core.protocol import Calibrations, State
from fishd.lab.measurement import measure
from fishd.lab.optimise.choice import Choice
from fishd.lab.optimise.search import Range, Search
from fishd.lab.optimise.trials import Aim, measure_trials
from fishd.lab.session import Disturbed, LiveSession


def rig_of(daemon: VirtualDaemon) -> LiveSession:
    return LiveSession(cast(Fish, daemon))


class LostAnswer(VirtualDaemon):
    """Daemon whose answers to `set_controller` are lost; it swims at once or after loading."""

    def __init__(self, ended_by: type[BaseException], loads: bool) -> None:
        super().__init__()
        self._ended_by = ended_by
        self._loads = loads
        self.loading: str | None = None

    def set_controller(self, name: str, /, **parameters: Any) -> State:
        if self._loads:
            self.loading = name
        else:
            super().set_controller(name, **parameters)
        raise self._ended_by

    def stop(self) -> State:
        self.loading = None  # as fishd's `superseded`
        return super().stop()


@pytest.mark.parametrize("ended_by", [KeyboardInterrupt, NoDaemon])
@pytest.mark.parametrize("loads", [False, True])
def test_a_controller_that_began_unheard_stops(ended_by: type[BaseException], loads: bool) -> None:
    daemon = LostAnswer(ended_by, loads)
    with pytest.raises(ended_by), rig_of(daemon) as rig:
        rig.swim("swing", {}, 1.0)
    assert daemon.loading is None
    assert daemon.status().mode == "idle"


def test_a_controller_that_was_set_by_hand_swims_on_and_the_experiment_says_so() -> None:
    daemon = VirtualDaemon()
    with rig_of(daemon) as rig:
        rig.rest(1.0)
        daemon.set_by_hand("sine")
        with pytest.raises(Disturbed, match="no longer holds the fish: sine was set by hand"):
            rig.swim("swing", {}, 1.0)
    assert daemon.status().controller == "sine"


def test_a_swim_that_is_ended_by_hand_says_who_ended_it() -> None:
    class Ended(VirtualDaemon):
        def ticks(self):  # type: ignore[no-untyped-def]
            for tick in super().ticks():
                if tick.seq == 30:
                    self.set_by_hand("sine")
                yield tick

    daemon = Ended()
    with (
        rig_of(daemon) as rig,
        pytest.raises(Disturbed, match="no longer holds the fish: sine was set by hand"),
    ):
        rig.swim("swing", {}, 5.0)
    assert daemon.status().controller == "sine"


def test_a_restart_of_fishd_is_told_at_once_whenever_it_happens() -> None:
    daemon = VirtualDaemon()
    with rig_of(daemon) as rig:
        rig.rest(5.0)
        daemon.restart()
        with pytest.raises(Disturbed, match="fishd was restarted"):
            rig.swim("swing", {}, 1.0)
    assert daemon.run.loop.seq < 5

    daemon = Restarting(at=40, then_ahead=0)
    with rig_of(daemon) as rig, pytest.raises(Disturbed, match="fishd was restarted"):
        rig.rest(5.0)
    assert daemon.run.loop.seq < 5

    daemon = Restarting(at=3, then_ahead=20)
    with rig_of(daemon) as rig, pytest.raises(Disturbed, match="fishd was restarted"):
        rig.rest(5.0)


class Restarting(VirtualDaemon):
    """Daemon that restarts after a tick; the first ticks of the new process are lost."""

    def __init__(self, at: int, then_ahead: int) -> None:
        super().__init__()
        self._at = at
        self._then_ahead = then_ahead

    def ticks(self):  # type: ignore[no-untyped-def]
        for tick in super().ticks():
            yield tick
            if self.pid == 1 and tick.seq == self._at:
                self.restart()
                self.lost = set(range(self._then_ahead))


def test_a_few_ticks_may_be_lost_but_not_many() -> None:
    with rig_of(VirtualDaemon()) as rig:
        complete = measure(rig, "swing", {}, 21.0)
    daemon = VirtualDaemon()
    daemon.lost = {100, 101, 200, 399}
    with rig_of(daemon) as rig:
        incomplete = measure(rig, "swing", {}, 21.0)
        assert len(incomplete.ticks) == pytest.approx(420 - 4, abs=2)
        assert incomplete.thrust == pytest.approx(complete.thrust, abs=0.05e-3)

    daemon = VirtualDaemon()
    daemon.lost = set(range(100, 110))
    with (
        rig_of(daemon) as rig,
        pytest.raises(Disturbed, match=r"10 of 4\d\d ticks were lost on their way .* than 2%"),
    ):
        measure(rig, "swing", {}, 21.0)
    assert daemon.status().mode == "idle"

    daemon.lost = set(range(500, 600, 10))
    choice = Choice(Search([Range("frequency", 1.0, 2.0)]), Aim(), {}, 0.01)
    with rig_of(daemon) as rig, pytest.raises(Disturbed, match="ticks were lost"):
        list(measure_trials(rig, "square", {}, choice.next, 40.0))


def test_a_swim_of_which_nothing_came_is_told() -> None:
    daemon = VirtualDaemon()
    daemon.lost = set(range(1, 30))
    with rig_of(daemon) as rig, pytest.raises(Disturbed, match="20 of 20 ticks were lost"):
        rig.swim("swing", {}, 1.0)


class Calibrated(VirtualDaemon):
    """Daemon whose robot has a calibrated force sensor."""

    def status(self) -> VirtualStatus:
        status = super().status()
        status.robot = "pi"
        return status

    def calibrations(self) -> Calibrations:
        known = ForceCalibration(covariance_x=((0.02 / 1.96) ** 2, 0.0, 0.0))
        return Calibrations(known, None, ServoCalibration(), None, 10.0)


def test_a_thrust_on_a_robot_has_the_uncertainty_of_its_calibration() -> None:
    with rig_of(Calibrated()) as rig:
        measurement = measure(rig, "swing", {}, 21.0)
    assert measurement.calibration_ci95 == pytest.approx(0.02 * measurement.thrust)
    both = math.hypot(measurement.thrust_ci95, 0.02 * measurement.thrust)
    assert measurement.total_ci95 == pytest.approx(both)


def test_a_robot_whose_servo_driver_is_not_installed_here_can_be_measured() -> None:
    class Foreign(Calibrated):
        """Robot with a servo driver of a package that this machine lacks."""

        def config(self) -> dict[str, Any]:
            return {**super().config(), "servo": {"driver": "unknown", "pin": 3}}

    assert rig_of(Foreign()).servo is None
