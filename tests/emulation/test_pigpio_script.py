"""Scripts of the emulated pigpiod: what they compute, how long they take, when they wait."""

import math
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fishd.emulation.pigpiod import errors
from fishd.emulation.pigpiod.errors import PigpioError
from fishd.emulation.pigpiod.parser import parse
from fishd.emulation.pigpiod.script import BURST, INITIALISING_TIME, Script, State

START = 1.0
Call = tuple[float, int, int, int]


class Rig:
    """A script and a record of the pigpio commands that it gives."""

    def __init__(self, text: str, parameters: tuple[int, ...] = (), answer: int = 0) -> None:
        self.calls: list[Call] = []
        self.answer = answer
        self.script = Script(parse(text), self._execute, START - INITIALISING_TIME)
        self.script.start(START, parameters)

    def _execute(self, time: float, number: int, p1: int, p2: int, extension: bytes) -> int:
        self.calls.append((time, number, p1, p2))
        return self.answer

    def run(self, seconds: float = 0.01) -> "Rig":
        while self.script.time <= START + seconds:
            self.script.run(START + seconds)
        return self

    @property
    def state(self) -> State:
        return self.script.state(START)


def result(text: str, *parameters: int) -> int:
    """What a script leaves in p0."""
    return Rig(text, parameters).run().script.parameters[0]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("lda 7 sta p0", 7),
        ("lda 7 add 3 sta p0", 10),
        ("lda 7 sub 10 sta p0", -3),
        ("lda 7 mlt -3 sta p0", -21),
        ("lda -7 div 2 sta p0", -3),
        ("lda 7 div 0 sta p0", 0),
        ("lda -7 mod 4 sta p0", -3),
        ("lda 12 and 10 sta p0", 8),
        ("lda 12 or 3 sta p0", 15),
        ("lda 12 xor 10 sta p0", 6),
        ("lda 3 rla 4 sta p0", 48),
        ("lda 48 rra 4 sta p0", 3),
        ("lda 1 inra inra dcra sta p0", 2),
        ("ld p0 5 inr p0 inr p0 dcr p0", 6),
        ("ld p0 5 rl p0 2", 20),
        ("ld p0 20 rr p0 2", 5),
        ("ld v149 9 ld p0 v149", 9),
        ("ld p0 1 ld v3 2 x p0 v3", 2),
        ("ld p0 1 lda 2 xa p0", 2),
        ("ld v0 4 push v0 lda 5 pusha pop p0 popa add p0 sta p0", 9),
        ("call 1 halt tag 1 ld p0 8 ret", 8),
        ("lda 0x10 add 010 sta p0", 24),
        ("LDA 7 Sta P0", 7),
        ("lda 2147483647 inra sta p0", -(2**31)),
        ("ld p0 1 halt ld p0 2", 1),
    ],
)
def test_arithmetic_is_that_of_the_daemon(text: str, expected: int) -> None:
    assert result(text) == expected


@pytest.mark.parametrize(
    ("jump", "when"),
    [
        ("jz", lambda flag: flag == 0),
        ("jnz", lambda flag: flag != 0),
        ("jp", lambda flag: flag >= 0),
        ("jm", lambda flag: flag < 0),
        ("jmp", lambda flag: True),
    ],
)
@pytest.mark.parametrize("flag", [-1, 0, 1])
def test_jumps_look_at_the_flag_alone(jump: str, when: Callable[[int], bool], flag: int) -> None:
    # The load after the comparison must leave the flag alone.
    text = f"lda {flag} cmp 0 lda 5 {jump} 1 ld p0 1 halt tag 1 ld p0 2"
    assert result(text) == (2 if when(flag) else 1)


def test_a_command_leaves_its_result_in_accumulator_and_flag() -> None:
    rig = Rig("s 18 1500 sta p0 jm 1 halt tag 1 ld p1 1", answer=-7).run()
    assert rig.script.parameters[:2] == (-7, 1)


def test_a_delay_leaves_zero_in_accumulator_and_flag() -> None:
    assert result("lda 5 mils 1 sta p0 jz 1 halt tag 1") == 0
    assert result("ld p0 3 lda 5 add 1 mics 10 jnz 1 ld p0 4 tag 1") == 4


def test_operands_can_be_parameters_and_variables() -> None:
    rig = Rig("ld v7 1600 s p1 v7", (0, 18)).run()
    assert [call[1:] for call in rig.calls] == [(8, 18, 1600)]


def test_a_third_operand_travels_as_extension() -> None:
    seen = []
    script = Script(
        parse("hp 18 50 p3"), lambda *call: seen.append(call) or 0, START - INITIALISING_TIME
    )
    script.start(START, (0, 0, 0, 75_000))
    script.run(START + 1)
    assert seen == [(START, 86, 18, 50, (75_000).to_bytes(4, "little"))]


def test_delays_are_exact() -> None:
    times = [call[0] - START for call in Rig("s 18 1 mils 20 s 18 2 mics 500 s 18 3").run(1).calls]
    assert times == pytest.approx([0.0, 0.020, 0.0205], abs=1e-5)


def test_a_script_does_nothing_before_its_time() -> None:
    rig = Rig("mils 100 s 18 1500")
    assert rig.run(0.0999).calls == []
    assert len(rig.run(0.1001).calls) == 1


def test_it_is_initialising_for_a_moment_after_it_was_stored() -> None:
    script = Script(parse("halt"), lambda *call: 0, START)
    assert script.state(START) is State.INITIALISING
    with pytest.raises(PigpioError) as caught:
        script.start(START, ())
    assert caught.value.number == errors.SCRIPT_NOT_READY
    assert script.state(START + INITIALISING_TIME) is State.HALTED


def test_it_halts_at_its_end() -> None:
    assert Rig("ld p0 1").run().state is State.HALTED


def test_it_counts_as_running_during_a_delay() -> None:
    assert Rig("mils 1000").run().state is State.RUNNING


def test_stopped_in_a_delay_it_halts_when_the_delay_is_over() -> None:
    rig = Rig("mils 100 s 18 1500").run(0.01)
    rig.script.stop(START + 0.01)
    assert rig.state is State.RUNNING
    assert rig.run(0.2).state is State.HALTED
    assert rig.calls == []


def test_started_again_while_it_runs_it_only_gets_its_parameters() -> None:
    rig = Rig("s p0 1 mils 100 s p0 2", (4,)).run(0.01)
    rig.script.start(START + 0.01, (5,))
    assert [call[2] for call in rig.run(1.0).calls] == [4, 5]


def test_started_again_after_its_end_it_begins_from_the_top() -> None:
    rig = Rig("s 18 p0", (1,)).run(0.01)
    rig.script.start(START + 0.02, ())
    assert [call[3] for call in rig.run(1.0).calls] == [1, 1]


def test_it_waits_for_levels_and_is_told_which_changed() -> None:
    rig = Rig("wait 0x30 sta p0 mils 1000").run()
    assert (rig.state, rig.script.waits_for) == (State.WAITING, 0x30)
    rig.script.wake(START + 0.02, 0x20)
    assert rig.run(0.03).script.parameters[0] == 0x20


def test_stopped_while_it_waits_it_halts_at_once() -> None:
    rig = Rig("wait 1 s 18 1500").run()
    rig.script.stop(START + 0.02)
    assert rig.run(0.03).state is State.HALTED
    assert rig.calls == []


@pytest.mark.parametrize("text", ["pop p0", "ret", "tag 0 pusha jmp 0", "tag 0 call 0"])
def test_it_fails_when_its_stack_is_misused(text: str) -> None:
    assert Rig(text).run().state is State.FAILED


@pytest.mark.parametrize("text", ["tag 0 jmp 0", "nop ld p0 1", "tag 0 mics 1 jmp 0"])
def test_an_endless_loop_without_pauses_costs_a_bounded_effort(text: str) -> None:
    rig = Rig(text)
    steps = 0
    original = rig.script._step

    def counted(until: float) -> None:
        nonlocal steps
        steps += 1
        original(until)

    rig.script._step = counted  # type: ignore[method-assign]
    rig.run(3600.0)
    assert steps <= BURST + 1
    assert rig.state is State.RUNNING


def test_an_idle_loop_is_not_gone_through_round_by_round() -> None:
    rig = Rig("tag 0 mils 10 lda p0 cmp 0 jz 0 s 18 1500")
    rig.run(1e6)
    # It still stands where going through every round would have left it.
    assert START + 1e6 < rig.script.time <= START + 1e6 + 0.0101
    rig.script.update((1,))
    assert rig.run(1e6 + 0.02).calls


@given(rounds=st.integers(0, 30), gaps=st.lists(st.floats(0.0, 0.1), max_size=20))
def test_it_does_the_same_however_often_it_is_looked_at(rounds: int, gaps: list[float]) -> None:
    text = "tag 0 mils 10 lda p0 cmp 0 jz 0 dcr p0 jnz 0 s p1 p2 jmp 0"
    at_once = Rig(text, (rounds, 18, 1500)).run(0.5)
    in_pieces, time = Rig(text, (rounds, 18, 1500)), 0.0
    for gap in gaps:
        time += gap
        if time < 0.5:
            in_pieces.run(time)
    in_pieces.run(0.5)
    assert at_once.calls == in_pieces.calls
    assert len(at_once.calls) == (1 if rounds else 0)
    assert at_once.script.parameters == in_pieces.script.parameters


def test_an_empty_script_halts_at_once() -> None:
    assert Rig("").run().state is State.HALTED


def test_a_script_that_has_nothing_to_do_is_never_due() -> None:
    assert Rig("halt").run().script.time == math.inf
