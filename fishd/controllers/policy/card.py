"""The card of a policy file, and the conversion of observations to the network's input.

The card is part of the ONNX file, so that a network never runs without its normalisation, at
another tick, for another amplitude or on other pictures than those of its training.
"""

import math
from collections.abc import Sequence
from operator import attrgetter
from typing import Annotated, Any, Literal, get_args

import msgspec
import numpy as np
from msgspec import Meta, Struct
from numpy.typing import NDArray

from fishd.core.camera_frames import StackSettings
from fishd.core.errors import PolicyError
from fishd.core.files import MAX_SETTINGS_BYTES
from fishd.core.schema import (
    Problem,
    convert,
    format_excerpt,
    format_literal,
    nested_too_deeply,
)
from fishd.core.signals import Observation
from fishd.core.text import quoted

CARD_KEY = "fishd.card"
"""Key of the card in the metadata of an ONNX file."""

FORMAT = 3
"""Version of the card; a file with another one is refused."""

MAX_CARD_CHARACTERS = MAX_SETTINGS_BYTES
"""Maximum length of a card as text; that of a training has about two thousand [characters]."""

TICK_TOLERANCE_S = 1e-9
"""Largest difference of two ticks that count as equal [s]."""

FeatureName = Literal[
    "fx", "fy", "fy_rate", "fin_velocity", "instruction_angle", "previous_angle", "side_time"
]
"""Fields of `Observation` that a policy may use."""

FEATURE_NAMES: tuple[FeatureName, ...] = get_args(FeatureName)
READING = "readings."
"""Prefix of the name of an input that is a reading of a sensor, as `readings.flow`."""

COMMAND_FEATURES = ("instruction_angle", "previous_angle", "side_time")
"""Features that are known without a sensor."""

MAX_HISTORY_TICKS = 64
"""Maximum length of the history [ticks]."""

_TOO_DEEP = "its card is JSON that is nested too deeply"

Positive = Annotated[float, Meta(ge=1e-30, le=1e30)]
"""Positive number in the range of a float32, like its inverse."""


class Feature(Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """One input of the network."""

    name: str
    """Name of a field of `Observation`, or `readings.NAME` for a reading of a sensor."""
    scale: Positive
    """Difference from `offset` that becomes 1 in the network's input, in the unit of the value."""
    offset: Annotated[float, Meta(ge=-1e30, le=1e30)] = 0.0
    """Value that becomes 0, for a reading."""

    @property
    def reading(self) -> str:
        """Name of the reading; empty for a field of the observation."""
        return self.name.removeprefix(READING) if self.name.startswith(READING) else ""


def is_even(name: str) -> bool:
    """Return whether an input of this name is the same for the mirrored fish."""
    return name == "fx" or name.startswith(READING)


class Window(Struct, frozen=True):
    """Window of ticks whose features are the input of a network."""

    ticks: int = 1
    span: float = 0.0
    """Duration of the window [s]."""


ONE_TICK = Window()


class History:
    """The network's input from the latest ticks: the features of the newest first.

    Ticks before the beginning equal the first one. A tick with the time of the latest replaces it.
    A tick that is older, or newer by more than the window, restarts the history, such as after a
    reset, a pause or a gap. A reading that is old keeps its latest value; before the first one, its
    input is 0.
    """

    def __init__(
        self,
        features: tuple[Feature, ...],
        window: Window = ONE_TICK,
        row: NDArray[np.float32] | None = None,
    ) -> None:
        """
        window: window of ticks
        row: array for the input, shape (ticks × features,); by default a new one
        """
        self._inputs = [
            (place, attrgetter(feature.name), 1.0 / feature.scale)
            for place, feature in enumerate(features)
            if not feature.reading
        ]
        self._readings = [
            (place, feature.reading, feature.offset, 1.0 / feature.scale)
            for place, feature in enumerate(features)
            if feature.reading
        ]
        self._window = window
        self.row = np.zeros(window.ticks * len(features), np.float32) if row is None else row
        """Input of the network, dimensionless: each feature divided by its scale."""
        self._ticks = self.row.reshape(window.ticks, len(features))
        for place, *_ in self._readings:
            self._ticks[:, place] = 0.0
        self._time = -math.inf

    def forget(self) -> None:
        """Restart the history with the next observation."""
        self._time = -math.inf

    def push(self, observation: Observation) -> None:
        """Add the observation of a tick."""
        rows, elapsed = self._ticks, observation.time - self._time
        if elapsed > 0.0:
            rows[1:] = rows[:-1]
        newest = rows[0]
        for place, value, factor in self._inputs:
            newest[place] = value(observation) * factor
        for place, name, offset, factor in self._readings:
            if name in observation.readings:
                newest[place] = (observation.readings[name] - offset) * factor
        if not 0.0 <= elapsed < self._window.span:
            rows[1:] = newest
        self._time = observation.time


class Provenance(Struct, frozen=True, kw_only=True):
    """Provenance of a policy, for information only."""

    created: str
    """Date and time of the export, ISO 8601."""
    fishd: str
    """Version of fishd that wrote the file."""
    algorithm: str
    on: str
    """Environment of the training: simulation or robot."""
    steps: int
    """Number of control steps of the training."""
    seed: int
    settings: dict[str, Any]
    """Hyper-parameters of the training."""
    plant: dict[str, Any]
    """Fish of the configuration: the one in the training, or the one of the scales."""
    libraries: dict[str, str]
    """Versions of the libraries of the training."""
    relative_thrust: float | None = None
    """Thrust over that of the best square wave, in a deterministic evaluation; None if unknown."""
    frequency: float | None = None
    """Tail-beat frequency in that evaluation [Hz]."""
    note: str = ""


class Card(Struct, frozen=True, kw_only=True):
    """Data that are needed to run a policy, and its provenance."""

    format: int = FORMAT
    observation: tuple[Feature, ...]
    """Features of the network's input, in order."""
    history: Annotated[int, Meta(ge=1, le=MAX_HISTORY_TICKS)] = 1
    """Number of ticks whose features are the input, the newest first."""
    pictures: StackSettings | None = None
    """Settings of the frames of a camera; None without a camera."""
    tick: Positive
    """Period of the loop in the training [s]."""
    amplitude: Positive
    """Φ: an output of ±1 is an instruction angle of ±Φ [rad]."""
    provenance: Provenance

    @property
    def numbers(self) -> int:
        """Number of inputs of the network besides pictures."""
        return len(self.observation) * self.history

    @property
    def window(self) -> Window:
        """Window of ticks in the input."""
        return Window(self.history, self.history * self.tick)

    @property
    def sees(self) -> str:
        """Inputs that show the fish: `forces`, `pictures` or both; not readings and past angles."""
        forces = any(
            feature.name in FEATURE_NAMES and feature.name not in COMMAND_FEATURES
            for feature in self.observation
        )
        if self.pictures is None:
            return "forces"
        return "forces, pictures" if forces else "pictures"

    def check_fit(
        self, tick: float, amplitude: float, readings: Sequence[str] | None = None
    ) -> None:
        """Raise `PolicyError` unless it can run on a robot with this tick [s] and Φ [rad].

        readings: names of the readings of its sensors; None if they are unknown
        """
        for feature in self.observation:
            if feature.reading and readings is not None and feature.reading not in readings:
                raise PolicyError(
                    f"it needs the reading {quoted(feature.reading)}, which this robot does "
                    f"not have; it has {', '.join(readings) or 'none'}: add a sensor to sensors, "
                    "or rename one of its readings"
                )
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
    """Return the card as JSON."""
    return msgspec.json.encode(card).decode()


def decode(text: str) -> Card:
    """Return the card in `text`; raise `PolicyError` with the problem."""
    if len(text) > MAX_CARD_CHARACTERS:
        raise PolicyError(
            f"its card has {len(text)} characters; at most {MAX_CARD_CHARACTERS} are permitted"
        )
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
    version = data.get("format")
    if version != FORMAT:
        older = isinstance(version, int) and version < FORMAT
        advice = ": it was written by an older fishd; train and export it again" if older else ""
        raise PolicyError(
            f"its card has format {format_literal(version)[:60]}; this fishd reads format "
            f"{FORMAT}{advice}"
        )
    try:
        card = convert(data, Card)
    except Problem as problem:
        raise PolicyError(f"its card: {'.'.join(problem.path)}: {problem}") from None
    for feature in card.observation:
        if feature.name not in FEATURE_NAMES and not feature.reading:
            raise PolicyError(
                f"its card: observation.name: {format_excerpt(feature.name)} is not valid: one of "
                f"{' | '.join(FEATURE_NAMES)}, or {READING}NAME, is needed"
            )
    if not card.observation and card.pictures is None:
        raise PolicyError("its card names neither an observation nor pictures")
    return card
