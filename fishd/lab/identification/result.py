"""What an identification has found: values with intervals, and how well they explain the forces."""

import math
from dataclasses import dataclass
from typing import Any

from fishd.control.estimators.base import MAX_LEAK_S
from fishd.lab.identification.response import Array

UNITS = {
    "omega0": "rad/s",
    "xi": "1",
    "quadratic_drag": "1/rad",
    "coupling": "1",
    "servo_speed": "rad/s",
    "servo_lag": "rad",
    "thrust_coefficient": "N s^2/rad^2",
    "lateral_inertia_ratio": "1",
    "lateral_drag": "N s/rad",
    "lateral_quadratic_drag": "N s^2/rad^2",
    "servo_delay": "s",
    "backlash": "rad",
    "cable_slack": "rad",
    "servo_dead_zone": "rad",
    "servo_reaction": "N s^2/rad",
    "rotation": "rad",
    "offset_x": "N",
    "offset_y": "N",
}
"""What is estimated, in the order of tables; the names are those of the configuration."""
PRODUCT_UNITS = {
    "thrust_coefficient * coupling^2": "N s^2/rad^2",
    "lateral_inertia * coupling": "N s^2/rad",
    "lateral_drag * coupling": "N s/rad",
}
"""Units of the products that forces tell without an assumption: K λ², K_y λ and K_d λ."""
OF_THE_RIG = ("rotation", "offset_x", "offset_y")
"""What belongs into the section `simulation`, not `plant`."""


@dataclass(frozen=True)
class Estimate:
    """One number with its 95 % interval, in SI units."""

    name: str
    value: float
    low: float
    """Lower end of the interval; 0 or −inf, with `high` inf, where it is withheld."""
    high: float
    fitted: bool = True
    """False for one that was taken from the configuration."""
    if_ratio_holds: tuple[float, float] | None = None
    """Ends of the 95 % interval if K_y/K is as configured; None where that makes no difference."""

    @property
    def unit(self) -> str:
        """Unit in SI notation, `1` for a pure number."""
        return UNITS.get(self.name) or PRODUCT_UNITS[self.name]

    @property
    def known(self) -> tuple[float, float]:
        """Ends of the narrowest interval: that of `if_ratio_holds`, where there is one."""
        return self.if_ratio_holds or (self.low, self.high)


@dataclass(frozen=True)
class Channel:
    """How one force was explained."""

    name: str
    """`fx` or `fy`"""
    explained: float
    """Share of the variance that the model explains, drift left out; 1 is all."""
    explained_out_of_sample: float
    """The same share of data that the model was not fitted to: each part is predicted from a fit
    of the others, where a part holds half beats of similar length and amplitude."""
    noise: float
    """Rms of the white noise of a tick's mean [N]."""
    drift: float
    """The sensor's drift over the runs, from lowest to highest [N]."""
    white: bool
    """Whether what is left over is no more than noise; else the model lacks something."""


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

    headline: str
    """First line of what is shown: whether the numbers can be trusted, and why not."""
    identified: bool
    """Whether the model explains the forces well enough for intervals; else they are withheld."""
    estimates: tuple[Estimate, ...]
    products: tuple[Estimate, ...]
    """K λ², K_y λ and K_d λ, which forces tell whatever K_y/K is."""
    channels: tuple[Channel, Channel]
    seconds: float
    """Length of what was fitted [s]."""
    passages: int
    """Parts of it without a gap."""
    remarks: tuple[str, ...]
    """What a reader must know before the numbers are used, a line each."""
    names: tuple[str, ...]
    """What was fitted, but for the offsets, and for K_y/K where no data tell it."""
    covariance: Array
    """Covariance of the errors of `names`, of logarithms for those in `fit.LOGARITHMIC`, with what
    misfit adds, for K_y/K as configured; shape (names, names)."""
    inflation: float
    """How many times as wide as noise alone makes them the intervals are, in the median."""
    failed_assumptions: tuple[str, ...]
    """What was assumed of the fish and does not hold, the clearest first; empty in the best case.

    `white residual of fx` or `fy`: what is left over is more than noise. `prediction of fx` or
    `fy`: data left out of the fit are predicted worse than those in it. `<name> = 0`: the key
    `<name>` of section `plant`, or `rotation`, explains a part of what is left over.
    """
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
        """The `estimator.leak` that restores the fin velocity, K_y/K_d [s]; None without a drag."""
        drag = self["lateral_drag"].value
        inertia = self["lateral_inertia_ratio"].value * self["thrust_coefficient"].value
        leak = inertia / drag if drag > 0.0 else MAX_LEAK_S
        return leak if 0.0 < leak < MAX_LEAK_S else None

    def to_yaml(self, origin: str = "") -> str:
        """Both sections and the leak, as a file that `fishd --config` reads.

        origin: what it was identified from, for a comment
        """
        lines = ["# A fish as identified" + (f" from {origin}" if origin else "") + "."]
        lines += [f"# {self.headline}."]
        lines += [f"# Careful: {remark}." for remark in self.remarks]
        lines += ["plant:"]
        lines += [self._line(name, value) for name, value in self.plant.items()]
        lines += ["simulation:"]
        lines += [self._line(name, value) for name, value in self.simulation.items()]
        if leak := self.leak:
            lines += ["estimator:", f"  leak: {leak:.4g}  # s, K_y/K_d"]
        return "\n".join(lines) + "\n"

    def to_builtins(self) -> dict[str, Any]:
        """All but the series, for JSON."""
        return {
            "headline": self.headline,
            "identified": self.identified,
            "failed_assumptions": list(self.failed_assumptions),
            "inflation": self.inflation,
            "estimates": {e.name: _plain(e) for e in self.estimates},
            "products": {e.name: _plain(e) for e in self.products},
            "channels": {
                c.name: {
                    "explained": c.explained,
                    "explained_out_of_sample": c.explained_out_of_sample,
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
        if not math.isfinite(found.high):
            return f"{text}  # not identified{unit and ',' + unit}"
        return f"{text}  # {found.low:.5g} to {found.high:.5g}{unit}"


def _plain(found: Estimate) -> dict[str, Any]:
    """Return an estimate for JSON, which has no infinity: an end that is withheld is None."""
    low, high = (end if math.isfinite(end) else None for end in (found.low, found.high))
    plain: dict[str, Any] = {"value": found.value, "low": low, "high": high, "unit": found.unit}
    if not found.fitted:
        plain["fitted"] = False
    if found.if_ratio_holds:
        plain["if_ratio_holds"] = list(found.if_ratio_holds)
    return plain


def _rounded(found: Estimate) -> float:
    """Return the value rounded to a hundredth of its interval or better."""
    low, high = found.known
    width = high - low
    if not found.fitted or not 0.0 < width < math.inf:
        return found.value
    rounded = round(found.value, 2 - math.floor(math.log10(width)))
    # A fish that hardly answers is no fish without it: what must be positive stays so.
    return rounded if rounded or low <= 0.0 else found.value


def _number(value: float) -> str:
    """Six digits, as YAML reads a number."""
    text = f"{value:.6g}"
    mantissa, letter, exponent = text.partition("e")
    return f"{mantissa}{'' if '.' in mantissa else '.0'}{letter}{exponent}" if letter else text
