"""Scripts of the emulated pigpiod: their results, durations and errors."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fishd.hardware.servo.pigpio_pulses import COUNTDOWN
from fishd.virtual.pi.pigpiod import errors
from fishd.virtual.pi.pigpiod.errors import PigpioError
from fishd.virtual.pi.pigpiod.script import (
    INITIALISING_TIME,
    INSTRUCTION_TIME,
    MAX_BURST,
    Script,
    State,
)

START = 1.0


class Rig:
    """Script and a record of its servo pulses: (time from its start, GPIO, width)."""

    def __init__(self, text: str, *parameters: int, answer: int = 0) -> None:
        self.pulses: list[tuple[float, int, int]] = []
        self.answer = answer
        self.script = Script(text, self._servo, START - INITIALISING_TIME)
        self.script.start(START, parameters)

    def _servo(self, time: float, gpio: int, width: int) -> int:
        self.pulses.append((time - START, gpio, width))
        return self.answer

    def run(self, seconds: float = 0.01) -> "Rig":
        self.script.run(START + seconds)
        return self

    @property
    def state(self) -> State:
        return self.script.state(START)


def widths(text: str, *parameters: int) -> list[int]:
    """Return the servo pulses that a script requests."""
    return [width for _, _, width in Rig(text, *parameters).run().pulses]


@pytest.mark.parametrize("jump", ["jz", "jnz", "jmp"])
@pytest.mark.parametrize("value", [-1, 0, 1])
def test_jumps_look_at_the_flag_alone(jump: str, value: int) -> None:
    # The load after the comparison must not change the flag.
    pulses = widths(f"LDA p0 cmp 0 lda 5 {jump} 1 s 18 1500 tag 1", value)
    jumps = {"jz": value == 0, "jnz": value != 0, "jmp": True}[jump]
    assert pulses == ([] if jumps else [1500])


@pytest.mark.parametrize("step", ["s 18 1500", "mils 1"])
def test_a_result_is_left_in_accumulator_and_flag(step: str) -> None:
    assert widths(f"lda 7 cmp 0 {step} cmp 0 jz 1 s 18 1600 tag 1")[-1:] != [1600]
    assert Rig(f"{step} jnz 1 s 18 1 tag 1", answer=-7).run().pulses[-1:] != [(0, 18, 1)]


def test_a_decrement_sets_the_flag_and_wraps_as_a_c_int_does() -> None:
    rig = Rig("tag 0 dcr p0 jnz 0 dcr p1", 3, -(2**31)).run()
    assert rig.script.parameters[:2] == [0, 2**31 - 1]
    assert rig.state is State.HALTED


def test_delays_are_exact() -> None:
    rig = Rig("s 18 1 mils 20 s p1 2 mils p2 s 18 3", 0, 13, 5).run(0.02499)
    assert rig.pulses == [(0.0, 18, 1), (pytest.approx(0.02, abs=5 * INSTRUCTION_TIME), 13, 2)]
    assert rig.run(0.02501).pulses[2:] == [(pytest.approx(0.025, abs=1e-5), 18, 3)]


def test_a_script_goes_through_its_states() -> None:
    script = Script("mils 100 s 18 1500", lambda *_: 0, START)
    assert script.state(START) is State.INITIALISING
    with pytest.raises(PigpioError) as caught:
        script.start(START, ())
    assert caught.value.number == errors.SCRIPT_NOT_READY
    begun = START + INITIALISING_TIME
    assert script.state(begun) is State.HALTED
    script.start(begun, ())
    for seconds, state in ((0.05, State.RUNNING), (0.2, State.HALTED)):
        script.run(begun + seconds)
        assert script.state(begun + seconds) is state


def test_started_again_while_it_runs_it_only_gets_its_parameters() -> None:
    rig = Rig("s p0 1 mils 100 s p0 2", 4).run(0.01)
    rig.script.start(START + 0.01, (5,))
    assert [gpio for _, gpio, _ in rig.run(1.0).pulses] == [4, 5]


def test_an_endless_loop_without_pauses_costs_a_bounded_effort() -> None:
    rig = Rig("tag 0 s 18 1500 jmp 0").run(3600.0)
    assert len(rig.pulses) <= MAX_BURST
    assert rig.state is State.RUNNING


@given(rounds=st.integers(0, 30), gaps=st.lists(st.floats(0.0, 0.1), max_size=20))
def test_it_does_the_same_however_often_it_is_looked_at(rounds: int, gaps: list[float]) -> None:
    at_once, in_pieces = (Rig(COUNTDOWN.decode(), rounds, 18, 1500) for _ in range(2))
    at_once.run(0.5)
    time = 0.0
    for gap in gaps:
        time += gap
        in_pieces.run(min(time, 0.5))
    in_pieces.run(0.5)
    assert at_once.pulses == in_pieces.pulses
    assert at_once.script.parameters == in_pieces.script.parameters


@pytest.mark.parametrize(
    ("text", "number"),
    [
        *((bad, errors.BAD_SCRIPT_CMD) for bad in ("lda", "lda x", "s 18", "mils -1", "dcr p10")),
        *((bad, errors.BAD_SCRIPT_CMD) for bad in ("dcr 1", "jmp p0 tag 0", "lda 2147483648")),
        ("tag 1 tag 1", errors.DUP_TAG),
        ("jmp 3", errors.BAD_TAG),
    ],
)
def test_a_script_that_makes_no_sense_is_refused(text: str, number: int) -> None:
    with pytest.raises(PigpioError) as caught:
        Rig(text)
    assert caught.value.number == number
