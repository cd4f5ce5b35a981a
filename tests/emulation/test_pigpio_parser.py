"""The text of a pigpio script: how it is read, and what is refused."""

import pytest

from fishd.emulation.pigpiod import errors
from fishd.emulation.pigpiod.errors import PigpioError
from fishd.emulation.pigpiod.parser import Instruction, Operand, parse


def refusal(text: str) -> int:
    """The error number that a script is refused with."""
    with pytest.raises(PigpioError) as caught:
        parse(text)
    return caught.value.number


def test_commands_are_read_one_after_the_other() -> None:
    assert parse("ld v7 0x10  S p1\nv7") == (
        Instruction("ld", None, (Operand("v", 7), Operand("", 16))),
        Instruction("s", 8, (Operand("p", 1), Operand("v", 7))),
    )


def test_a_jump_names_the_place_of_its_tag() -> None:
    assert parse("jmp 7 nop tag 7 halt")[0].operands == (Operand("", 2),)


@pytest.mark.parametrize(
    ("text", "values"),
    [("m 4 w", (4, 1)), ("modes 4 R", (4, 0)), ("m 4 5", (4, 2)), ("pud 4 u", (4, 2))],
)
def test_modes_and_pulls_are_letters(text: str, values: tuple[int, int]) -> None:
    (instruction,) = parse(text)
    assert tuple(operand.value for operand in instruction.operands) == values


@pytest.mark.parametrize(
    "text",
    ["frob 1", "lda", "lda x", "s 18", "mils -1", "sta p10", "ld v150 1", "jmp p0 tag 0", "w -4 1"],
)
def test_a_command_that_makes_no_sense_is_refused(text: str) -> None:
    assert refusal(text) == errors.BAD_SCRIPT_CMD


@pytest.mark.parametrize("text", ["proc 1", "procr 0", "shell ls", "help", "lda 08"])
def test_what_pigpiod_has_not_for_scripts_is_refused(text: str) -> None:
    assert refusal(text) == errors.BAD_SCRIPT_CMD


def test_tags_are_checked() -> None:
    assert refusal("tag 1 tag 1") == errors.DUP_TAG
    assert refusal("jmp 3") == errors.BAD_TAG
    assert refusal(" ".join(f"tag {number}" for number in range(51))) == errors.TOO_MANY_TAGS
