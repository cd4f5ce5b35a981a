"""`swing --C auto`: it finds the C of fish that are not like the model, and says what it does."""

import math
from itertools import groupby

import pytest
from msgspec.structs import replace
from rigs.harness import LIMITS, PINNED_TICK, Rig, observe

from fishd.cli.output import format_criterion
from fishd.config import Config, load
from fishd.controllers import registry
from fishd.controllers.criterion_search import LADDER, START_INDEX, CriterionSearch, Phase
from fishd.core.errors import ParameterError
from fishd.lab.compare.survey import harsh
from fishd.lab.simulation import KeepingPublisher, simulate


def pinned(*overrides: str) -> Config:
    return load(None, (PINNED_TICK, *overrides))


def relative_thrust(
    C: float | str, *overrides: str, seconds: float = 90.0, settle: float = 60.0
) -> float:
    return simulate(pinned(*overrides), "swing", {"C": C}, seconds, settle).relative_thrust


def fixed(*overrides: str) -> float:
    """Return the relative thrust with a fixed C, which is steady within seconds."""
    return relative_thrust(0.6, *overrides, seconds=30.0, settle=10.0)


@pytest.mark.slow
@pytest.mark.parametrize(
    "change",
    ["servo_delay=0.08", "lateral_drag=0.4", "backlash=0.15", "servo_reaction=6e-3"],
)
def test_after_a_minute_it_is_near_the_best_where_a_fixed_criterion_is_not(change: str) -> None:
    assert fixed(f"plant.{change}") < 0.93
    assert relative_thrust("auto", f"plant.{change}") > 0.97


@pytest.mark.slow
@pytest.mark.parametrize("servo_speed", [52.5, 1.75])
def test_it_is_near_the_best_with_any_servo_and_much_noise(servo_speed: float) -> None:
    assert relative_thrust("auto", f"plant.servo_speed={servo_speed}") > 0.97


@pytest.mark.slow
def test_where_the_best_half_beat_lies_between_two_numbers_of_ticks_the_sides_take_turns() -> None:
    config = pinned(*harsh(318).overrides)
    squares = [simulate(config, "square", {"frequency": 10 / n}, 30.0) for n in (3, 4, 5, 6)]
    whole = [square.relative_thrust for square in squares]
    result = simulate(config, "swing", {"C": "auto"}, 90.0, 60.0)
    assert max(whole) < 0.91
    assert result.relative_thrust > 0.95
    assert result.quantities["halfway"] == 1.0
    assert result.half_beats == (4, 5)


@pytest.mark.slow
def test_a_gait_that_a_trial_has_lost_is_begun_again_and_that_trial_not_repeated() -> None:
    config = pinned(*harsh(652).overrides)
    assert simulate(config, "swing", {"C": 0.95, "lead": 0.05}, 30.0).relative_thrust < 0.1
    assert relative_thrust("auto", *harsh(652).overrides) > 0.95


@pytest.mark.slow
def test_a_fish_that_only_trembles_with_the_first_criterion_is_made_to_swim() -> None:
    assert fixed(*harsh(303).overrides) < 0.1
    assert relative_thrust("auto", *harsh(303).overrides, seconds=120.0) > 0.92


@pytest.mark.parametrize("seed", range(2))
def test_spikes_do_not_mislead_it(seed: int) -> None:
    rig = ("simulation.spike_rate=1", "simulation.spike_size=0.5", f"simulation.seed={seed}")
    assert relative_thrust("auto", *rig) > 0.98


def test_on_the_model_the_search_costs_a_few_percent_at_most() -> None:
    brief = {"seconds": 60, "settle": 0}
    assert relative_thrust("auto", **brief) > 0.95 * relative_thrust(0.6, **brief)


def test_neither_drift_nor_a_turned_sensor_misleads_it() -> None:
    rig = ("simulation.drift=0.02", "simulation.drift_period=20", "simulation.rotation=0.17")
    assert relative_thrust("auto", "plant.servo_delay=0.04", *rig) > 0.97


def test_it_shows_what_it_does_in_telemetry() -> None:
    rig = Rig().start("swing", C="auto")
    ticks = rig.run(600)
    tried = {tick.quantities["criterion"] for tick in ticks if tick.quantities}
    assert {LADDER[START_INDEX].C, LADDER[START_INDEX + 1].C, LADDER[START_INDEX - 1].C} <= tried
    assert ticks[0].quantities["searching"] == 1.0
    assert ticks[-1].quantities["ripple"] > 1e-3


def test_it_searches_anew_when_the_fish_changes() -> None:
    rig = Rig().start("swing", C="auto")
    assert any(tick.quantities["searching"] == 0.0 for tick in rig.run(900))
    rig.change_fin(0.03)
    assert any(tick.quantities["searching"] == 1.0 for tick in rig.run(200))


def test_a_number_that_is_set_ends_the_search_and_auto_begins_a_new_one() -> None:
    controller = registry.create("swing", {"C": "auto"}, LIMITS)
    controller.activate(observe())
    controller.retune(registry.merge_parameters(controller, "swing", {"C": 0.3}))
    controller.update(observe(fin_velocity=1.0))
    assert controller.criterion is None
    controller.retune(registry.merge_parameters(controller, "swing", {"C": "auto"}))
    controller.update(observe(fin_velocity=1.0))
    assert controller.criterion == 0.6


def test_it_is_refused_where_the_force_does_not_tell_the_thrust() -> None:
    for name, parameters in (("swing", {"C": "auto"}), ("thrust", {"target": 0.01})):
        with pytest.raises(ParameterError, match="which is the thrust of a tethered fish only"):
            registry.create(name, parameters, replace(LIMITS, tethered=False))
        with pytest.raises(ParameterError, match=r"needs ticks of 0\.15 s at most, not 0\.2 s"):
            registry.create(name, parameters, replace(LIMITS, tick=0.2))
    with pytest.raises(ParameterError, match=r"lead: 0.1 s is not valid with C auto"):
        registry.create("swing", {"C": "auto", "lead": 0.1}, LIMITS)


def swim_half_beat(search: CriterionSearch, number: int, amplitude: float) -> None:
    for tick in range(10):
        fx = amplitude * (1.0 - math.cos(2.0 * math.pi * (tick + 0.5) / 10.0))
        search.update(fx, 0.0, 0.05, 1.0 if number % 2 else -1.0)


@pytest.mark.parametrize(("former_swims", "then"), [(True, Phase.WATCH), (False, Phase.TRIAL)])
def test_a_gait_that_stays_lost_is_left_for_the_one_before_which_is_begun_again(
    former_swims: bool, then: Phase
) -> None:
    search = CriterionSearch()
    former = search._place
    search._place += 2
    search._launch(1.0)
    seen = []
    for number in range(60):
        seen.append((search.phase, search._place))
        swims = former_swims and search._place == former
        swim_half_beat(search, number, 1.0 if swims else 0.01)
    phases = (Phase.LAUNCH, Phase.BEFORE)
    tried = [(phase, place) for place in (former + 2, former) for phase in phases]
    assert [state for state, _ in groupby(seen)][:5] == [*tried, (then, former)]


@pytest.mark.parametrize(
    ("change", "restarts"), [(0.67, True), (0.8, False), (1.2, False), (1.33, True)]
)
def test_a_watched_gait_that_becomes_much_weaker_or_stronger_restarts_the_search(
    change: float, restarts: bool
) -> None:
    search = CriterionSearch()
    search._trials = []
    seen = []
    for number in range(60):
        swim_half_beat(search, number, 1.0 if number < 30 else change)
        seen.append(search.phase)
    assert seen[29] is Phase.WATCH
    assert (Phase.TRIAL in seen[30:]) is restarts


def test_a_ripple_below_the_noise_chooses_no_criterion_and_says_so_once(
    caplog: pytest.LogCaptureFixture,
) -> None:
    weak = pinned("amplitude_limit=0.05", "simulation.noise=2.3e-3", "simulation.seed=3")
    publisher = KeepingPublisher()
    simulate(weak, "swing", {"C": "auto"}, 180.0, publisher=publisher)
    shown = [tick.quantities for tick in publisher.ticks if tick.time > 90.0]
    criteria = [quantities["criterion"] for quantities in shown if not quantities["searching"]]
    assert criteria == [0.6] * len(criteria)
    assert len(criteria) > 0.5 * len(shown)
    assert not any(quantities["clear"] for quantities in shown)
    line = format_criterion(publisher.ticks[-1].quantities, "chosen")
    assert line.endswith("; the ripple of F_x does not rise above the noise")
    assert caplog.text.count("the ripple of F_x does not rise above the noise") == 1


def test_a_ripple_that_is_seldom_clear_begins_no_search() -> None:
    noisy = pinned("simulation.noise=0.05", "simulation.seed=2")
    publisher = KeepingPublisher()
    simulate(noisy, "swing", {"C": "auto"}, 400.0, publisher=publisher)
    shown = [tick.quantities for tick in publisher.ticks if tick.time > 150.0]
    assert not any(quantities["clear"] or quantities["searching"] for quantities in shown)


def test_a_ripple_above_the_noise_is_clear() -> None:
    assert simulate(pinned(), "swing", {"C": "auto"}, 60.0).quantities["clear"] == 1.0
