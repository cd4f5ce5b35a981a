"""The results of an adaptation, and the folder that keeps them from step to step."""

from typing import Any

from msgspec import Struct

from fishd.lab.experiment import Experiment
from fishd.virtual.imperfections import SimulationSettings
from fishd.virtual.plant.parameters import PlantParameters

STATE = "adapt.json"
FISH, POLICY, TRAINING = "fish.yaml", "policy.onnx", "training"
PICTURE, PAGE = "adapt.png", "adapt.html"


class Model(Struct, frozen=True, kw_only=True):
    """The quality of the identified fish as a model for the choice among gaits."""

    explained_fraction: float
    """Share of the variance of a force that the model explains; the smaller of both forces."""
    standard_error: float | None
    """Standard error of a thrust of the model, as a fraction; None if it explains too little."""
    is_rejected: bool = False
    """Whether the square waves tried disagree with the model."""


class Fitted(Struct, frozen=True, kw_only=True):
    """The fish that explains the forces best, and fish that explain them nearly as well."""

    plant: PlantParameters
    rig: SimulationSettings
    offset: float
    """Half-width of the range of the offset of F_y while the fish swims [N]."""
    cloud: tuple[PlantParameters, ...]
    model: Model
    identification: dict[str, Any]
    """The estimates with their intervals, and remarks, as `fishctl identify --json` gives them."""


class Rung(Struct, frozen=True):
    """The final parameters of `swing --C auto`."""

    C: float
    lead: float
    """Lead time [s]."""
    is_finished: bool
    """Whether the search was over."""


class Tried(Struct, frozen=True):
    """The measurement of one square wave of the search."""

    frequency: float
    """[Hz]"""
    thrust: float
    """[N]"""
    thrust_ci95: float
    """Half-width of the 95 % confidence interval of `thrust` [N]."""
    swim_ticks: int
    """Ticks of swimming since the beginning of the search."""
    tank_time: float
    """Time since the beginning of the search, rests included [s]."""


class Trained(Struct, frozen=True, kw_only=True):
    """The result of the policy on the identified fish, or the reason why it is missing."""

    steps: int
    """Number of steps of all trainings."""
    folder: str = ""
    """Folder of the training that the policy is from."""
    relative_thrust: float | None = None
    """Thrust relative to the best square wave of the identified fish."""
    worst_relative_thrust: float | None = None
    """Relative thrust on the worst of the tried fish of the cloud."""
    refusal: str = ""
    """Reason why a policy is missing; empty if there is one."""


class Contender(Struct, frozen=True, kw_only=True):
    """A gait, measured on the fish."""

    name: str
    """`policy`, `swing` or `square`"""
    controller: str
    parameters: dict[str, Any]
    thrust: float
    """[N]"""
    thrust_ci95: float
    """Half-width of the 95 % confidence interval of `thrust` [N]."""
    calibration_ci95: float | None = None
    """Half-width of the 95 % interval of `thrust` due to the calibration of the sensor [N].

    It is the same fraction of all thrusts, so it does not affect a relative thrust. None if it is
    unknown.
    """
    total_ci95: float | None = None
    """Half-width of the 95 % interval from `thrust_ci95` and `calibration_ci95` together [N]."""
    frequency: float
    """[Hz]"""
    seconds: float
    """Length of the measurement, rests included [s]."""
    remark: str = ""
    expected_thrusts: list[float] = []
    """Simulated thrusts on fish of the cloud, the identified fish first [N]; empty where the
    cloud is not used."""
    true_thrust: float | None = None
    """True thrust, known only of a simulated fish [N]."""
    true_relative_thrust: float | None = None
    """`true_thrust` relative to the thrust of the best of all square waves."""


class Verdict(Struct, frozen=True, kw_only=True):
    """The chosen gait and the reason; thrusts are relative to the best square wave found."""

    chosen_gait: str
    """Name of the winner, or of the gait chosen from `undecided_gaits`."""
    is_decided: bool
    """Whether the measurement alone shows that `chosen_gait` is the best gait."""
    undecided_gaits: list[str]
    """Names of the gaits that may be the best according to the measurement, simplest first."""
    relative_thrust: float | None
    """Relative thrust of the chosen gait; None if the square wave hardly thrusts."""
    relative_thrust_ci95_low: float | None
    """Lower end of the 95 % interval of `relative_thrust`, valid whichever gait is chosen."""
    relative_thrust_ci95_high: float | None
    relative_thrusts: dict[str, tuple[float, float, float]]
    """Relative thrust, and its interval, of each gait except the square wave."""
    claim: str
    """The verdict in one or more sentences, without the last full stop."""


class State(Struct, kw_only=True, forbid_unknown_fields=True):
    """The results of the finished steps; a field that is None belongs to a step still to do."""

    tank_time: float = 0.0
    """Time spent in the tank, rests and failed measurements included [s]."""
    step_times: dict[str, float] = {}
    """Time in the tank by step [s]."""
    excitation: str | None = None
    """Name of the recording that the fish is fitted to."""
    fitted: Fitted | None = None
    swing: Rung | None = None
    trials: list[Tried] = []
    """Square waves in the order in which they were tried."""
    square: float | None = None
    """Frequency of the best square wave [Hz]."""
    is_fit_rejected: bool = False
    """Whether the square waves tried disagree with the identified fish."""
    trained: Trained | None = None
    contenders: list[Contender] = []
    exclusions: dict[str, str] = {}
    """Reason by name of each gait that could not be measured."""
    verdict: Verdict | None = None


class AdaptFolder:
    """The folder of an adaptation, which stores the result of each finished step in `state`."""

    def __init__(self, experiment: Experiment) -> None:
        """Read the state; raises `ConfigError` where that fails."""
        self.path = experiment.path
        self.experiment = experiment
        self.state = experiment.read_struct(STATE, State) or State()

    def save(self) -> None:
        """Write the state; raises `FishdError`."""
        self.experiment.write_struct(STATE, self.state)
