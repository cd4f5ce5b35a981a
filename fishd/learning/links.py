"""Opens the link to what swims, and makes sure that the agent's scales fit it."""

import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import msgspec

from fishd.client import Fish
from fishd.config import Config, adopt, load
from fishd.errors import ConfigError
from fishd.learning.in_process import InProcess
from fishd.learning.link import Link
from fishd.learning.settings import Randomisation, TrainingSettings


def in_process(config: Config, settings: TrainingSettings) -> InProcess:
    """A simulated fish in this process; a new one each episode where fish are to differ."""
    varied = settings.randomisation != Randomisation()
    return InProcess(config, settings.randomisation if varied else None)


def on_daemon(endpoint: str | None, agent: str | None = None) -> Link:
    """The fish of a running fishd, which reaches this agent there; raises `FishError`."""
    from fishd.learning.on_daemon import OnDaemon

    return OnDaemon(endpoint, address=agent)


def daemon_config(endpoint: str | None, file: Path | None, overrides: Iterable[str]) -> Config:
    """The configuration for a training on a running fishd: its own, unless a file is given.

    Raises `ConfigError` and `FishError`.
    """
    if file is not None:
        return load(file, overrides)
    with Fish(endpoint) as fish:
        return adopt(fish.config(), overrides)


def other_plant(endpoint: str | None, config: Config) -> str:
    """Where the plant that the scales are made for is not the one of fishd; empty if it is.

    Raises `FishError`.
    """
    with Fish(endpoint) as fish:
        theirs: dict[str, Any] = fish.config()["plant"]
    ours: dict[str, Any] = msgspec.to_builtins(config.plant)
    return ", ".join(
        f"plant.{key} is {value!r} here, {theirs.get(key)!r} there"
        for key, value in ours.items()
        if theirs.get(key) != value
    )


def check_agreement(link: Link, config: Config) -> None:
    """Raise `ConfigError` where what swims has another tick or Φ than the scales are made for."""
    for key, here, there, unit in (
        ("tick", config.tick, link.tick, "s"),
        ("amplitude_limit", config.amplitude_limit, link.amplitude, "rad"),
    ):
        if not math.isclose(here, there, rel_tol=1e-9):
            raise ConfigError(
                f"{key}: {here:g} {unit} in this configuration, {there:g} {unit} in the fishd that "
                "runs; what the network sees is scaled by it, so give the file that fishd was "
                "started with, or none"
            )
