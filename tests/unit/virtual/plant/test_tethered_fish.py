import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from fishd.virtual.plant.base import REST, PlantState
from fishd.virtual.plant.parameters import MotorSettings, PlantParameters
from fishd.virtual.plant.tethered import AnyWindow, FinWindow, TetheredFish

Fish = PlantParameters
FISHES = {
    "default": Fish(),
    "slack cables": Fish(cable_slack=0.08),
    "fast servo": Fish(servo_speed=200.0, servo_lag=0.05),
    "slow servo, very slack cables": Fish(servo_speed=2.0, servo_lag=0.02, cable_slack=0.3),
    "backlash": Fish(backlash=0.1),
    "backlash and slack cables": Fish(backlash=0.2, cable_slack=0.15),
    "very fast servo, backlash": Fish(servo_speed=1000.0, servo_lag=0.02, backlash=0.3),
    "lazy servo": Fish(servo_dead_zone=0.1),
    "fast servo that pushes back": Fish(servo_speed=200.0, servo_lag=0.05, servo_reaction=-0.002),
    "quadratic drag": Fish(quadratic_drag=3.0, lateral_quadratic_drag=0.02),
    "quadratic drag alone": Fish(xi=0.0, lateral_drag=0.0, quadratic_drag=10.0),
    "quadratic drag, slack cables": Fish(quadratic_drag=0.5, backlash=0.1, cable_slack=0.05),
    "more lateral inertia": Fish(lateral_inertia_ratio=1.5),
    "no damping": Fish(xi=0.0),
    "heavy damping": Fish(xi=15.0),
    "stiff fin": Fish(omega0=60.0, xi=4.0),
    "linear servo": Fish(servo_law="linear"),
    "fast linear servo, backlash": Fish(
        servo_law="linear", servo_speed=200.0, servo_lag=0.05, backlash=0.1, servo_dead_zone=0.02
    ),
    "square-root servo, slack cables": Fish(servo_law="square-root", cable_slack=0.08),
    "square-root servo, quadratic drag": Fish(
        servo_law="square-root", servo_reaction=-0.002, quadratic_drag=3.0, backlash=0.05
    ),
}

REACTION_TIME = 0.01
"""Time constant of the mount that transmits the servo's reaction [s]."""

angles = st.floats(-1.5, 1.5)
states = st.builds(PlantState, angles, st.floats(-0.5, 0.5), st.floats(-5.0, 5.0))
fishes = st.sampled_from(list(FISHES.values()))
durations = st.floats(0.002, 0.2)
instructions = st.one_of(st.none(), angles)


def dead_band(angle: float, slack: float) -> float:
    return math.copysign(max(abs(angle) - slack, 0.0), angle)


def integrate(
    p: PlantParameters, state: PlantState, command: float | None, duration: float, samples: int
) -> tuple[PlantState, FinWindow]:
    """Integrate the equations with an adaptive solver."""
    from scipy.integrate import solve_ivp  # takes long to load, in every worker of pytest

    if command is not None:  # the wheel stops at the edge of the dead zone
        command = state.phi + dead_band(command - state.phi, p.servo_dead_zone)

    shares: dict[str, Callable[[float], float]] = {
        "tanh": math.tanh,
        "linear": lambda lags: min(1.0, lags),
        "square-root": lambda lags: min(1.0, math.sqrt(lags)),
    }

    def turn(phi: float) -> float:
        if command is None:
            return 0.0
        lags = (command - phi) / p.servo_lag
        if abs(lags) < 1e-10:  # else the solver swings about the end of a square root's motion
            return 0.0
        return math.copysign(shares[p.servo_law](abs(lags)), lags) * p.servo_speed

    def acceleration(phi: float, alpha: float, rate: float) -> float:
        # The wheel turns one way during the whole window, and the tail starts at its place.
        tail = max(phi - p.backlash, min(phi + p.backlash, state.phi))
        drive = p.coupling * dead_band(tail, p.cable_slack)
        braking = p.quadratic_drag * abs(rate) * rate
        return -p.xi * p.omega0 * rate - braking - p.omega0**2 * (alpha - drive)

    def forces(alpha: float, rate: float, a: float) -> tuple[float, float]:
        side = p.lateral_inertia_ratio * p.thrust_coefficient * a + p.lateral_drag * rate
        side += p.lateral_quadratic_drag * abs(rate) * rate
        return -p.thrust_coefficient * alpha * a, -side

    def derivative(_: float, y: np.ndarray) -> list[float]:
        # Called thousands of times: NumPy's floats are several times as slow as Python's.
        phi, alpha, rate, _, _, felt = y.tolist()
        turning, a = turn(phi), acceleration(phi, alpha, rate)
        reaction = (-p.servo_reaction * turning - felt) / REACTION_TIME
        thrust, lateral_force = forces(alpha, rate, a)
        return [turning, rate, a, thrust, lateral_force + reaction, reaction]

    solution = solve_ivp(
        derivative,
        (0.0, duration),
        [*state, 0.0, 0.0, 0.0],
        method="DOP853",
        dense_output=True,
        rtol=1e-12,
        atol=1e-13,
        max_step=duration / 60.0,
    )
    phi, alpha, rate, thrust, lateral_force, reaction = solution.y[:, -1]
    instants = (np.arange(samples) + 0.5) * duration / samples
    states = [solution.sol(t)[:3].tolist() for t in instants]
    each = [forces(alpha, rate, acceleration(phi, alpha, rate)) for phi, alpha, rate in states]
    sampled = np.mean(each, axis=0).tolist()
    window = FinWindow(
        duration,
        thrust / duration,
        lateral_force / duration,
        sampled[0],
        sampled[1] + reaction / duration,
        course=(),
    )
    return PlantState(phi, alpha, rate), window


def natural_scales(p: PlantParameters) -> tuple[list[float], list[float]]:
    """Return typical sizes of φ, α, α̇ and of F_x, F_y, sampled F_x, sampled F_y."""
    alpha, rate = 0.5, max(4.0, 0.5 * p.omega0)
    acceleration = p.xi * p.omega0 * rate + p.omega0**2 * alpha
    thrust = p.thrust_coefficient * alpha * acceleration
    lateral_force = p.thrust_coefficient * acceleration + p.lateral_drag * rate
    return [1.0, alpha, rate], [thrust, lateral_force] * 2


def means(window: AnyWindow) -> list[float]:
    sampled = [window.sampled_thrust, window.sampled_lateral_force]
    return [window.thrust, window.lateral_force, *sampled]


@pytest.mark.slow
@pytest.mark.parametrize("name", FISHES)
def test_every_window_agrees_with_an_adaptive_solver(name: str) -> None:
    p = FISHES[name]
    state_scale, force_scale = natural_scales(p)
    random = np.random.default_rng(sum(map(ord, name)))
    durations = [0.002, 0.2, *np.geomspace(0.003, 0.18, 8).tolist()]
    for k, duration in enumerate(durations):
        state = PlantState(random.uniform(-1, 1), random.uniform(-0.5, 0.5), random.uniform(-4, 4))
        command = None if k == 5 else random.uniform(-1, 1)
        fish = TetheredFish(p, state)
        window = fish.advance(command, duration, samples=1 + k)
        expected_state, expected = integrate(p, state, command, duration, samples=1 + k)
        error = np.subtract(fish.state, expected_state) / state_scale
        assert np.abs(error).max() < 1e-7, (duration, command)
        error = np.subtract(means(window), means(expected)) / force_scale
        assert np.abs(error).max() < 1e-7, (duration, command)


@given(fishes, states, instructions, durations, st.floats(0.01, 0.99))
def test_a_window_in_two_parts_leads_to_the_same_state_and_forces(
    p: PlantParameters, state: PlantState, command: float | None, duration: float, part: float
) -> None:
    whole, halves = TetheredFish(p, state), TetheredFish(p, state)
    window = whole.advance(command, duration, samples=1)
    first = halves.advance(command, part * duration, samples=1)
    second = halves.advance(command, duration - part * duration, samples=1)
    state_scale, force_scale = natural_scales(p)
    assert np.abs(np.subtract(whole.state, halves.state) / state_scale).max() < 1e-8
    together = part * np.array(means(first)) + (1.0 - part) * np.array(means(second))
    assert np.abs((together - means(window)) / force_scale)[:2].max() < 1e-8


def test_a_fish_at_rest_stays_at_rest_and_feels_nothing() -> None:
    fish = TetheredFish(PlantParameters())
    window = fish.advance(0.0, 0.05, samples=10)
    assert fish.state == REST
    assert means(window) == [0.0] * 4
    assert window.fin_peak == 0.0


@pytest.mark.parametrize(
    ("fault", "steps"),
    [  # a command, and the wheel angle that the fin has followed then [rad]
        ({"cable_slack": 0.1}, [(0.099, 0.0), (0.3, 0.2)]),
        # back by less than twice the play, and by more
        ({"backlash": 0.1}, [(0.3, 0.2), (0.11, 0.2), (0.0, 0.1)]),
        ({"servo_dead_zone": 0.1}, [(0.09, 0.0), (0.4, 0.3), (0.25, 0.3)]),
    ],
    ids=str,
)
def test_slack_play_and_a_dead_zone_are_taken_off_what_the_fin_follows(
    fault: dict[str, float], steps: list[tuple[float, float]]
) -> None:
    fish = TetheredFish(PlantParameters(**fault))
    for command, followed in steps:
        fish.advance(command, 5.0, samples=1)
        assert fish.state.alpha == pytest.approx(0.46 * followed, rel=1e-6, abs=0.0)


@pytest.mark.parametrize("delay", [0.03, 0.05, 0.08])
def test_a_delayed_servo_does_the_same_later(delay: float) -> None:
    late = TetheredFish(PlantParameters(servo_delay=delay, servo_reaction=0.001))
    prompt = TetheredFish(PlantParameters(servo_reaction=0.001))
    commands = [0.42, 0.42, -0.42, 0.1, -0.3, -0.3, 0.42, None, 0.2, 0.0]
    prompt.advance(None, delay, samples=1)
    whole = [late.advance(command, 0.05, samples=10) for command in commands]
    steps = [
        prompt.advance(commands[int((k * 0.01) / 0.05 + 1e-6)], 0.01, samples=2)
        for k in range(round((0.5 - delay) / 0.01))
    ]
    assert late.state == pytest.approx(prompt.state, abs=1e-9)
    last, tail = whole[-1], steps[-5:]
    for name in ("thrust", "lateral_force", "sampled_thrust"):
        mean = np.mean([getattr(step, name) for step in tail])
        assert getattr(last, name) == pytest.approx(mean, abs=1e-9)
    settled = np.mean([step.sampled_lateral_force for step in tail])
    assert last.sampled_lateral_force == pytest.approx(settled, abs=1e-6)


def test_an_instruction_that_is_held_gives_what_single_windows_give() -> None:
    # The prediction is skipped for a fish with any reaction of the servo, however small.
    held, single = (
        TetheredFish(PlantParameters(servo_reaction=reaction), motor=MotorSettings())
        for reaction in (0.0, 1e-30)
    )
    lengths = [12, 5, 6, 1, 1, 7, 20]
    for number, length in enumerate(lengths):
        for _ in range(length):
            angle = 0.4 if number % 2 else -0.3
            window, expected = held.advance(angle, 0.05, 10), single.advance(angle, 0.05, 10)
            assert held.state == pytest.approx(single.state, rel=1e-12, abs=1e-15)
            assert [*means(window), window.power, window.fin_peak] == pytest.approx(
                [*means(expected), expected.power, expected.fin_peak], rel=1e-11, abs=1e-15
            )
        held.state = single.state = PlantState(0.1, number * 0.01, 1.0)


def test_an_instruction_far_beyond_the_servo_lag_does_not_overflow() -> None:
    fish = TetheredFish(PlantParameters(servo_speed=5.0, servo_lag=1e-4))
    fish.advance(1.5, 0.05, samples=1)
    assert fish.state.phi == pytest.approx(0.25, rel=1e-12)


def turning_point(
    p: PlantParameters, start: PlantState, tail: float, command: float, duration: float
) -> float:
    """Return the fin angle at the reversal within a window."""
    low, high = 0.0, duration
    for _ in range(12):
        middle = 0.5 * (low + high)
        fish = TetheredFish(p, start)
        fish.cables.tail = tail
        fish.advance(command, middle, samples=1)
        if start.alpha_rate * fish.state.alpha_rate > 0.0:
            low = middle
        else:
            high = middle
    return fish.state.alpha


_STEPS = 100
"""Number of steps of slow motion in a window; no fin turns twice in one step."""


@example(PlantParameters(omega0=60.0, xi=4.0), PlantState(0.0, 0.34375, 3.0), 0.0, 0.171875)
@settings(max_examples=30)
@given(fishes, states, angles, durations)
def test_the_fin_peak_is_the_largest_angle_at_any_time_in_the_window(
    p: PlantParameters, state: PlantState, command: float, duration: float
) -> None:
    fish, slow_motion = TetheredFish(p, state), TetheredFish(p, state)
    peak = fish.advance(command, duration, samples=1).fin_peak
    seen = [abs(state.alpha)]
    for _ in range(_STEPS):
        before, tail = slow_motion.state, slow_motion.cables.tail
        slow_motion.advance(command, duration / _STEPS, samples=1)
        after = slow_motion.state
        seen.append(abs(after.alpha))
        if before.alpha_rate * after.alpha_rate < 0.0:  # it turned in between: find where
            seen.append(abs(turning_point(p, before, tail, command, duration / _STEPS)))
    assert peak == pytest.approx(max(seen), rel=2e-5, abs=1e-7)
    assert peak >= (1.0 - 1e-6) * max(seen) - 1e-12  # far below, the equations are not resolved


@pytest.mark.parametrize(("duration", "samples"), [(0.0, 10), (-0.1, 10), (0.05, 0)])
def test_a_window_without_time_or_samples_is_refused(duration: float, samples: int) -> None:
    with pytest.raises(ValueError, match="needs time and samples"):
        TetheredFish(PlantParameters()).advance(0.1, duration, samples)
