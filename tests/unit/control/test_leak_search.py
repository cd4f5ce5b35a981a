"""`estimator.leak: auto` finds the leak time of a fish from its forces, or keeps the default."""

import pytest
from msgspec import UNSET
from rigs.harness import PINNED_TICK, Rig

from fishd.config import load
from fishd.lab.simulation import simulate
from fishd.virtual.plant.parameters import PlantParameters

DRAG = PlantParameters().lateral_drag
RIGHT = PlantParameters().thrust_coefficient / DRAG


def leak_after_swing(*overrides: str, seconds: float = 60.0, **parameters: object) -> float:
    """Return the leak time in use after a minute of swing [s]."""
    rig = Rig("estimator.leak=auto", *overrides).start("swing", **parameters)
    leak = rig.run_for(seconds)[-1].leak
    assert leak is not UNSET
    return float(leak)


@pytest.mark.slow
@pytest.mark.parametrize(("times", "rotation"), [(0.5, 0.0), (3.0, 0.175), (10.0, 0.0)])
def test_the_leak_of_a_fish_with_another_drag_is_found(times: float, rotation: float) -> None:
    drag = f"plant.lateral_drag={times * DRAG}"
    leak = leak_after_swing(drag, f"simulation.rotation={rotation}", "simulation.offset_y=0.02")
    assert leak == pytest.approx(RIGHT / times, rel=0.25)


def test_noise_and_a_late_servo_with_play_do_not_mislead_the_search() -> None:
    drag = f"plant.lateral_drag={3.0 * DRAG}"
    for more in ("simulation.noise=2e-3", "plant.servo_delay=0.04", "plant.backlash=0.05"):
        assert leak_after_swing(drag, more) == pytest.approx(RIGHT / 3.0, rel=0.3)


@pytest.mark.slow
@pytest.mark.parametrize("tick", [0.01, 0.1])
def test_the_leak_is_found_at_other_ticks(tick: float) -> None:
    drag = f"plant.lateral_drag={3.0 * DRAG}"
    assert leak_after_swing(f"tick={tick}", drag) == pytest.approx(RIGHT / 3.0, rel=0.3)


@pytest.mark.parametrize("reaction", [6e-3, -3e-3])
def test_a_servo_that_shakes_the_sensor_does_not_change_the_leak(reaction: float) -> None:
    assert leak_after_swing(f"plant.servo_reaction={reaction}") == 0.3


def test_the_leak_does_not_change_while_the_fish_rests() -> None:
    rig = Rig("estimator.leak=auto", f"plant.lateral_drag={3.0 * DRAG}").start("swing")
    swum = rig.run_for(60.0)[-1].leak
    rig.loop.stop()
    assert rig.run_for(120.0)[-1].leak == swum


def test_with_the_leak_swing_thrusts_as_well_as_on_the_default_fish() -> None:
    drag = f"plant.lateral_drag={3.0 * DRAG}"
    share = {
        leak: simulate(
            load(None, [PINNED_TICK, f"estimator.leak={leak}", drag]), "swing", {}, 60.0, 30.0
        )
        for leak in ("0.3", "auto")
    }
    assert share["0.3"].relative_thrust < 0.85  # a number is not changed
    assert share["auto"].relative_thrust > 0.98


@pytest.mark.slow
@pytest.mark.parametrize("amplitude", [0.1, 0.8])
def test_on_the_default_fish_it_costs_no_thrust(amplitude: float) -> None:
    limit = f"amplitude_limit={amplitude}"
    shares = [
        simulate(
            load(None, [PINNED_TICK, f"estimator.leak={leak}", limit]), "swing", {}, 60.0, 10.0
        ).relative_thrust
        for leak in ("0.3", "auto")
    ]
    assert shares[1] > shares[0] - 0.01


def test_the_thrust_is_known_again_after_the_scale_of_the_velocity_has_changed() -> None:
    rig = Rig("estimator.leak=auto", f"plant.lateral_drag={3.0 * DRAG}", "simulation.offset_x=0.01")
    rig.run_for(3.0)
    rig.start("swing")
    ticks = rig.run_for(60.0)
    assert ticks[0].leak != ticks[-1].leak
    late = ticks[-400:]
    true = sum(tick.fx for tick in late) / len(late) - 0.01
    thrust, error = late[-1].thrust, late[-1].thrust_ci95
    assert error is not UNSET
    assert abs(thrust - true) < max(float(error), 0.02 * true)
