"""Comparison on a fish whose thrust can only be measured, here in virtual time."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace
from rigs.policy_files import write

from fishd.config import Config, load
from fishd.core.errors import ParameterError, Refused
from fishd.core.signals import Event, Tick
from fishd.lab.compare import LiveComparison, compare
from fishd.lab.measurement import measure
from fishd.lab.session import Disturbed, VirtualSession

DRIFTS = load(None, ["simulation.drift=0.005", "simulation.noise=0.001"])


def test_a_drifting_sensor_ranks_by_the_true_thrust_which_lies_in_each_interval() -> None:
    names = ["sine:frequency=1.7", "swing", "square:frequency=1"]
    with VirtualSession(DRIFTS) as rig:
        live = LiveComparison(rig, names)
        live.swim(30.0)
    true, _ = compare(DRIFTS, names)
    for measured, truth in zip(live.standings(), true, strict=True):
        assert measured.contestant == truth.contestant
        assert measured.thrust_ci95 is not None
        assert abs(measured.thrust - truth.thrust) < measured.thrust_ci95 < 2e-3
        assert measured.form_factor == pytest.approx(truth.form_factor, abs=0.01)
        assert measured.frequency == pytest.approx(truth.frequency, abs=0.03)


def test_several_runs_come_in_turn() -> None:
    order: list[str] = []
    progress: list[float] = []

    class RecordingOrder(VirtualSession):
        def swim(
            self, controller: str, parameters: Mapping[str, Any], seconds: float
        ) -> list[Tick]:
            if order[-1:] != [controller]:
                order.append(controller)
            return super().swim(controller, parameters, seconds)

    class Progress:
        def tick(self, _: Tick) -> None:
            progress.append(rig.used)

        def event(self, _: Event) -> None:
            """Accept the event."""

    with RecordingOrder(DRIFTS) as rig, rig.heard_by(Progress()):
        live = LiveComparison(rig, ["swing", "sine"])
        live.swim(25.0, runs=2)
        standing = live.standings()[0]
    assert order == ["swing", "sine", "swing", "sine"]
    assert len(standing.thrusts) == 2
    assert progress == sorted(progress)
    assert progress[-1] == pytest.approx(100.0, rel=0.02)


@pytest.mark.parametrize(
    ("thrusts", "expected"),
    [
        ([20e-3, 20e-3, 20e-3], 0.3e-3 / math.sqrt(3.0)),  # the error of each swim decides
        ([19e-3, 20e-3, 21e-3], 4.302653 * 1e-3 / math.sqrt(3.0)),  # Student's t of three swims
        ([19e-3, 21e-3], 12.706205 * 1e-3),
        ([20e-3], 0.3e-3),
    ],
)
def test_the_error_of_several_runs_is_what_they_are_known_to_or_how_they_differ(
    monkeypatch: pytest.MonkeyPatch, thrusts: list[float], expected: float
) -> None:
    with VirtualSession(DRIFTS) as rig:
        measurement = measure(rig, "swing", {}, 21.0)
        runs = [replace(measurement, thrust=thrust, thrust_ci95=0.3e-3) for thrust in thrusts]
        monkeypatch.setattr("fishd.lab.compare.live.measure", lambda *_: runs.pop(0))
        live = LiveComparison(rig, ["swing"])
        live.swim(21.0, runs=len(runs))
    (standing,) = live.standings()
    assert standing.thrusts == thrusts
    assert standing.thrust == pytest.approx(20e-3)
    assert standing.thrust_ci95 == pytest.approx(expected, rel=1e-6)


def test_who_cannot_swim_or_gives_up_is_left_out_and_the_others_go_on(tmp_path: Path) -> None:
    shaking = str(write(tmp_path))
    with VirtualSession(Config()) as rig:
        live = LiveComparison(rig, ["swing:C=7", shaking, "swing"])
        live.swim(25.0, runs=2)
    assert [standing.contestant for standing in live.standings()] == ["swing"]
    (refused, refusal, _), (failed, failure, _) = live.left_out
    assert (refused.label, failed.label) == ("swing:C=7", shaking)
    assert "number in [0, 1]" in str(refusal)
    assert "ppo gave up" in str(failure)


class Disturbing(VirtualSession):
    """Session in which another client stops the fish during the second measurement."""

    swims = 0

    def swim(self, controller: str, parameters: Mapping[str, Any], seconds: float) -> list[Tick]:
        self.swims += 1
        if self.swims > 2:
            raise Disturbed("the fish was to swim sine, but it is in mode idle")
        return super().swim(controller, parameters, seconds)


def test_nobody_swims_on_after_somebody_interfered_and_what_was_measured_is_kept() -> None:
    with Disturbing(DRIFTS) as rig:
        live = LiveComparison(rig, ["swing", "sine", "square"])
        with pytest.raises(Disturbed):
            live.swim(25.0)
    assert [standing.contestant for standing in live.standings()] == ["swing"]
    assert len(live.traces()) == 1
    assert rig.swims == 3


def test_a_time_that_is_too_short_and_a_latched_fault_end_it_before_anyone_swims() -> None:
    class Latched(VirtualSession):
        def swim(self, *_: Any) -> list[Tick]:
            raise Refused("fault", "fishd is in fault")

    with Latched(DRIFTS) as rig:
        live = LiveComparison(rig, ["swing", "sine"])
        with pytest.raises(ParameterError, match="not possible"):
            live.swim(10.0)
        with pytest.raises(Refused):
            live.swim(25.0)
    assert (live.standings(), live.left_out) == ([], [])
