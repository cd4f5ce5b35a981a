"""The contestants of a comparison: controllers with parameters, and policies."""

from collections.abc import Iterable
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

from msgspec.structs import replace

from fishd.camera.simulated import SimulatedCameraSettings, SimulatedSight
from fishd.config import Config
from fishd.controllers import registry
from fishd.controllers.base import Controller, Limits
from fishd.controllers.policy import file, library
from fishd.controllers.policy.controller import PpoParameters
from fishd.controllers.policy.runtime import Pilot
from fishd.core import files
from fishd.core.errors import FishdError, ParameterError, PolicyError, UnknownController
from fishd.core.schema import names_file, parse_value, suggest
from fishd.core.signals import Observation
from fishd.lab.simulation import VirtualRun
from fishd.lab.sweep.grid import expand_values
from fishd.virtual.plant.optimum import SteadyState, square_wave

_FREQUENCY_RANGE_HZ = (0.2, 10.0)
"""Range of the search for the best square wave on the grid of ticks [Hz]."""


def sees_pictures(policy: Any, limits: Limits) -> bool:
    """Return whether a policy sees pictures; False for one that does not fit, which `ppo` rejects.

    policy: name or path of the policy
    """
    try:
        return (
            isinstance(policy, str)
            and library.open_policy(policy, limits).card.pictures is not None
        )
    except PolicyError:
        return False


def may_see_pictures(policy: Any) -> bool:
    """Return whether a policy sees pictures or cannot be read here.

    policy: name or path of the policy
    """
    try:
        return isinstance(policy, str) and file.read(library.find(policy)).card.pictures is not None
    except PolicyError:
        return True


class SeeingController(Controller[PpoParameters]):
    """The controller `ppo` for a policy that sees pictures, with a simulated camera."""

    Parameters = PpoParameters

    def __init__(
        self, parameters: PpoParameters, limits: Limits, camera: SimulatedCameraSettings
    ) -> None:
        """Raises `PolicyError`."""
        super().__init__(parameters, limits)
        self._pilot = Pilot(parameters.policy, limits)
        self._camera = camera
        self._sight: SimulatedSight | None = None

    def watch(self, run: VirtualRun) -> None:
        """Connect the simulated camera to the fish of a run, before its first tick."""
        truth, pictures = run.loop.robot.truth, self._pilot.card.pictures
        assert truth
        assert pictures
        self._sight = SimulatedSight(self._camera, pictures, self.limits.tick, truth)

    def update(self, observation: Observation) -> float:
        """Return the angle of the policy [rad]; raises `ControllerFault`, see `DwellLimit`."""
        stack = self._sight.look(observation.time) if self._sight else None
        return self._pilot.angle(observation, stack)


class Contestant(NamedTuple):
    """A controller with its parameters, and its label in results."""

    label: str
    controller: str
    parameters: dict[str, Any]


def parse(text: str) -> Contestant:
    """Return the contestant for a text, as in `swing:C=0.6` or `square:frequency=2,amplitude=0.3`.

    The text may also be the name of a policy or a policy file. Raises `ParameterError`.
    """
    name = text.partition(":")[0]
    if name == "remote":
        raise ParameterError(
            "remote: its agent is another program; compare policies or other controllers"
        )
    if name not in registry.names():
        if not (names_file(text, library.SUFFIX) or text in library.names()):
            if run := library.describe_training_folder(Path(text)):
                raise ParameterError(f"{text} {run}")
            comparable = [controller for controller in registry.names() if controller != "remote"]
            files = [f"{text}{library.SUFFIX}"] if Path(f"{text}{library.SUFFIX}").is_file() else []
            hint = suggest(name, files or [*comparable, *library.names()])
            raise ParameterError(
                f"'{name}' is not a controller, named policy or {library.SUFFIX} file; {hint}"
            )
        return Contestant(text, "ppo", {"policy": text})
    fields = {field.name: field for field in registry.describe(name).parameters}
    parameters = {}
    for key, value in registry.split_spec(text)[1]:
        try:
            parameters[key] = parse_value(fields[key], value) if key in fields else value
        except ValueError as error:
            raise ParameterError(f"{text}: {key}: {error}") from None
    return Contestant(text, name, parameters)


def parse_all(texts: Iterable[str]) -> list[Contestant]:
    """Return the contestants for texts, one for each value of a list or a range of numbers.

    `square:frequency=1.2:2:0.4` are three contestants. Raises `ParameterError`.
    """
    specs = dict.fromkeys(spec for text in texts for spec in _expand(text))
    return [parse(spec) for spec in specs]


def _expand(text: str) -> list[str]:
    """Return the texts of all combinations of the values in a text."""
    name = text.partition(":")[0]
    if name not in registry.names():
        return [text]
    numbers = {field.name for field in registry.describe(name).parameters if field.kind == "number"}
    choices = []
    for key, value in registry.split_spec(text)[1]:
        try:
            items = expand_values(value) if key in numbers else [value]
        except ParameterError as error:
            raise ParameterError(f"{text}: {key}: {error}") from None
        choices.append([f"{key}={item}" for item in items])
    return [":".join(filter(None, (name, ",".join(pairs)))) for pairs in product(*choices)]


def absolute(contestant: Contestant) -> Contestant:
    """Return the contestant with an absolute path of its policy file, for a fishd elsewhere."""
    policy = contestant.parameters.get("policy")
    if not (isinstance(policy, str) and names_file(policy, library.SUFFIX)):
        return contestant
    parameters = {**contestant.parameters, "policy": str(files.expand_user(policy).absolute())}
    return contestant._replace(parameters=parameters)


def is_missing(contestant: Contestant) -> bool:
    """Return whether the policy is a path at which this machine has no file."""
    policy = contestant.parameters.get("policy")
    if not (isinstance(policy, str) and names_file(policy, library.SUFFIX)):
        return False
    return not files.expand_user(policy).is_file()


def best_on_grid(config: Config) -> SteadyState:
    """Return the best square wave whose half periods are whole ticks.

    Only waves that alternate between two half periods can be better in a loop.
    """
    lowest, highest = _FREQUENCY_RANGE_HZ
    fewest = max(1, round(0.5 / highest / config.tick))
    most = max(fewest, round(0.5 / lowest / config.tick))
    waves = (
        square_wave(config.plant, config.amplitude_limit, 0.5 / (ticks * config.tick))
        for ticks in range(fewest, most + 1)
    )
    return max(waves, key=lambda wave: wave.thrust)


def default_contestants(config: Config) -> list[Contestant]:
    """Return the best square wave on the grid of ticks, `swing`, and the fitting named policies."""
    best = best_on_grid(config).frequency
    contestants = [
        Contestant(f"square:frequency={best:.6g}", "square", {"frequency": best}),
        Contestant("swing", "swing", {}),
    ]
    policies = (Contestant(name, "ppo", {"policy": name}) for name in library.names())
    contestants += [policy for policy in policies if not refusal(config, policy)]
    return contestants


def build(
    contestant: Contestant, limits: Limits, camera: SimulatedCameraSettings
) -> Controller[Any]:
    """Return the controller; for a policy that sees pictures, one that needs a camera.

    Raises `ParameterError`, `PolicyError` and `UnknownController`.
    """
    name, parameters = contestant.controller, contestant.parameters
    if name == "ppo" and sees_pictures(parameters.get("policy"), limits):
        return SeeingController(PpoParameters(policy=parameters["policy"]), limits, camera)
    return registry.create(name, parameters, limits)


def refusal(config: Config, contestant: Contestant) -> FishdError | None:
    """Return the error for a contestant that cannot swim the fish of `config`, else None."""
    limits = replace(config.limits, virtual=True)
    try:
        build(contestant, limits, SimulatedCameraSettings()).close()
    except (ParameterError, PolicyError, UnknownController) as error:
        return error
    return None
