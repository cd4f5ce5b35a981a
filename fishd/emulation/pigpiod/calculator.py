"""What a pigpio script calculates with: accumulator, flag, registers and stack, 32 bits wide."""

import operator
from collections.abc import Callable

from fishd.emulation.pigpiod.parser import PARAMETERS, VARIABLES, Operand

STACK = 256
_NOTHING = Operand("", 0)


def signed(value: int) -> int:
    """As in a C int, 32 bits wide."""
    return ((value + 2**31) & 0xFFFFFFFF) - 2**31


def _divide(a: int, b: int) -> int:
    # Towards zero as in C; an ARM processor gives 0 for a division by zero.
    return 0 if b == 0 else (abs(a) // abs(b)) * (1 if (a < 0) == (b < 0) else -1)


_ARITHMETIC: dict[str, Callable[[int, int], int]] = {
    "add": operator.add,
    "sub": operator.sub,
    "mlt": operator.mul,
    "div": _divide,
    "mod": lambda a, b: a - b * _divide(a, b),
    "and": operator.and_,
    "or": operator.or_,
    "xor": operator.xor,
    "rl": lambda a, b: a << (b & 31),
    "rr": lambda a, b: a >> (b & 31),
}
_UNARY = {"inra": ("add", 1), "dcra": ("sub", 1)}
_SHIFTS = {"rla": "rl", "rra": "rr"}
_JUMPS: dict[str, Callable[[int], bool]] = {
    "jmp": lambda flag: True,
    "jz": lambda flag: flag == 0,
    "jnz": lambda flag: flag != 0,
    "jp": lambda flag: flag >= 0,
    "jm": lambda flag: flag < 0,
}


class StackError(Exception):
    """More was pushed than there is room for, or more popped than was pushed."""


class Calculator:
    """The state of a script's machine, and the instructions that concern nothing else."""

    def __init__(self) -> None:
        self._registers = {"p": [0] * PARAMETERS, "v": [0] * VARIABLES}
        self._stack: list[int] = []
        self.accumulator = self.flag = self.position = 0
        self.changes = 0
        """Counts what was stored in registers and on the stack."""

    @property
    def parameters(self) -> tuple[int, ...]:
        """The values of p0 to p9."""
        return tuple(self._registers["p"])

    @parameters.setter
    def parameters(self, first: tuple[int, ...]) -> None:
        self.changes += 1
        self._registers["p"][: len(first)] = first

    def restart(self) -> None:
        """Back to the top; the registers keep their values."""
        self.accumulator = self.flag = self.position = 0
        self._stack.clear()

    def value(self, operand: Operand) -> int:
        """The number that an operand stands for."""
        return self._registers[operand.bank][operand.value] if operand.bank else operand.value

    def conclude(self, result: int) -> None:
        """Take the result of a pigpio command."""
        self.accumulator = self.flag = signed(result)

    def calculate(self, name: str, first: Operand = _NOTHING, second: Operand = _NOTHING) -> None:
        """Carry out an instruction and move on; raises `StackError`."""
        self.position += 1
        value = self.value(first)
        if name in _JUMPS:
            if _JUMPS[name](self.flag):
                self.position = value
        elif name == "lda":
            self.accumulator = signed(value)
        elif name == "cmp":
            self.flag = signed(self.accumulator - value)
        elif name in ("dcr", "inr"):
            self.flag = self._store(first, value + (1 if name == "inr" else -1))
        elif name in _ARITHMETIC and second is _NOTHING:
            self.conclude(_ARITHMETIC[name](self.accumulator, value))
        elif name in _ARITHMETIC:
            self.flag = self._store(first, _ARITHMETIC[name](value, self.value(second)))
        elif name in _SHIFTS:
            self.conclude(_ARITHMETIC[_SHIFTS[name]](self.accumulator, value))
        elif name in _UNARY:
            operation, amount = _UNARY[name]
            self.conclude(_ARITHMETIC[operation](self.accumulator, amount))
        elif name == "ld":
            self._store(first, self.value(second))
        elif name == "sta":
            self._store(first, self.accumulator)
        elif name == "xa":
            self._store(first, self.accumulator)
            self.accumulator = value
        elif name == "x":
            other = self.value(second)
            self._store(second, value)
            self._store(first, other)
        else:
            self._use_stack(name, first)

    def _store(self, register: Operand, value: int) -> int:
        self.changes += 1
        self._registers[register.bank][register.value] = value = signed(value)
        return value

    def _use_stack(self, name: str, operand: Operand) -> None:
        self.changes += 1
        if name in ("call", "push", "pusha"):
            if len(self._stack) == STACK:
                raise StackError
            if name == "call":
                self._stack.append(self.position)
                self.position = operand.value
            else:
                value = self.accumulator if name == "pusha" else self.value(operand)
                self._stack.append(value)
        elif not self._stack:
            raise StackError
        elif name == "ret":
            self.position = self._stack.pop()
        elif name == "pop":
            self._store(operand, self._stack.pop())
        else:
            self.accumulator = self._stack.pop()
