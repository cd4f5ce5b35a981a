"""Controller that misbehaves on request: `deed` is done in `method`.

`tools/reliability misbehaviour` installs it as a package and tries it with the real fishd.
"""

import asyncio
import logging
import os
import time
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import Struct

from fishd.controllers.base import Controller, Limits
from fishd.core.errors import ControllerFault, ParameterError
from fishd.core.signals import Observation


class Mute(Exception):
    """Exception whose text cannot be read."""

    def __str__(self) -> str:
        raise SystemExit("no text")


class Swapped(ControllerFault):
    """Exception whose code is not a text."""

    def __init__(self) -> None:
        super().__init__("zoo", "swapped")
        self.code = object()  # type: ignore[assignment]


RAISED = {
    "exit": SystemExit(0),
    "interrupt": KeyboardInterrupt(),
    "generator-exit": GeneratorExit(),
    "cancelled": asyncio.CancelledError(),
    "group": BaseExceptionGroup("two", [SystemExit(1), GeneratorExit()]),
    "stop-iteration": StopIteration(1),
    "stop-async": StopAsyncIteration(),
    "memory": MemoryError(),
    "timeout": TimeoutError("the model's server does not answer"),
    "surrogate": RuntimeError("half a character: \udcff"),
    "escape": RuntimeError("\x1b[2J\x9b31m\u202etxet\r\nof two lines"),
    "huge": RuntimeError("x" * 5_000_000),
    "mute": Mute(),
    "fault": Swapped(),
    "refusal": ParameterError("\udcff" * 5000),
}
GOOD = {
    "float64": np.float64(0.1),
    "float32": np.float32(0.1),
    "float16": np.float16(0.1),
    "0-d": np.array(0.1),
    "one": np.array([[0.1]], dtype=np.float32),
    "int": 0,
    "int64": np.int64(0),
    "fraction": Fraction(1, 10),
    "beyond": 1e300,
}
BAD = {
    "none": None,
    "text": "0.1",
    "bytes": b"0.1",
    "true": True,
    "np-true": np.bool_(True),
    "complex": 0.1 + 0j,
    "three": np.zeros(3),
    "empty": np.zeros(0),
    "list": [0.1],
    "nan": float("nan"),
    "inf32": np.float32("inf"),
    "too-large": 10**400,
    "type": float,
}


def loop() -> None:
    """Loop endlessly in Python."""
    while True:
        pass


def stubborn() -> None:
    """Loop endlessly, and ignore all exceptions."""
    while True:
        try:
            time.sleep(0.01)
        except BaseException:
            continue


def sleep() -> None:
    """Sleep for a day."""
    time.sleep(86400)


def block() -> None:
    """Block endlessly in C, without the interpreter's lock."""
    reader, _ = os.pipe()
    os.read(reader, 1)


class Endless:
    """Object whose text never ends, for a log."""

    def __str__(self) -> str:
        sleep()
        return ""


def log_for_ever() -> None:
    """Loop endlessly within a log record."""
    logging.getLogger("zoo").error("%s", Endless())


HANGS = {"loop": loop, "stubborn": stubborn, "sleep": sleep, "block": block, "log": log_for_ever}


class ZooParameters(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Parameters of `zoo`."""

    deed: str = ""
    method: str = "update"
    nudge: int = 0
    begun: str = ""
    """File that is created when the deed begins."""


class Zoo(Controller[ZooParameters]):
    """Controller that misbehaves."""

    Parameters = ZooParameters

    def __init__(self, parameters: ZooParameters, limits: Limits) -> None:
        super().__init__(parameters, limits)
        _act("__init__", parameters)

    @classmethod
    def check(cls, parameters: Any, limits: Limits) -> None:
        """Misbehave when it is time to check."""
        _act("check", parameters)

    def activate(self, observation: Observation) -> None:
        """Misbehave at the switch."""
        _act("activate", self.parameters)

    def update(self, observation: Observation) -> Any:
        """Misbehave in the tick."""
        return _act("update", self.parameters)

    def retune(self, parameters: ZooParameters) -> None:
        """Misbehave when parameters change."""
        _act("retune", parameters)
        super().retune(parameters)

    def close(self) -> None:
        """Misbehave at the end."""
        _act("close", self.parameters)


def _act(method: str, parameters: ZooParameters) -> Any:
    deed = parameters.deed
    if method != parameters.method:
        return 0.0
    if parameters.begun:
        Path(parameters.begun).touch()
    if deed in RAISED:
        raise RAISED[deed]
    if deed in HANGS:
        HANGS[deed]()
    return GOOD[deed] if deed in GOOD else BAD.get(deed, 0.0)
