"""Warnings about values of parameters that are valid, but more than the fish can do."""

from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Any

from fishd.cli.output import echo
from fishd.core.errors import FishdError
from fishd.core.schema import Field, ask_for_unit, find_doubts, format_quantity, is_valid_number

if TYPE_CHECKING:
    from fishd.client import Fish
    from fishd.config import Config


def warn_of_values(
    fields: Iterable[Field],
    parameters: Mapping[str, Any],
    config: "Callable[[], Config | None]",
) -> None:
    """Print a line for each value far beyond what makes sense, on standard error.

    parameters: a value for each name, or several values
    config: reads the configuration of the fish, or returns None if its forces are in another unit;
        only called if a parameter is a force, which the fish has to produce
    """
    fields = list(fields)
    largest = {name: _largest_value(value) for name, value in parameters.items()}
    forces = [force for force in fields if force.unit == "N" and is_valid_number(largest, force)]
    beyond = _compare_with_best(forces, largest, config) if forces else {}
    lines = list(beyond.values())
    lines += find_doubts(largest, (field for field in fields if field.name not in beyond))
    for line in lines:
        echo(f"fishctl: careful: {line}", err=True)


def running_config(fish: "Fish") -> "Config | None":
    """Return the configuration of a running fishd; None if its forces are not in newtons."""
    from fishd.config import adopt

    return adopt(fish.config()) if fish.status().force_unit == "N" else None


def _largest_value(value: Any) -> Any:
    if not isinstance(value, list | tuple):
        return value
    return max((item for item in value if isinstance(item, int | float)), default=None)


def _compare_with_best(
    forces: list[Field], values: Mapping[str, Any], read_config: "Callable[[], Config | None]"
) -> dict[str, str]:
    """Return a sentence for each force that is more than the best square wave's thrust."""
    from fishd.virtual.plant.optimum import best_square_wave

    try:
        config = read_config()
    except FishdError:  # the verb itself reports it
        return {}
    if config is None or not config.kind.is_tethered:
        return {}
    best = best_square_wave(config.plant, config.amplitude_limit).thrust
    return {
        field.name: (
            f"{field.name}: {format_quantity(values[field.name], 'N')} is "
            f"{values[field.name] / best:.3g} times the best thrust known: the best square wave of "
            f"the configured fish gives {best:.3g} N, {1e3 * best:.3g} mN"
            + (
                f" ({ask_for_unit(values[field.name], 'N')})"
                if values[field.name] > 2 * best
                else ""
            )
        )
        for field in forces
        if 0.0 < best < values[field.name]
    }
