"""The results of the steps of an adaptation."""

from typing import Any

from msgspec import Struct

from fishd.lab.compare.comparison import Standing
from fishd.virtual.imperfections import SimulationSettings
from fishd.virtual.plant.parameters import PlantParameters

FISH, POLICY, TRAINING = "fish.yaml", "policy.onnx", "training"
"""Files and folder of the identified fish, the policy and its training."""
SQUARE = "square"
"""Name of the gait with the best square wave tried."""


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


class Wave(Struct, frozen=True):
    """A square wave that was tried."""

    frequency: float
    """[Hz]"""
    thrust: float
    """[N]"""
    thrust_ci95: float
    """Half-width of the 95 % confidence interval of `thrust` [N]."""


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


class Adapted(Struct, frozen=True, kw_only=True):
    """The result of an adaptation; the fields are those of the JSON output."""

    tank_time: float
    """Time in the tank, rests included [s]."""
    fitted: Fitted
    is_fit_rejected: bool
    """Whether the square waves tried disagree with the identified fish."""
    swing: Rung
    waves: list[Wave]
    """Square waves in the order in which they were tried."""
    trained: Trained
    gaits: list[Standing]
    """Measured gaits: `policy`, `swing` and `square`."""
    left_out: dict[str, str]
    """Reason by name of each gait that could not be measured."""
    expected_thrusts: dict[str, list[float]]
    """By gait, simulated thrusts on fish of the cloud, the identified fish first [N].

    Empty where the cloud is not used.
    """
    true_thrusts: dict[str, float] = {}
    """By gait, the true thrust of a simulated fish [N]."""
    true_relative_thrusts: dict[str, float] = {}
    """The same, relative to the thrust of the best of all square waves."""
    verdict: str
    """The verdict in a sentence, without the full stop."""
    undecided: tuple[str, ...]
    """Names of the gaits that may be the best, the chosen one first."""

    @property
    def chosen(self) -> Standing:
        """The chosen gait."""
        return next(gait for gait in self.gaits if gait.contestant == self.undecided[0])
