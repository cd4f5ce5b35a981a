"""What an adaptation has found so far, and the folder that keeps it from step to step."""

from typing import Any

from msgspec import Struct

from fishd.lab.experiment import Experiment
from fishd.virtual.imperfections import SimulationSettings
from fishd.virtual.plant.parameters import PlantParameters

STATE = "adapt.json"
FISH, POLICY, TRAINING = "fish.yaml", "policy.onnx", "training"
PICTURE, PAGE = "adapt.png", "adapt.html"


class Model(Struct, frozen=True, kw_only=True):
    """How far the identified fish can be used to choose among gaits."""

    explained: float
    """Share of the variance of a force that it explains; the smaller one of both forces."""
    error: float | None
    """Standard error of a thrust of it, as a fraction; None where it explains too little."""
    is_rejected: bool = False
    """Whether the square waves tried disagree with it."""


class Fitted(Struct, frozen=True, kw_only=True):
    """The fish that explains the forces best, and those that do nearly as well."""

    plant: PlantParameters
    rig: SimulationSettings
    offset: float
    """Half of the range in which the offset of F_y may be while the fish swims [N]."""
    cloud: tuple[PlantParameters, ...]
    model: Model
    found: dict[str, Any]
    """The estimates with their intervals, and remarks, as `fishctl identify --json` gives them."""


class Rung(Struct, frozen=True):
    """What `swing --C auto` has ended with."""

    C: float
    lead: float
    """[s]"""
    settled: bool
    """Was the search over?"""


class Tried(Struct, frozen=True):
    """A square wave of the search, as it was measured."""

    frequency: float
    """[Hz]"""
    thrust: float
    """[N]"""
    error: float
    """Half of its 95 % interval [N]."""
    swum: int
    """Ticks of swimming so far, in the search."""
    passed: float
    """Time since its beginning, rest included [s]."""


class Trained(Struct, frozen=True, kw_only=True):
    """How the policy did on the fish of the fit, or why there is none."""

    steps: int
    """Of all trainings."""
    folder: str = ""
    """Of the one that it is from."""
    relative_thrust: float | None = None
    """Over the best square wave of the identified fish."""
    worst: float | None = None
    """The same, of the worst fish of the cloud that were tried."""
    refused: str = ""
    """Why there is no policy, if so."""


class Contender(Struct, frozen=True, kw_only=True):
    """A gait, measured on the fish."""

    name: str
    """`policy`, `swing` or `square`"""
    controller: str
    parameters: dict[str, Any]
    thrust: float
    """[N]"""
    error: float
    """Half of its 95 % interval [N]."""
    calibration_ci95: float | None = None
    """Half-width of the 95 % interval that the calibration leaves to the thrust [N].

    The same fraction of all thrusts, so no part of a relative thrust; None where it is unknown.
    """
    total_ci95: float | None = None
    """Half-width of the 95 % interval by `error` and `calibration_ci95` together [N]."""
    frequency: float
    """[Hz]"""
    seconds: float
    """How long it was measured, rests included [s]."""
    remark: str = ""
    expected: list[float] = []
    """Thrust on fish of the cloud, the identified one first, in simulation [N]; empty where that
    is not used."""
    true_thrust: float | None = None
    """Of a simulated fish [N]."""
    true_relative_thrust: float | None = None
    """That over the thrust of the best of all square waves."""


class Verdict(Struct, frozen=True, kw_only=True):
    """Which gait is chosen, and why; relative thrusts are over the best square wave found."""

    chosen: str
    """The winner, or the one chosen from those between which it is undecided."""
    decided: bool
    """Whether the measurement alone says that it is the best one."""
    undecided: list[str]
    """Those that may be the best one, as far as the measurement tells, simplest first."""
    relative_thrust: float
    """Of the chosen one."""
    low: float
    """Lower end of its 95 % interval, which holds whichever gait is chosen."""
    high: float
    others: dict[str, tuple[float, float, float]]
    """Of each one but the square wave: relative thrust, and its interval."""
    claim: str
    """The same in a sentence."""


class State(Struct, kw_only=True):
    """What was found so far; what is None is still to be done."""

    tank_time: float = 0.0
    """Time in the tank so far, rests included, and what was measured in vain, too [s]."""
    spent: dict[str, float] = {}
    """Of that, what each step took [s]."""
    excitation: str | None = None
    """The recording that the fish is fitted to."""
    fitted: Fitted | None = None
    swing: Rung | None = None
    trials: list[Tried] = []
    """Square waves, as they were tried."""
    square: float | None = None
    """The frequency of the best of them [Hz]."""
    disagrees: bool = False
    """Whether the square waves tried disagree with the identified fish."""
    trained: Trained | None = None
    contenders: list[Contender] = []
    left_out: dict[str, str] = {}
    """Who could not be measured, and why."""
    verdict: Verdict | None = None


class AdaptFolder:
    """The folder of an adaptation, in which each step is kept as it is done, in `state`."""

    def __init__(self, experiment: Experiment) -> None:
        """Raises `ConfigError` where the state cannot be read."""
        self.path = experiment.path
        self.experiment = experiment
        self.state = experiment.read_struct(STATE, State) or State()

    def keep(self) -> None:
        """Write the state; raises `FishdError`."""
        self.experiment.write_struct(STATE, self.state)
