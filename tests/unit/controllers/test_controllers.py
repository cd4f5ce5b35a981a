"""The controllers: waveforms, take-over without a bump, and their registry."""

import math
from itertools import groupby, pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace
from rigs.harness import LIMITS, commands, observe

from fishd.controllers import registry
from fishd.controllers.base import Limits
from fishd.core.errors import ParameterError, UnknownController
from fishd.core.schema import format_permitted

frequencies = st.floats(0.1, 5.0)
in_force = st.floats(-0.42, 0.42)
smooth = st.sampled_from(["sine", "triangle"])


def create(name: str, limits: Limits = LIMITS, **parameters: object) -> registry.Controller:
    return registry.create(name, parameters, limits)


def test_a_square_wave_spends_half_its_period_on_either_side() -> None:
    assert commands(create("square", frequency=2.5), 9) == [0.42] * 4 + [-0.42] * 4 + [0.42]


@given(frequencies)
def test_a_frequency_off_the_grid_is_right_on_average(frequency: float) -> None:
    given_ = commands(create("square", frequency=frequency), 1000)
    reversals = sum(a != b for a, b in pairwise(given_))
    assert reversals / 2 / (999 * 0.05) == pytest.approx(frequency, abs=0.5 / (999 * 0.05))


def test_square_waves_that_start_at_other_times_begin_at_other_places_of_their_dither() -> None:
    patterns = set()
    for swim in range(6):
        square = create("square", frequency=10 / 4.5)
        square.activate(replace(observe(), time=8.75 * swim))
        angles = [square.update(observe()) for _ in range(100)]
        lengths = [len(list(side)) for _, side in groupby(angles)]
        assert set(lengths[1:-1]) == {4, 5}
        patterns.add(lengths[0])
    assert patterns == {4, 5}


@given(st.floats(0.0, 1e6))
def test_a_square_wave_of_whole_ticks_is_the_same_whenever_it_starts(time: float) -> None:
    square = create("square", frequency=2.5)
    square.activate(replace(observe(), time=time))
    sides = [len(list(side)) for _, side in groupby(square.update(observe()) for _ in range(99))]
    assert set(sides[1:-1]) == {4}


def test_sine_and_triangle_have_the_shapes_of_their_names() -> None:
    limits = Limits(amplitude=0.4, tick=0.01)
    sine = create("sine", limits, frequency=1.0)
    triangle = create("triangle", limits, frequency=1.0)
    for controller in (sine, triangle):
        controller.activate(observe(dt=0.01))
    for k in range(200):
        phase = k * 0.01
        observed = observe(dt=0.01)
        assert sine.update(observed) == pytest.approx(0.4 * math.sin(math.tau * phase), abs=1e-9)
        expected = 0.4 * (2 / math.pi) * math.asin(math.sin(math.tau * phase))
        assert triangle.update(observed) == pytest.approx(expected, abs=1e-9)


@given(smooth, frequencies, in_force, st.floats(0.01, 0.42))
def test_sine_and_triangle_begin_with_the_angle_in_force(
    name: str, frequency: float, angle: float, amplitude: float
) -> None:
    controller = create(name, frequency=frequency, amplitude=amplitude)
    assert commands(controller, 1, angle)[0] == pytest.approx(angle, abs=1e-12)


@given(smooth, st.floats(0.1, 3.0), in_force, st.floats(0.01, 0.42))
def test_after_a_start_beyond_their_amplitude_they_return_into_it_without_a_jump(
    name: str, frequency: float, angle: float, amplitude: float
) -> None:
    controller = create(name, frequency=frequency, amplitude=amplitude)
    given_ = commands(controller, 600, angle)
    top_speed = math.tau * frequency * amplitude * 0.05
    assert all(abs(b - a) <= 2 * top_speed + 1e-9 for a, b in pairwise(given_))
    assert abs(given_[-1]) <= amplitude + 1e-9 or frequency * amplitude < 0.01


@given(
    st.sampled_from(["square", "sine", "triangle"]), frequencies, frequencies, st.integers(1, 99)
)
def test_a_new_frequency_keeps_phase(name: str, before: float, after: float, ticks: int) -> None:
    changed, steady = create(name, frequency=before), create(name, frequency=before)
    commands(changed, ticks)
    commands(steady, ticks)
    changed.retune(type(changed.parameters)(frequency=after))
    assert changed.parameters.frequency == after
    steady_next, changed_next = steady.update(observe(dt=1e-9)), changed.update(observe(dt=1e-9))
    assert changed_next == pytest.approx(steady_next, abs=1e-6)


@given(smooth, st.floats(0.05, 0.42), st.floats(0.05, 0.42), st.integers(1, 99))
def test_a_new_amplitude_makes_no_jump(name: str, before: float, after: float, ticks: int) -> None:
    controller = create(name, frequency=1.0, amplitude=before)
    last = commands(controller, ticks)[-1]
    controller.retune(type(controller.parameters)(frequency=1.0, amplitude=after))
    assert controller.update(observe(dt=1e-9)) == pytest.approx(last, abs=1e-6)


def test_an_amplitude_beyond_the_robots_limit_is_refused() -> None:
    with pytest.raises(ParameterError, match=r"square: amplitude: 0\.5 rad is beyond .* 0\.42 rad"):
        create("square", amplitude=0.5)
    with pytest.raises(ParameterError, match=r"hold: angle: -0\.5 rad is beyond"):
        create("hold", angle=-0.5)


@pytest.mark.parametrize(
    ("name", "tick", "frequency", "possible"),
    [
        ("square", 0.07, 7.143, "at most 7.14286 Hz is"),
        ("sine", 0.05, 10.0, "less than 10 Hz is"),
        ("triangle", 0.2, 3.0, "less than 2.5 Hz is"),
    ],
)
def test_a_wave_too_fast_for_the_tick_is_refused_with_the_highest_frequency(
    name: str, tick: float, frequency: float, possible: str
) -> None:
    limits = replace(LIMITS, tick=tick)
    with pytest.raises(ParameterError) as caught:
        create(name, limits, frequency=frequency)
    assert str(caught.value) == (
        f"{name}: frequency: {frequency:g} Hz is too fast for ticks of {tick:g} s: {possible} "
        "possible"
    )
    slower = create(name, limits, frequency=1.0)
    with pytest.raises(ParameterError, match="too fast"):
        registry.merge_parameters(slower, name, {"frequency": frequency})


@pytest.mark.parametrize(("tick", "frequency"), [(0.05, 10.0), (0.07, 7.14286)])
def test_a_square_wave_may_reverse_in_every_tick(tick: float, frequency: float) -> None:
    controller = create("square", replace(LIMITS, tick=tick), frequency=frequency)
    controller.activate(observe())
    given_ = [controller.update(observe(dt=tick)) for _ in range(1000)]
    assert given_ == [0.42, -0.42] * 500


def test_a_wrong_name_gets_the_nearest_right_one() -> None:
    with pytest.raises(UnknownController, match=r"no controller is named 'squre'; did you mean"):
        create("squre")


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"C": 1.5}, r"swing: C: 1\.5 is not valid: a number in \[0, 1\] \(or auto\) is needed"),
        ({"C": math.nan}, r"swing: C: nan is not valid: "),
        ({"amplitude": 24}, r"swing: amplitude: 24 is .* \(degrees\? that is 0\.419 rad\)$"),
        ({"amplitude": 240}, r"swing: amplitude: 240 is not valid: .* rad \(or null\) is needed$"),
        ({"amplitude": True}, r"swing: amplitude: true is .* rad \(or null\) is needed$"),
        ({"longest_half_period": 24}, r" s is needed \(ms\? that is 0\.024 s\)$"),
        ({"frequency": 0.6}, "; it has: C, amplitude, longest_half_period, lead$"),
        ({"amplitud": 0.2}, r"'amplitud' of controller swing; did you mean 'amplitude'\?$"),
    ],
)
def test_a_wrong_parameter_is_told_what_is_right(values: dict[str, object], message: str) -> None:
    with pytest.raises(ParameterError, match=message):
        create("swing", **values)


def test_every_installed_controller_describes_itself_and_its_parameters() -> None:
    assert {"hold", "square", "sine", "triangle", "swing"} <= set(registry.names())
    for name in registry.names():
        info = registry.describe(name)
        assert info.summary.endswith(".")
        for field in info.parameters:
            assert field.description.endswith(".")
            assert field.unit
            assert format_permitted(field)
