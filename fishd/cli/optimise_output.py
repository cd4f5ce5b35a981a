"""What `fishctl optimise` says: each candidate as it was measured, and the best in the end."""

from pathlib import Path
from typing import TYPE_CHECKING

from msgspec import Struct

from fishd.cli.output import counted, echo

if TYPE_CHECKING:
    from fishd.lab.optimise.search import Proposal
    from fishd.lab.optimise.trials import Trial


class Optimum(Struct, frozen=True):
    """What a search found, as a program reads it."""

    controller: str
    parameters: dict[str, float]
    low: dict[str, float]
    """The 95 % interval of each."""
    high: dict[str, float]
    thrust: float
    """[N]"""
    error: float
    """Half of its 95 % interval [N]."""
    improvement: float
    """Expected of another trial, as a share of the thrust."""
    trials: int
    ticks_swum: int
    seconds: float
    """In the tank, rest included [s]."""
    thinking: float | None = None
    """How long the fish of a robot waited besides while candidates were chosen, this time [s]."""
    true_thrust: float | None = None
    """There, of a simulated fish [N]."""
    efficiency: float | None = None
    """That over the thrust of the best square wave."""


def told(number: int, trial: "Trial", best: "Proposal | None", unit: str) -> str:
    """A line on a trial.

    best: what seems so, once there is enough to say it
    """
    measured = (
        f"{number}: {_spelled(trial.parameters)}: {trial.thrust * 1e3:.2f} ± "
        f"{trial.error * 1e3:.2f} m{unit}"
    )
    if best is None:
        return measured
    more = f"another may give {best.improvement:.1%} more"
    return f"{measured}; best so far {_spelled(best.parameters)}, {more}"


def _spelled(parameters: dict[str, float]) -> str:
    return " ".join(f"{name}={value:.4g}" for name, value in parameters.items())


def optimum_of(name: str, trials: int, last: "Trial", found: "Proposal") -> Optimum:
    """last: of these trials"""
    return Optimum(
        controller=name,
        parameters=found.parameters,
        low=found.low,
        high=found.high,
        thrust=found.thrust,
        error=found.error,
        improvement=found.improvement,
        trials=trials,
        ticks_swum=last.swum,
        seconds=last.passed,
    )


def say(found: Optimum, unit: str, units: dict[str, str], path: Path) -> None:
    """Show what was found; units: of the parameters, unit: of the force."""
    for name, value in found.parameters.items():
        symbol = "" if units[name] in ("", "1") else f" {units[name]}"
        interval = f"[{found.low[name]:.4g}, {found.high[name]:.4g}]"
        echo(f"best {name} of {found.controller}: {value:.4g}{symbol} {interval}")
    echo(f"thrust there: {found.thrust * 1e3:.2f} ± {found.error * 1e3:.2f} m{unit}")
    if found.true_thrust is not None:
        echo(
            f"true thrust there: {found.true_thrust * 1e3:.2f} mN, {found.efficiency:.1%} of the "
            "best square wave"
        )
    thinking = "" if found.thinking is None else f"; {found.thinking:.0f} s of thinking besides"
    echo(
        f"{counted(found.trials, 'candidate')}, {found.ticks_swum} ticks of swimming, "
        f"{found.seconds:.0f} s with the rests{thinking}"
    )
    echo(f"table: {path / 'trials.csv'}")
