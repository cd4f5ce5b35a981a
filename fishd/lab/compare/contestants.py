"""Who takes part in a comparison: controllers with parameters, and policies."""

from pathlib import Path
from typing import Any, NamedTuple

from msgspec.structs import replace

from fishd.camera.simulated.settings import SimulatedCameraSettings
from fishd.config import Config
from fishd.controllers import registry
from fishd.controllers.base import Controller, Limits
from fishd.controllers.policy import library
from fishd.controllers.policy.controller import PpoParameters
from fishd.core import files, strict_yaml
from fishd.core.errors import FishdError, ParameterError, PolicyError, UnknownController
from fishd.core.schema import names_file, nearest
from fishd.lab.compare.seeing import SeeingController, sees_pictures
from fishd.virtual.plant.optimum import SteadyState, square_wave

_GRID_HZ = (0.2, 10.0)
"""Whole-tick square waves are sought between these frequencies."""


class Contestant(NamedTuple):
    """A controller with its parameters, and what people call it."""

    label: str
    controller: str
    parameters: dict[str, Any]


def parse(text: str) -> Contestant:
    """`swing:C=0.6`, `square:frequency=1.7,amplitude=0.3`, the name of a policy, a policy file.

    Raises `ParameterError`.
    """
    name = text.partition(":")[0]
    if name == "remote":
        raise ParameterError(
            "remote: its agent is another program, which can swim a fishd but not be compared here"
        )
    if name not in registry.names():
        if not (names_file(text, library.SUFFIX) or text in library.names()):
            if run := library.of_run(Path(text)):
                raise ParameterError(f"{text} {run}")
            able = [known for known in registry.names() if known != "remote"]
            files = [f"{text}{library.SUFFIX}"] if Path(f"{text}{library.SUFFIX}").is_file() else []
            hint = nearest(name, files or [*able, *library.names()])
            raise ParameterError(
                f"'{name}' is not a controller, named policy or {library.SUFFIX} file; {hint}"
            )
        return Contestant(text, "ppo", {"policy": text})
    parameters = {}
    for key, value in registry.split_spec(text)[1]:
        try:
            parameters[key] = strict_yaml.parse(value, key).data
        except strict_yaml.YamlProblem as problem:
            raise ParameterError(f"{text}: {problem}") from None
    return Contestant(text, name, parameters)


def absolute(contestant: Contestant) -> Contestant:
    """The same, whose policy file is found from any folder: that of a fishd may be another."""
    policy = contestant.parameters.get("policy")
    if not (isinstance(policy, str) and names_file(policy, library.SUFFIX)):
        return contestant
    found = {**contestant.parameters, "policy": str(files.expanded(policy).absolute())}
    return contestant._replace(parameters=found)


def is_missing(contestant: Contestant) -> bool:
    """Is it a path at which this machine has no file, such as a misspelt one or a run folder?"""
    policy = contestant.parameters.get("policy")
    if not (isinstance(policy, str) and names_file(policy, library.SUFFIX)):
        return False
    return not files.expanded(policy).is_file()


def best_on_grid(config: Config) -> SteadyState:
    """The best square wave whose half periods are whole ticks.

    No waveform in a loop does better, but for waves that alternate between two half periods.
    """
    lowest, highest = _GRID_HZ
    fewest = max(1, round(0.5 / highest / config.tick))
    most = max(fewest, round(0.5 / lowest / config.tick))
    waves = (
        square_wave(config.plant, config.amplitude_limit, 0.5 / (ticks * config.tick))
        for ticks in range(fewest, most + 1)
    )
    return max(waves, key=lambda wave: wave.thrust)


def default_contestants(config: Config) -> list[Contestant]:
    """The best square wave on the grid of ticks, `swing`, and the named policies that fit."""
    best = best_on_grid(config).frequency
    found = [
        Contestant(f"square {best:.3f} Hz", "square", {"frequency": best}),
        Contestant("swing", "swing", {}),
    ]
    policies = (Contestant(name, "ppo", {"policy": name}) for name in library.names())
    found += [policy for policy in policies if not refusal(config, policy)]
    return found


def build(
    contestant: Contestant, limits: Limits, camera: SimulatedCameraSettings
) -> Controller[Any]:
    """Its controller; of a policy that sees, one that a camera is to be put above its fish for.

    Raises `ParameterError`, `PolicyError` and `UnknownController`.
    """
    name, parameters = contestant.controller, contestant.parameters
    if name == "ppo" and sees_pictures(parameters.get("policy"), limits):
        return SeeingController(PpoParameters(policy=parameters["policy"]), limits, camera)
    return registry.create(name, parameters, limits)


def refusal(config: Config, contestant: Contestant) -> FishdError | None:
    """Why one cannot swim the fish of `config`, such as a policy for another amplitude, or None."""
    limits = replace(config.limits, virtual=True)
    try:
        build(contestant, limits, SimulatedCameraSettings()).close()
    except (ParameterError, PolicyError, UnknownController) as error:
        return error
    return None
