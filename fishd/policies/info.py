"""A named policy as a program, or a person, wants to know it; free of numbers and ONNX."""

from typing import Any

from msgspec import Struct


class PolicyInfo(Struct, frozen=True, kw_only=True):
    """A file in one of the folders of policies."""

    name: str
    file: str
    """Its path."""
    problem: str
    """Why it cannot be put in command, in one line; empty where it can."""
    card: dict[str, Any] | None
    """What the file says about itself, a `fishd.policies.card.Card`; None where it is none."""
