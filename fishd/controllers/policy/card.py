"""The card of a policy file, and how an observation becomes the network's input.

The card travels inside the ONNX file, so that a network is never run without its normalisation, at
another tick, for another amplitude or on other pictures than it was trained for.
"""

import math
from collections.abc import Callable
from operator import attrgetter
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import Meta, Struct
from numpy.typing import NDArray

from fishd.core.camera_frames import StackSettings
from fishd.core.errors import PolicyError
from fishd.core.files import MAX_SETTINGS_BYTES
from fishd.core.schema import Problem, convert, format_literal, nested_too_deeply
from fishd.core.signals import Observation

CARD_KEY = "fishd.card"
"""Key of the card in the metadata of an ONNX file."""

FORMAT = 3
"""Version of the card; a file with another one is refused."""

MAX_CARD_CHARACTERS = MAX_SETTINGS_BYTES
"""Of a card as text; that of a training has some two thousand [characters]."""

TICK_TOLERANCE_S = 1e-9
"""Largest difference between two ticks that are the same [s]."""

FeatureName = Literal[
    "fx", "fy", "fy_rate", "fin_velocity", "instruction_angle", "previous_angle", "side_time"
]
"""Fields of `Observation` that a policy may see."""

COMMAND_FEATURES = ("instruction_angle", "previous_angle", "side_time")
"""Those that are known without any sensor."""

MAX_HISTORY_TICKS = 64
"""[ticks]"""

_TOO_DEEP = "its card is JSON that is nested too deeply"

Positive = Annotated[float, Meta(ge=1e-30, le=1e30)]
"""In the range of a float32, as its inverse is."""


class Feature(Struct, frozen=True, forbid_unknown_fields=True):
    """One input of the network."""

    name: FeatureName
    scale: Positive
    """The value that the network sees as 1, in the unit of the observation's field."""


class Layout:
    """Turns observations into the network's input: each feature divided by its scale."""

    def __init__(self, features: tuple[Feature, ...]) -> None:
        self.features = features
        self._inputs = [
            (place, attrgetter(feature.name), 1.0 / feature.scale)
            for place, feature in enumerate(features)
        ]

    def vector(self, observation: Observation) -> NDArray[np.float32]:
        """The input, shape (number of features,), dimensionless."""
        row = np.empty(len(self._inputs), np.float32)
        self.write(observation, row)
        return row

    def write(self, observation: Observation, row: NDArray[np.float32]) -> None:
        """The same into an existing array, which is faster."""
        for place, value, factor in self._inputs:
            row[place] = value(observation) * factor


class Window(Struct, frozen=True):
    """Of which ticks a network is given the features."""

    ticks: int = 1
    span: float = 0.0
    """That many of them [s]."""


ONE_TICK = Window()


class History:
    """The network's input from the latest ticks: the features of the newest first.

    Ticks from before the beginning are like the first one. A tick that comes again is the same one,
    and one that is older than the latest, or so much newer that nothing of the history is left,
    begins anew: after a reset, a pause or a gap nobody has to tell.
    """

    def __init__(
        self,
        features: tuple[Feature, ...],
        window: Window = ONE_TICK,
        row: NDArray[np.float32] | None = None,
    ) -> None:
        """
        window: of which ticks
        row: where the input goes, shape (ticks × features,); by default to an array of its own
        """
        self._layout = Layout(features)
        self._window = window
        self.row = np.zeros(window.ticks * len(features), np.float32) if row is None else row
        """The input, dimensionless."""
        self._given = self.row.reshape(window.ticks, len(features))
        self._time = -math.inf
        self.push: Callable[[Observation], None] = self._only if window.ticks == 1 else self._next
        """Take the observation of a tick."""

    def forget(self) -> None:
        """Begin anew with the next observation."""
        self._time = -math.inf

    def _only(self, observation: Observation) -> None:
        self._layout.write(observation, self.row)

    def _next(self, observation: Observation) -> None:
        seen, passed = self._given, observation.time - self._time
        if passed > 0.0:
            seen[1:] = seen[:-1]
        self._layout.write(observation, seen[0])
        if not 0.0 <= passed < self._window.span:
            seen[1:] = seen[0]
        self._time = observation.time


class Provenance(Struct, frozen=True, kw_only=True):
    """Where a policy comes from; for people only."""

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
    relative_thrust: float | None = None
    """Share of the best square wave's thrust in a deterministic evaluation; None if unknown.

    A sealed file of an older version has it under the key `efficiency`.
    """
    frequency: float | None = None
    """Tail-beat frequency in that evaluation [Hz]."""
    note: str = ""


class Card(Struct, frozen=True, kw_only=True):
    """What must be known to run a policy, and where it comes from."""

    format: int = FORMAT
    observation: tuple[Feature, ...]
    """The numbers that the network is given, in order."""
    history: Annotated[int, Meta(ge=1, le=MAX_HISTORY_TICKS)] = 1
    """Of how many ticks it is given these numbers, the newest first."""
    pictures: StackSettings | None = None
    """The frames that it is given; None where it sees none."""
    tick: Positive
    """Period of the loop that it was trained in [s]."""
    amplitude: Positive
    """Φ: an output of ±1 is an instruction angle of ±Φ [rad]."""
    provenance: Provenance

    @property
    def numbers(self) -> int:
        """How many numbers the network is given, beside pictures."""
        return len(self.observation) * self.history

    @property
    def window(self) -> Window:
        """Of which ticks."""
        return Window(self.history, self.history * self.tick)

    @property
    def sees(self) -> str:
        """What it is shown of the fish, in a word or two; the command is no sight of it."""
        forces = any(feature.name not in COMMAND_FEATURES for feature in self.observation)
        if self.pictures is None:
            return "forces"
        return "forces, pictures" if forces else "pictures"

    def check_fit(self, tick: float, amplitude: float) -> None:
        """Raises `PolicyError` unless it can run on a robot with this tick [s] and Φ [rad]."""
        if abs(self.tick - tick) > TICK_TOLERANCE_S:
            raise PolicyError(
                f"it was trained at a tick of {self.tick * 1e3:g} ms, this robot's is "
                f"{tick * 1e3:g} ms; set tick: {self.tick:g}, or train one at this tick"
            )
        if self.amplitude > amplitude:
            raise PolicyError(
                f"it commands up to ±{self.amplitude:g} rad, beyond the robot's amplitude_limit, "
                f"{amplitude:g} rad; set amplitude_limit: {self.amplitude:g}, or train one for less"
            )


def encode(card: Card) -> str:
    """The card as JSON."""
    return msgspec.json.encode(card).decode()


def decode(text: str) -> Card:
    """The card in `text`; raises `PolicyError` that names what is missing or wrong."""
    if len(text) > MAX_CARD_CHARACTERS:
        raise PolicyError(f"its card has {len(text)} letters; {MAX_CARD_CHARACTERS} are the most")
    try:
        data = msgspec.json.decode(text)
    except RecursionError:
        raise PolicyError(_TOO_DEEP) from None
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise PolicyError(f"its card is not JSON: {error}") from None
    if not isinstance(data, dict):
        raise PolicyError("its card is not a JSON object")
    if nested_too_deeply(data):
        raise PolicyError(_TOO_DEEP)
    found = data.get("format")
    if found != FORMAT:
        older = isinstance(found, int) and found < FORMAT
        advice = ": it was written by an older fishd; train and export it again" if older else ""
        raise PolicyError(
            f"its card has format {format_literal(found)[:60]}; this fishd reads format "
            f"{FORMAT}{advice}"
        )
    past = data.get("provenance")
    if isinstance(past, dict) and "efficiency" in past:  # as sealed files of before call it
        past["relative_thrust"] = past.pop("efficiency")
    try:
        card = convert(data, Card)
    except Problem as problem:
        raise PolicyError(f"its card: {'.'.join(problem.path)}: {problem}") from None
    if not card.observation and card.pictures is None:
        raise PolicyError("its card names neither an observation nor pictures")
    return card
