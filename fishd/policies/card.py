"""What a policy file says about itself, and how an observation becomes the network's input.

The card travels inside the ONNX file, so that a network is never run without its normalisation, at
another tick or for another amplitude than it was trained for.
"""

import math
from operator import attrgetter
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import Meta, Struct
from numpy.typing import NDArray

from fishd.errors import PolicyError
from fishd.schema import Problem, convert
from fishd.signals import Observation

FORMAT = 1
"""Version of the card; a file with another one is refused."""

FeatureName = Literal["fx", "fy", "fy_rate", "fin_velocity", "instruction_angle"]
"""Fields of `Observation` that a policy may see."""

Positive = Annotated[float, Meta(gt=0)]


class Feature(Struct, frozen=True, forbid_unknown_fields=True):
    """One input of the network."""

    name: FeatureName
    scale: Positive
    """The value that the network sees as 1, in the unit of the observation's field."""


class Layout:
    """Turns observations into the network's input: each feature divided by its scale."""

    def __init__(self, features: tuple[Feature, ...]) -> None:
        self.features = features
        self._values = [attrgetter(feature.name) for feature in features]
        self._factors = [1.0 / feature.scale for feature in features]

    def vector(self, observation: Observation) -> NDArray[np.float32]:
        """The input, shape (number of features,), dimensionless."""
        pairs = zip(self._values, self._factors, strict=True)
        return np.array([value(observation) * factor for value, factor in pairs], np.float32)


class Provenance(Struct, frozen=True, kw_only=True):
    """Where a policy comes from; for people, nothing is decided by it."""

    created: str
    """ISO 8601."""
    fishd: str
    """Version of fishd that wrote the file."""
    algorithm: str
    on: str
    """What swam: simulation or robot."""
    steps: int
    """Control steps of training."""
    seed: int
    settings: dict[str, Any]
    """Hyper-parameters of the training."""
    plant: dict[str, Any]
    """The fish of the configuration: the one that swam, or that the scales are made for."""
    libraries: dict[str, str]
    """Versions of what trained it."""
    efficiency: float | None = None
    """Thrust in a deterministic evaluation, over that of the best square wave; None if unknown."""
    frequency: float | None = None
    """Tail-beat frequency in that evaluation [Hz]."""
    note: str = ""


class Card(Struct, frozen=True, kw_only=True):
    """What must be known to run a policy, and where it comes from."""

    format: int = FORMAT
    observation: tuple[Feature, ...]
    """The inputs of the network, in order."""
    tick: Positive
    """Period of the loop that it was trained in [s]."""
    amplitude: Positive
    """Φ: an output of ±1 is an instruction angle of ±Φ [rad]."""
    provenance: Provenance


def encode(card: Card) -> str:
    """The card as JSON."""
    return msgspec.json.encode(card).decode()


def decode(text: str) -> Card:
    """The card in `text`; raises `PolicyError` that names what is missing or wrong."""
    try:
        data = msgspec.json.decode(text)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise PolicyError(f"its card is no JSON: {error}") from None
    found = data.get("format") if isinstance(data, dict) else None
    if found != FORMAT:
        raise PolicyError(f"its card has format {found!r}; this fishd reads format {FORMAT}")
    try:
        card = convert(data, Card)
    except Problem as problem:
        raise PolicyError(f"its card: {'.'.join(problem.path)}: {problem}") from None
    if not card.observation:
        raise PolicyError("its card names no observation")
    numbers = (card.tick, card.amplitude, *(feature.scale for feature in card.observation))
    if not all(math.isfinite(number) for number in numbers):
        raise PolicyError("its card holds a number that is not finite")
    return card
