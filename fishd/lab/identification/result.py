"""What an identification has found: values with intervals, and how well they explain the forces."""

import math
from dataclasses import dataclass
from typing import Any

from fishd.control.estimators.base import LONGEST_LEAK
from fishd.lab.identification.response import Array

UNITS = {
    "omega0": "rad/s",
    "xi": "1",
    "coupling": "1",
    "servo_speed": "rad/s",
    "servo_lag": "rad",
    "thrust_coefficient": "N s^2/rad^2",
    "lateral_drag": "N s/rad",
    "servo_delay": "s",
    "backlash": "rad",
    "cable_slack": "rad",
    "servo_dead_zone": "rad",
    "servo_reaction": "N s^2/rad",
    "quadratic_drag": "1/rad",
    "lateral_quadratic_drag": "N s^2/rad^2",
    "rotation": "rad",
    "offset_x": "N",
    "offset_y": "N",
}
"""What is estimated, in the order of tables; the names are those of the configuration."""
UNKNOWN_TO_FITS = ("quadratic_drag", "lateral_quadratic_drag")
"""What only the configuration knows."""
OF_THE_RIG = ("rotation", "offset_x", "offset_y")
"""What belongs into the section `simulation`, not `plant`."""


@dataclass(frozen=True)
class Estimate:
    """One number with its 95 % interval, in SI units."""

    name: str
    value: float
    low: float
    """Lower end of the interval; −inf where these data do not tell."""
    high: float
    fitted: bool = True
    """False for one that was taken from the configuration."""

    @property
    def unit(self) -> str:
        """In SI notation, `1` for a pure number."""
        return UNITS[self.name]


@dataclass(frozen=True)
class Channel:
    """How one force was explained."""

    name: str
    """`fx` or `fy`"""
    explained: float
    """Share of the variance that the model explains, drift left out; 1 is all."""
    noise: float
    """Rms of the white noise of a tick's mean [N]."""
    drift: float
    """The sensor's drift over the runs, from lowest to highest [N]."""
    white: bool
    """Is what is left over no more than noise? Else the model lacks something of this fish."""


@dataclass(frozen=True, eq=False)
class Fit:
    """The forces that were measured, and those of the identified fish; arrays of equal length."""

    times: Array
    """End of each window, since the start [s]; NaN between two passages."""
    measured: Array
    """F_x and F_y [N], shape (2, n)."""
    simulated: Array
    """The same of the identified fish, without offset, drift and noise, shape (2, n)."""
    drift: Array
    """Offset and drift of the sensor, smoothed, shape (2, n) [N]."""


@dataclass(frozen=True, eq=False)
class Identification:
    """A fish and its rig, as their forces tell."""

    estimates: tuple[Estimate, ...]
    channels: tuple[Channel, Channel]
    seconds: float
    """Length of what was fitted [s]."""
    passages: int
    """Parts of it without a gap."""
    remarks: tuple[str, ...]
    """What a reader must know before the numbers are used, a line each."""
    names: tuple[str, ...]
    """What was fitted, but for the offsets."""
    correlation: Array
    """Of the errors of `names`, shape (names, names)."""
    fit: Fit

    def __getitem__(self, name: str) -> Estimate:
        """The estimate of this name; raises KeyError."""
        for estimate in self.estimates:
            if estimate.name == name:
                return estimate
        raise KeyError(name)

    @property
    def plant(self) -> dict[str, float]:
        """The section `plant` of a configuration."""
        return {e.name: e.value for e in self.estimates if e.name not in OF_THE_RIG}

    @property
    def simulation(self) -> dict[str, float]:
        """The section `simulation` of a configuration: the rig as it was, but for its drift."""
        rig = {name: self[name].value for name in OF_THE_RIG}
        return {**rig, "noise": max(channel.noise for channel in self.channels)}

    @property
    def leak(self) -> float | None:
        """The `estimator.leak` that restores the fin velocity, K/K_d [s]; None without a drag."""
        drag = self["lateral_drag"].value
        leak = self["thrust_coefficient"].value / drag if drag > 0.0 else LONGEST_LEAK
        return leak if 0.0 < leak < LONGEST_LEAK else None

    def to_yaml(self, origin: str = "") -> str:
        """Both sections and the leak, as a file that `fishd --config` reads.

        origin: what it was identified from, for a comment
        """
        lines = ["# A fish as identified" + (f" from {origin}" if origin else "") + "."]
        lines += [f"# Careful: {remark}." for remark in self.remarks]
        lines += ["plant:"]
        lines += [self._line(name, value) for name, value in self.plant.items()]
        lines += ["simulation:"]
        lines += [self._line(name, value) for name, value in self.simulation.items()]
        if leak := self.leak:
            lines += ["estimator:", f"  leak: {leak:.4g}  # s, K/K_d"]
        return "\n".join(lines) + "\n"

    def to_builtins(self) -> dict[str, Any]:
        """All but the series, for JSON."""
        return {
            "estimates": {
                e.name: {"value": e.value, "low": e.low, "high": e.high, "unit": e.unit}
                | ({} if e.fitted else {"fitted": False})
                for e in self.estimates
            },
            "channels": {
                c.name: {
                    "explained": c.explained,
                    "noise": c.noise,
                    "drift": c.drift,
                    "white": c.white,
                }
                for c in self.channels
            },
            "seconds": self.seconds,
            "passages": self.passages,
            "remarks": list(self.remarks),
        }

    def _line(self, name: str, value: float) -> str:
        if name not in UNITS:
            return f"  {name}: {_number(value)}"
        found = self[name]
        text = f"  {name}: {_number(_rounded(found))}"
        unit = "" if found.unit == "1" else f" {found.unit}"
        if not found.fitted:
            return f"{text}{unit and '  #' + unit}"
        return f"{text}  # {found.low:.5g} to {found.high:.5g}{unit}"


def _rounded(found: Estimate) -> float:
    """To a hundredth of the interval or better: more digits tell nothing."""
    width = found.high - found.low
    if not found.fitted or not 0.0 < width < math.inf:
        return found.value
    rounded = round(found.value, 2 - math.floor(math.log10(width)))
    # A fish that hardly answers is no fish without it: what must be positive stays so.
    return rounded if rounded or found.low <= 0.0 else found.value


def _number(value: float) -> str:
    """Six digits, as YAML reads a number."""
    text = f"{value:.6g}"
    mantissa, letter, exponent = text.partition("e")
    return f"{mantissa}{'' if '.' in mantissa else '.0'}{letter}{exponent}" if letter else text
