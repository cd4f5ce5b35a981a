"""The steps of an adaptation: with the fish, then the training in simulation.

Excitation, swing's search and square waves need the fish; the policy is trained on the cloud of
fish that agree with the fit.
"""

import math
import shutil
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec
import numpy as np
from msgspec.structs import replace

from fishd.config import Config, ServoSettings, Start
from fishd.core.errors import FishdError, ParameterError, PolicyError
from fishd.core.swim_plan import MEAN_REST_S
from fishd.core.swim_plan import plan as plan_of
from fishd.lab.compare.contestants import Contestant
from fishd.lab.identification import DEFAULT, Identification, Unidentifiable, identify
from fishd.lab.identification.fit import BOUNDS, LOGARITHMIC
from fishd.lab.identification.result import RIG_PARAMETERS
from fishd.lab.optimise.search import Range, Search
from fishd.lab.optimise.trials import (
    Candidate,
    measure_trials,
    restrict_to_whole_ticks,
    trial_durations,
)
from fishd.lab.session import Session
from fishd.learning.adapt.prior import (
    combine,
    correlation_of_waves,
    deviations,
    is_rejected,
    model_of,
)
from fishd.learning.adapt.results import (
    POLICY,
    SQUARE,
    TRAINING,
    Fitted,
    Model,
    Rung,
    Trained,
    Wave,
)
from fishd.learning.export import export
from fishd.learning.settings import (
    EnvironmentSettings,
    EvaluationSettings,
    ImitationSettings,
    PpoSettings,
    Randomisation,
    TrainingSettings,
)
from fishd.learning.train.jobs import Job, Outcome
from fishd.learning.train.progress import Display
from fishd.learning.train.training import train
from fishd.virtual.imperfections import SimulationSettings
from fishd.virtual.plant.optimum import best_square_wave, square_wave, swims_forwards
from fishd.virtual.plant.parameters import PlantParameters

if TYPE_CHECKING:
    from pandas import DataFrame

FITTED = (*DEFAULT, "lateral_quadratic_drag", "servo_dead_zone", "servo_reaction")
"""Fitted parameters: all that a fit can find except slack, which backlash represents."""
MIN_EXPLAINED = 0.1
"""Smallest explained share of a force; below it for both, `adapt` ends: they are mostly noise."""
SEARCH_RATIO = 2.0
"""Factor of the search range of square waves, below and above the best of the identified fish."""
MIN_FREQUENCY_HZ, MAX_FREQUENCY_HZ = 0.3, 8.0
"""Bounds of the search of square waves, whatever the fit [Hz]."""
BUDGET = {"excitation": 0.2, "swing": 0.14, "search": 0.2}
"""Shares of the tank time; the comparison uses the remainder."""
CLOUD_SIZE, MIN_CLOUD_SIZE = 32, 8
"""Number of fish in the cloud, and the smallest number with which it is used."""
MAX_DRAWS = 20
"""Largest number of draws for each fish of the cloud."""
EPISODE = 128
"""Steps per episode; each episode swims one fish of the cloud."""
MAX_OFFSET_N = 10.0
"""Largest half-width of the range of the offset of F_y [N]."""
MAX_NOISE = 0.3
"""Largest noise of a tick in the training, as a share of the best thrust; more would hide the
reward."""
GOOD_MERIT, MAX_TRAININGS = 0.97, 3
"""Merit with which a policy is good enough, as a share of the best square wave on its worst fish;
and the largest number of trainings."""
IMITATION_ROUNDS, IMITATION_FISH = 2, 64
"""Rounds of imitation before PPO, and draws from the cloud in each round. PPO alone may stay at a
wave that is one tick too short or too long."""
EVALUATION_INTERVAL, OTHER_FISH = 5, 3
"""Updates per evaluation, and number of fish of the cloud evaluated beside the identified one."""


def fit(
    table: "DataFrame", servo: ServoSettings | None, amplitude: float, seed: int
) -> tuple[Identification, Fitted]:
    """Fit a fish to an excitation, without prior knowledge; return it and its cloud.

    table: ticks of the excitation
    servo: calibrated settings of the servo; None where commands need no pulses
    amplitude: Φ [rad]
    Raises `Unidentifiable`, also where the fit explains less than `MIN_EXPLAINED` of both forces.
    """
    identification = identify([table], fit=FITTED, servo=servo)
    explained = max(channel.explained for channel in identification.channels)
    if not explained >= MIN_EXPLAINED:
        raise Unidentifiable(
            f"the best fit explains {max(0.0, explained):.0%} of the forces only: they are mostly "
            "noise, or do not follow the commands; see fishctl plot and fishctl identify with "
            "--plot"
        )
    plant = identified_fish(identification)
    model = model_of(identification)
    cloud = draw_cloud(identification, amplitude, seed)
    if len(cloud) < MIN_CLOUD_SIZE or not swims_forwards(plant, amplitude):
        model = replace(model, standard_error=None)
    offset, drift = identification["offset_y"], identification.channels[1].drift
    fitted = Fitted(
        plant=plant,
        rig=msgspec.convert(identification.simulation, SimulationSettings),
        offset=min(MAX_OFFSET_N, max(offset.ci95_high - offset.value, 0.5 * drift)),
        cloud=cloud,
        model=model,
        identification=identification.to_builtins(),
    )
    return identification, fitted


def without_fit(reason: str) -> Fitted:
    """Return the result of a fit that failed, which is not used; reason: why it failed."""
    return Fitted(
        plant=PlantParameters(),
        rig=SimulationSettings(),
        offset=0.0,
        cloud=(),
        model=Model(explained_fraction=0.0, standard_error=None),
        identification={"headline": reason, "estimates": {}, "remarks": []},
    )


def settle_swing(session: Session, seconds: float) -> Rung:
    """Let `swing --C auto` search for `seconds`; return its final C and lead."""
    ticks = session.swim("swing", {"C": "auto"}, seconds)
    session.rest(MEAN_REST_S)
    end = ticks[len(ticks) // 2 :]
    shown = [tick.quantities for tick in end if tick.quantities]
    watching = [quantities for quantities in shown if not quantities["searching"]]
    # If the search is not over, the rung between the trials is the most frequent one.
    rungs = Counter(
        (quantities["criterion"], quantities["lead"]) for quantities in watching or shown
    )
    (criterion, lead), _ = rungs.most_common(1)[0]
    return Rung(criterion, lead, bool(watching))


def square_waves(fitted: Fitted, session: Session, seed: int) -> Search:
    """Return a search over square waves of whole ticks around the best of the identified fish.

    Where the fish explains too little, all frequencies are searched.
    """
    low, high = MIN_FREQUENCY_HZ, MAX_FREQUENCY_HZ
    if fitted.model.standard_error is not None:
        best = best_square_wave(fitted.plant, session.amplitude).frequency
        best = min(MAX_FREQUENCY_HZ / SEARCH_RATIO, max(MIN_FREQUENCY_HZ * SEARCH_RATIO, best))
        low, high = best / SEARCH_RATIO, best * SEARCH_RATIO
    high = min(high, 0.5 / session.tick)
    return Search([restrict_to_whole_ticks(Range("frequency", low, high), session.tick)], seed)


def search_square_waves(
    session: Session, search: Search, budget: float, tried: Callable[[Wave], None]
) -> list[Wave]:
    """Try square waves until the budget is used [s]; tried: called with each."""

    def choose(_: float) -> Candidate:
        return Candidate(search.suggest())

    waves = []
    for trial in measure_trials(session, SQUARE, {}, choose, budget):
        search.observe(trial.parameters, trial.thrust, trial.thrust_ci95)
        waves.append(Wave(trial.parameters["frequency"], trial.thrust, trial.thrust_ci95))
        tried(waves[-1])
    return waves


def best_of(
    search: Search, tried: Sequence[Wave], fitted: Fitted, amplitude: float
) -> tuple[float, bool]:
    """Return the frequency of the best square wave [Hz], and whether the identified fish is used.

    The curve of the identified fish is based on a whole excitation, so it is more exact than a few
    noisy trials. Its weight depends on how well it explains the forces. Where it explains too
    little, or the trials disagree with it, only the search is used.
    """
    frequencies = search.ranges[0].values
    if fitted.model.standard_error is not None:
        curves = np.array(
            [
                [square_wave(plant, amplitude, f).thrust for f in frequencies]
                for plant in fitted.cloud
            ]
        )
        spread = deviations(curves, fitted.model.standard_error, correlation_of_waves(frequencies))
        places = [int(np.argmin(np.abs(np.subtract(frequencies, t.frequency)))) for t in tried]
        measured = np.array([trial.thrust for trial in tried])
        ci95 = np.array([trial.thrust_ci95 for trial in tried])
        if not is_rejected(curves[0], spread, places, measured, ci95):
            thrusts, _ = combine(curves[0], spread, places, measured, ci95)
            return frequencies[int(np.argmax(thrusts))], True
    return search.propose().parameters["frequency"], False


def min_search_time(session: Session, search: Search) -> float:
    """Return the time of a search that tries the slowest wave once [s]."""
    return (
        2.0 * MEAN_REST_S
        + trial_durations({"frequency": search.ranges[0].values[0]})[1]
        + session.tick
    )


def share_time(left: float, gaits: Sequence[Contestant]) -> float:
    """Return the length of the measurement of each gait, rests included [s].

    left: time that is left of the tank time [s]
    Raises `FishdError` where it is too short.
    """
    try:
        for gait in gaits:
            plan_of(left / len(gaits), gait.parameters)
    except ParameterError as error:
        raise FishdError(
            f"{max(0.0, left):.0f} s are left of the tank time for {len(gaits)} gaits: {error}; a "
            "larger --budget is needed"
        ) from None
    return left / len(gaits)


def draw_cloud(
    identification: Identification, amplitude: float, seed: int = 0, count: int = CLOUD_SIZE
) -> tuple[PlantParameters, ...]:
    """Return fish that agree with the data; the first is the identified one itself.

    They are drawn from the joint normal distribution of the errors, of logarithms for parameters
    that are fitted as such. The errors include those of a misfit. Draws beyond a bound of the fit
    and fish that no square wave moves forwards are rejected, so there may be fewer than `count`;
    but a parameter that is 0 or more may be 0.
    amplitude: Φ [rad]
    K_y/K is that of the identified fish: no force depends on it as long as the parameters that it
    scales change with it.
    """
    centre = [_mean_of_draws(identification, name) for name in identification.names]
    chance = np.random.default_rng(seed)
    fitted = identified_fish(identification)
    fish = [fitted]
    for _ in range(MAX_DRAWS):
        draws = chance.multivariate_normal(
            centre, identification.covariance, count - 1, method="eigh", check_valid="ignore"
        )
        drawn = (_fish(fitted, identification.names, z.tolist()) for z in draws)
        fish += [plant for plant in drawn if plant and swims_forwards(plant, amplitude)]
        if len(fish) >= count:
            break
    return tuple(fish[:count])


def identified_fish(identification: Identification) -> PlantParameters:
    """Return the identified fish."""
    return msgspec.convert(identification.plant, PlantParameters)


def _mean_of_draws(identification: Identification, name: str) -> float:
    """Return the mean of a fitted parameter, or of its logarithm if that is fitted."""
    value = identification[name].value
    return float(np.log(value)) if name in LOGARITHMIC else value


def _fish(
    fitted: PlantParameters, names: tuple[str, ...], z: list[float]
) -> PlantParameters | None:
    """Return a drawn fish; None for one beyond the bounds."""
    drawn = {}
    for name, value in zip(names, z, strict=True):
        is_logarithm = name in LOGARITHMIC
        low, high = map(math.log, BOUNDS[name]) if is_logarithm else BOUNDS[name]
        bounded = max(low, value) if low == 0.0 and not is_logarithm else value
        if not low <= bounded <= high:
            return None
        if name not in RIG_PARAMETERS:
            drawn[name] = math.exp(bounded) if is_logarithm else bounded
    return replace(fitted, **drawn)


def training_settings(fitted: Fitted, steps: int, seed: int) -> TrainingSettings:
    """Return the settings of the training."""
    return TrainingSettings(
        steps=steps,
        seed=seed,
        checkpoint_every=max(1, steps),
        environment=EnvironmentSettings(episode=EPISODE),
        randomisation=Randomisation(fish=fitted.cloud, offset=fitted.offset),
        imitation=ImitationSettings(rounds=IMITATION_ROUNDS, fish=IMITATION_FISH),
        ppo=PpoSettings(decay_steps=max(1, steps)),
        evaluation=EvaluationSettings(every=EVALUATION_INTERVAL, others=OTHER_FISH, patience=None),
    )


def simulated_config(config: Config, fitted: Fitted) -> Config:
    """Return the configuration of the identified fish on its rig, with the real fish's loop."""
    best = best_square_wave(fitted.plant, config.amplitude_limit).thrust
    rig = replace(fitted.rig, noise=min(fitted.rig.noise, MAX_NOISE * best))
    return replace(config, robot="simulated", plant=fitted.plant, simulation=rig, start=Start())


def train_policy(
    config: Config,
    fitted: Fitted,
    folder: Path,
    steps: int,
    seed: int,
    progress: Callable[[int], None],
) -> Trained:
    """Train, and write the policy that did best on its worst fish into the folder.

    Where its merit is less than `GOOD_MERIT`, the training is repeated with the next seed. There
    are at most `MAX_TRAININGS` trainings, and the best of all policies is taken.

    config: tick, Φ and limits of the fish; its plant and rig are not used
    folder: folder of the adaptation; an interrupted training in it is restarted
    progress: called with the number of finished steps
    """
    best: Outcome | None = None
    display = _Steps(progress)
    message = "it swam in no evaluation"
    for index in range(MAX_TRAININGS):
        place = folder / (TRAINING if index == 0 else f"{TRAINING}-{index + 1}")
        if place.exists():
            shutil.rmtree(place)
        task = training_settings(fitted, steps, (seed + index) % 2**32)
        outcome = train(
            Job(config=simulated_config(config, fitted), settings=task, folder=place), display
        )
        message = outcome.message or message
        if outcome.best and (best is None or _merit(outcome) > _merit(best)):
            best = outcome
        if best and _merit(best) >= GOOD_MERIT:
            break
    if best is None or best.best is None or best.best_evaluation is None:
        return Trained(steps=display.steps, refusal=f"the training gave no policy: {message}")
    try:
        export(best.best, folder / POLICY, note="of fishctl adapt")
    except PolicyError as error:
        return Trained(steps=display.steps, refusal=str(error))
    evaluation = best.best_evaluation
    return Trained(
        steps=display.steps,
        folder=best.folder.name,
        relative_thrust=evaluation.relative_thrust,
        worst_relative_thrust=evaluation.lowest_relative_thrust,
    )


def _merit(outcome: Outcome) -> float:
    return outcome.best_evaluation.merit if outcome.best_evaluation else 0.0


class _Steps(Display):
    """A display that counts the steps of all trainings."""

    def __init__(self, progress: Callable[[int], None]) -> None:
        self._progress = progress
        self.steps = 0

    def step(self, tank_time: float) -> None:
        """Count one step."""
        self.steps += 1
        self._progress(self.steps)
