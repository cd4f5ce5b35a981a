"""Result of an identification: parameters with intervals, and the explained share of forces."""

import math
from dataclasses import dataclass
from typing import Any

from fishd.core.estimation import MAX_LEAK_S
from fishd.lab.identification.response import Array
from fishd.virtual.plant.servo_law import ServoLaw

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
    "camera_delay": "s",
    "fin_angle_zero": "rad",
    "fin_angle_scale": "1",
}
"""Units of the estimates, in the order of tables; the names are those of the configuration."""
PRODUCT_UNITS = {
    "thrust_coefficient * coupling^2": "N s^2/rad^2",
    "lateral_inertia * coupling": "N s^2/rad",
    "lateral_drag * coupling": "N s/rad",
}
"""Units of the products that forces determine without assumptions: K λ², K_y λ and K_d λ."""
RIG_PARAMETERS = ("rotation", "offset_x", "offset_y")
"""Parameters of the section `simulation`, not `plant`."""


@dataclass(frozen=True)
class Estimate:
    """One number with its 95 % interval, in SI units."""

    name: str
    value: float
    ci95_low: float
    """Lower end of the interval; 0 or −inf, with `ci95_high` inf, where it is withheld."""
    ci95_high: float
    fitted: bool = True
    """False for a value that was taken from the configuration."""
    if_ratio_holds: tuple[float, float] | None = None
    """Ends of the 95 % interval if K_y/K is as configured; None where that makes no difference."""

    @property
    def unit(self) -> str:
        """Unit in SI notation, `1` for a pure number."""
        return UNITS.get(self.name) or PRODUCT_UNITS[self.name]

    @property
    def narrowest_interval(self) -> tuple[float, float]:
        """Ends of the narrowest interval: `if_ratio_holds`, or else `ci95_low` and `ci95_high`."""
        return self.if_ratio_holds or (self.ci95_low, self.ci95_high)


@dataclass(frozen=True)
class Channel:
    """The explained share and the noise of one force."""

    name: str
    """`fx` or `fy`"""
    explained: float
    """Share of the variance that the model explains, without drift; 1 is all of it."""
    explained_out_of_sample: float
    """Explained share of data that were left out of the fit: each group is predicted from a fit of
    the others, where a group holds half beats of similar length and amplitude."""
    noise: float
    """Rms of the white noise of the mean force of a tick [N]."""
    drift: float
    """Range of the sensor's drift over the runs [N]."""
    white: bool
    """True where the residual is white noise; else the model is incomplete."""


@dataclass(frozen=True, eq=False)
class Fit:
    """The measured forces and those of the identified fish, in arrays of equal length."""

    times: Array
    """End of each window, as time since the start [s]; NaN between two passages."""
    measured: Array
    """Measured F_x and F_y [N], shape (2, n)."""
    simulated: Array
    """Simulated F_x and F_y [N], without offset, drift and noise, shape (2, n)."""
    drift: Array
    """Offset and drift of the sensor, smoothed, shape (2, n) [N]."""


@dataclass(frozen=True, eq=False)
class FinAngleFit:
    """The camera that measured the fin angle, and its agreement with the identified fish."""

    estimates: tuple[Estimate, ...]
    """Delay of its time stamps, zero and, where K_y/K is known, scale."""
    explained: float
    """Share of the variance of the fin angle that the identified fish explains."""
    noise: float
    """Rms of the residual [rad]."""
    used: int
    """Number of fin angles."""
    left_out: int
    """Number of those that were left out, as they deviate too much."""
    times: Array
    """Times of all fin angles, as in `Fit`."""
    measured: Array
    """Fin angles in the direction of φ_c [rad]."""
    simulated: Array
    """Fin angles of the identified fish, with the zero of the camera [rad]."""

    def to_builtins(self) -> dict[str, Any]:
        """Return everything but the arrays, for JSON."""
        numbers = {name: vars(self)[name] for name in ("explained", "noise", "used", "left_out")}
        return numbers | {"estimates": {e.name: _to_builtins(e) for e in self.estimates}}


@dataclass(frozen=True, eq=False)
class Identification:
    """A fish and its rig as identified from forces, and fin angles if there are any."""

    headline: str
    """First line of a report: whether the values can be trusted, and if not, why."""
    identified: bool
    """True where the model explains the forces well enough; else intervals are withheld."""
    estimates: tuple[Estimate, ...]
    products: tuple[Estimate, ...]
    """K λ², K_y λ and K_d λ, which forces determine for any K_y/K."""
    channels: tuple[Channel, Channel]
    seconds: float
    """Length of the fitted data [s]."""
    passages: int
    """Number of parts without a gap."""
    remarks: tuple[str, ...]
    """Warnings about the values, one line each."""
    names: tuple[str, ...]
    """Names of the fitted parameters, without offsets, and without an undetermined K_y/K."""
    covariance: Array
    """Covariance of the errors of `names`, of logarithms for those in `fit.LOGARITHMIC`, misfit
    included, for K_y/K as configured; shape (names, names)."""
    inflation: float
    """Median ratio of the width of an interval to the width from noise alone."""
    failed_assumptions: tuple[str, ...]
    """Assumptions about the fish that do not hold, the clearest first; empty in the best case.

    `white residual of fx` or `fy`: the residual is more than noise. `prediction of fx` or `fy`:
    data left out of the fit are predicted worse than those in it. `<name> = 0`: the key `<name>`
    of section `plant`, or `rotation`, explains a part of the residual.
    """
    fit: Fit
    servo_law: ServoLaw
    """Law of the servo with which the forces are explained best."""
    fin_angle: FinAngleFit | None = None
    """Camera that measured the fin angle; None where only forces are used."""

    def __getitem__(self, name: str) -> Estimate:
        """Return the estimate of this name; raises KeyError."""
        for estimate in self.estimates:
            if estimate.name == name:
                return estimate
        raise KeyError(name)

    @property
    def plant(self) -> dict[str, float | str]:
        """Values of the section `plant` of a configuration."""
        fish = {e.name: e.value for e in self.estimates if e.name not in RIG_PARAMETERS}
        return {"servo_law": self.servo_law, **fish}

    @property
    def simulation(self) -> dict[str, float]:
        """Values of the section `simulation` of a configuration: the rig without its drift."""
        rig = {name: self[name].value for name in RIG_PARAMETERS}
        return {**rig, "noise": max(channel.noise for channel in self.channels)}

    @property
    def leak(self) -> float | None:
        """Key `estimator.leak` that restores the fin velocity, K_y/K_d [s]; None without drag."""
        drag = self["lateral_drag"].value
        inertia = self["lateral_inertia_ratio"].value * self["thrust_coefficient"].value
        leak = inertia / drag if drag > 0.0 else MAX_LEAK_S
        return leak if 0.0 < leak < MAX_LEAK_S else None

    def to_yaml(self, origin: str = "") -> str:
        """Return both sections and the leak as a configuration file for `fishd --config`.

        origin: source of the data, for a comment
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

    @property
    def summary(self) -> str:
        """Natural frequency, damping and the share of F_x that is explained, in a line."""
        omega0, xi = (self[name].value for name in ("omega0", "xi"))
        explained = self.channels[0].explained
        return f"omega0={omega0:.4g} rad/s, xi={xi:.4g}, {explained:.1%} of F_x explained"

    def to_builtins(self) -> dict[str, Any]:
        """Return everything except the series, for JSON."""
        return {
            "headline": self.headline,
            "identified": self.identified,
            "servo_law": self.servo_law,
            "failed_assumptions": list(self.failed_assumptions),
            "inflation": self.inflation,
            "estimates": {e.name: _to_builtins(e) for e in self.estimates},
            "products": {e.name: _to_builtins(e) for e in self.products},
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
            **({"fin_angle": self.fin_angle.to_builtins()} if self.fin_angle else {}),
        }

    def _line(self, name: str, value: float | str) -> str:
        if isinstance(value, str):
            return f"  {name}: {value}"
        if name not in UNITS:
            return f"  {name}: {_format_number(value)}"
        estimate = self[name]
        text = f"  {name}: {_format_number(_round(estimate))}"
        unit = "" if estimate.unit == "1" else f" {estimate.unit}"
        if not estimate.fitted:
            return f"{text}{unit and '  #' + unit}"
        if not math.isfinite(estimate.ci95_high):
            return f"{text}  # not identified{unit and ',' + unit}"
        return f"{text}  # {estimate.ci95_low:.5g} to {estimate.ci95_high:.5g}{unit}"


def _to_builtins(estimate: Estimate) -> dict[str, Any]:
    """Return an estimate for JSON, which has no infinity: an end that is withheld is None."""
    low, high = (
        end if math.isfinite(end) else None for end in (estimate.ci95_low, estimate.ci95_high)
    )
    plain: dict[str, Any] = {
        "value": estimate.value,
        "ci95_low": low,
        "ci95_high": high,
        "unit": estimate.unit,
    }
    if not estimate.fitted:
        plain["fitted"] = False
    if estimate.if_ratio_holds:
        plain["if_ratio_holds"] = list(estimate.if_ratio_holds)
    return plain


def _round(estimate: Estimate) -> float:
    """Return the value, rounded to 1 % of the width of its interval or better."""
    low, high = estimate.narrowest_interval
    width = high - low
    if not estimate.fitted or not 0.0 < width < math.inf:
        return estimate.value
    rounded = round(estimate.value, 2 - math.floor(math.log10(width)))
    # A positive parameter must not be rounded to zero.
    return rounded if rounded or low <= 0.0 else estimate.value


def _format_number(value: float) -> str:
    """Return a number with six digits, in a form that YAML reads as a number."""
    text = f"{value:.6g}"
    mantissa, letter, exponent = text.partition("e")
    return f"{mantissa}{'' if '.' in mantissa else '.0'}{letter}{exponent}" if letter else text
