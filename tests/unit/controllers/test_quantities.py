"""Quantities of controllers: they reach telemetry, and invalid ones do no harm there."""

from typing import Any

import msgspec
import numpy as np
import pytest
from fishd_zoo import BAD
from rigs.harness import Rig, Scripted

from fishd.controllers import quantity, registry
from fishd.controllers.base import Controller
from fishd.core.dataframes import ticks_to_frame
from fishd.core.signals import Observation


class QuantityController(Scripted):
    """Controller with a quantity whose value a test sets."""

    shown: float = quantity("Hz", "What the test says.")
    never: float = quantity("1", "Is never assigned.")

    def __init__(self, shown: Any) -> None:
        def act(_: object) -> float:
            self.shown = shown
            return 0.1

        super().__init__(act)


def test_every_tick_shows_the_speeds_that_swing_reverses_by() -> None:
    rig = Rig().start("swing", C=0.5)
    ticks = rig.run(100)
    assert all(set(tick.quantities) == {"top_speed", "reversal_speed", "since_reversal"}
               for tick in ticks)  # fmt: skip
    table = ticks_to_frame(ticks)
    assert list(table["quantities.reversal_speed"]) == list(0.5 * table["quantities.top_speed"])
    top = table["quantities.top_speed"]
    assert top[40:].min() > 0.5 * top[40:].max()
    reversed_now = np.sign(table["phi_c"]).diff() != 0
    assert list(table["quantities.since_reversal"] == 0.0)[1:] == list(reversed_now)[1:]


def test_a_square_wave_reverses_where_its_phase_says_so() -> None:
    rig = Rig().start("square", frequency=1.3)
    for tick in rig.run(60):
        assert (tick.quantities["phase"] < 0.5) == (tick.phi_c > 0.0)


def test_nothing_is_shown_once_the_controller_is_out_of_command() -> None:
    rig = Rig().start("swing")
    rig.run(5)
    rig.loop.stop()
    assert "quantities" not in msgspec.to_builtins(rig.run(1)[-1])
    rig.start("swing")
    rig.run(5)
    rig.start("hold")
    assert "quantities" not in msgspec.to_builtins(rig.run(1)[-1])


@pytest.mark.parametrize("number", [2, np.float32(0.5), np.array([0.25])])
def test_any_real_number_can_be_shown(number: Any) -> None:
    rig = Rig().start(QuantityController(number))
    assert rig.run(2)[-1].quantities == {"shown": float(np.asarray(number).item())}


class Poisoned:
    """Value that ends the program when its type is asked for."""

    @property
    def item(self) -> Any:
        raise SystemExit("no")


@pytest.mark.parametrize("shown", [*BAD.values(), Poisoned()], ids=[*BAD, "poisoned"])
def test_what_is_no_finite_number_is_left_out_and_the_fish_swims_on(shown: Any) -> None:
    rig = Rig().start(QuantityController(shown))
    tick = rig.run(3)[-1]
    assert (tick.mode, tick.phi_c) == ("running", 0.1)
    assert b"quantities" not in msgspec.json.encode(tick)


@pytest.mark.parametrize(
    ("names", "complaint"),
    [
        ([f"q{number}" for number in range(17)], "17 quantities; at most 16"),
        (["q" * 41], "at most 40 characters"),
        (["two words"], "'two words' cannot name a quantity"),
    ],
)
def test_too_much_to_show_is_refused_with_the_class(names: list[str], complaint: str) -> None:
    declared = {name: quantity("1", "One of many.") for name in names}
    with pytest.raises(TypeError, match=complaint):
        type("Many", (Controller,), declared)


def test_to_count_on_from_nothing_is_told_with_what_would_be_right() -> None:
    class Counting(Scripted):
        beats: float = quantity("1", "How many there were.")

        def update(self, _: Observation) -> float:
            self.beats += 1
            return 0.0

    rig = Rig().start(Counting(lambda _: 0.0))
    rig.run(1)
    assert rig.reason == "controller-error"
    message = rig.loop.supervisor.reason.message  # type: ignore[union-attr]
    assert "quantity 'beats' has no value before one is assigned to it" in message
    assert "such as self.beats = 0.0 in __init__" in message
    assert getattr(Counting(lambda _: 0.0), "beats", 5.0) == 5.0


def test_what_a_controller_can_show_is_described_with_its_parameters() -> None:
    described = {quantity.name: quantity for quantity in registry.describe("swing").quantities}
    assert described["since_reversal"].unit == "s"
    assert registry.describe("hold").quantities == ()
