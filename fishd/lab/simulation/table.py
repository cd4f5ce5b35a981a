"""A run in virtual time as a table, for notebooks."""

import os
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import msgspec

from fishd.config import Config, adopt, load
from fishd.core.dataframes import ticks_to_frame
from fishd.lab.simulation.virtual_run import KeepingPublisher, VirtualRun, check_length

if TYPE_CHECKING:
    from pandas import DataFrame


def run(
    config: Config | str | os.PathLike[str] | None = None,
    controller: str = "swing",
    parameters: Mapping[str, Any] | None = None,
    seconds: float = 60.0,
    *,
    overrides: Mapping[str, Any] | None = None,
) -> "DataFrame":
    """Swim a simulated fish with a controller; return its ticks as a table, see `ticks_to_frame`.

    config: path of a YAML file, or result of `fishd.config.load`; None for the defaults
    overrides: values by dotted key, such as `{"plant.xi": 0.9}`

    A controller that fails ends in mode `fault`, as on a robot: the column `mode` says so.
    Raises `ConfigError`, `UnknownController`, `ParameterError`, and `MissingPackage` without
    pandas (extra: lab).
    """
    check_length("run", seconds)
    settings = [f"{key}={_to_yaml(value)}" for key, value in (overrides or {}).items()]
    if isinstance(config, Config):
        config = adopt(msgspec.to_builtins(config), settings) if settings else config
    else:
        config = load(config, settings)
    publisher = KeepingPublisher()
    with VirtualRun(config, publisher) as virtual:
        virtual.set_controller(controller, parameters or {})
        for _ in range(max(1, round(seconds / config.tick))):
            virtual.tick()
    return ticks_to_frame(publisher.ticks)


def _to_yaml(value: Any) -> str:
    """Return a value, possibly a numpy number, as YAML text."""
    return msgspec.json.encode(value.item() if hasattr(value, "item") else value).decode()
