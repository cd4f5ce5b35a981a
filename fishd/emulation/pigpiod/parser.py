"""Reads the text of a pigpio script into instructions, refusing what pigpiod refuses.

The language is that of the pigs man page, less the commands that the emulated pigpiod has not.
"""

import re
from typing import NamedTuple

from fishd.emulation.pigpiod import errors
from fishd.emulation.pigpiod.errors import PigpioError

PARAMETERS, VARIABLES, TAGS = 10, 150, 50
"""How many a script may have."""


class Operand(NamedTuple):
    """A number (bank ""), or the number of a parameter ("p") or variable ("v")."""

    bank: str
    value: int


class Instruction(NamedTuple):
    """One step of a script; `command` is pigpio's number, None for the script's own commands."""

    name: str
    command: int | None
    operands: tuple[Operand, ...]


# Kinds of operand: n any value, u a value that is not negative, r a register, t a tag,
# m a letter for a mode, d a letter for a pull.
_OWN = {
    **dict.fromkeys(("add", "and", "cmp", "div", "lda", "mlt", "mod", "or"), "n"),
    **dict.fromkeys(("rla", "rra", "sub", "xor", "wait", "evtwt"), "n"),
    **dict.fromkeys(("dcr", "inr", "pop", "push", "sta", "xa"), "r"),
    **dict.fromkeys(("call", "jm", "jmp", "jnz", "jp", "jz", "tag"), "t"),
    **dict.fromkeys(("dcra", "inra", "halt", "nop", "popa", "pusha", "ret"), ""),
    **dict.fromkeys(("ld", "rl", "rr"), "rn"),
    "x": "rr",
    "mics": "u",
    "mils": "u",
}
_PIGPIO: dict[str, tuple[int, str]] = {
    **dict.fromkeys(("m", "modes"), (0, "um")),
    **dict.fromkeys(("mg", "modeg"), (1, "u")),
    "pud": (2, "ud"),
    **dict.fromkeys(("r", "read"), (3, "u")),
    **dict.fromkeys(("w", "write"), (4, "uu")),
    **dict.fromkeys(("p", "pwm"), (5, "uu")),
    "prs": (6, "uu"),
    "pfs": (7, "uu"),
    **dict.fromkeys(("s", "servo"), (8, "uu")),
    "wdog": (9, "uu"),
    "br1": (10, ""),
    "br2": (11, ""),
    "bc1": (12, "n"),
    "bc2": (13, "n"),
    "bs1": (14, "n"),
    "bs2": (15, "n"),
    **dict.fromkeys(("t", "tick"), (16, "")),
    "hwver": (17, ""),
    "nb": (19, "un"),
    "np": (20, "u"),
    "nc": (21, "u"),
    "prg": (22, "u"),
    "pfg": (23, "u"),
    "prrg": (24, "u"),
    "pigpv": (26, ""),
    "trig": (37, "uuu"),
    "gdc": (83, "u"),
    "gpw": (84, "u"),
    "hp": (86, "uuu"),
    "fg": (97, "uu"),
    "fn": (98, "uuu"),
    "evm": (115, "un"),
    "evt": (116, "u"),
}
_LETTERS = {"m": "RW540123", "d": "ODU"}
_NUMBER = re.compile(r"([vp]?)([+-]?(?:0x[0-9a-f]+|[0-9]+))", re.IGNORECASE)
_JUMPS = ("jmp", "jz", "jnz", "jp", "jm", "call")


def parse(text: str) -> tuple[Instruction, ...]:
    """The instructions of a script, with jumps that name the place they go to.

    Raises `PigpioError`: BAD_SCRIPT_CMD for an unknown command or a bad operand, DUP_TAG,
    TOO_MANY_TAGS, and BAD_TAG for a jump to nowhere.
    """
    words = text.split()
    program: list[Instruction] = []
    tags: dict[int, int] = {}
    while words:
        name = words.pop(0).lower()
        command, kinds = _PIGPIO.get(name) or (None, _OWN.get(name))
        if kinds is None:
            raise PigpioError(errors.BAD_SCRIPT_CMD)
        operands = tuple(_operand(words.pop(0) if words else "", kind) for kind in kinds)
        if name != "tag":
            program.append(Instruction(name, command, operands))
        elif (tag := operands[0].value) in tags:
            raise PigpioError(errors.DUP_TAG)
        elif len(tags) == TAGS:
            raise PigpioError(errors.TOO_MANY_TAGS)
        else:
            tags[tag] = len(program)
    return tuple(_resolve(instruction, tags) for instruction in program)


def _resolve(instruction: Instruction, tags: dict[int, int]) -> Instruction:
    if instruction.name not in _JUMPS:
        return instruction
    place = tags.get(instruction.operands[0].value)
    if place is None:
        raise PigpioError(errors.BAD_TAG)
    return instruction._replace(operands=(Operand("", place),))


def _operand(word: str, kind: str) -> Operand:
    if kind in _LETTERS:
        value = _LETTERS[kind].find(word[:1].upper()) if word else -1
        if value < 0:
            raise PigpioError(errors.BAD_SCRIPT_CMD)
        return Operand("", value)
    match = _NUMBER.fullmatch(word)
    if not match:
        raise PigpioError(errors.BAD_SCRIPT_CMD)
    bank, value = match[1].lower(), _integer(match[2])
    if kind == "r" and not bank:
        bank = "v"
    most = {"p": PARAMETERS - 1, "v": VARIABLES - 1, "": 2**32 - 1}[bank]
    least = -(2**31) if not bank and kind in "nt" else 0
    if not least <= value <= most or (kind == "t" and bank):
        raise PigpioError(errors.BAD_SCRIPT_CMD)
    return Operand(bank, value)


def _integer(digits: str) -> int:
    """C's way to write integers: 0x is hexadecimal, a leading 0 octal."""
    bare = digits.lstrip("+-").lower()
    base = 16 if bare.startswith("0x") else 8 if bare.startswith("0") else 10
    try:
        return int(digits, base)
    except ValueError:
        raise PigpioError(errors.BAD_SCRIPT_CMD) from None
