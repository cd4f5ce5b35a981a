"""All steps of an adaptation in a row: identify, optimise, learn, compare.

A resumed adaptation does the same again. Its session has the finished swims of a live fish in its
log, and swims those of a simulated fish again. Fit and training, which take minutes, are kept.
"""

from collections.abc import Sequence
from pathlib import Path

from msgspec.structs import replace

from fishd.config import Config, Start
from fishd.core import text
from fishd.core.errors import FishdError
from fishd.core.experiments import CurvePoint
from fishd.core.swim_plan import MEAN_REST_S
from fishd.lab.compare.comparison import Standing
from fishd.lab.compare.contestants import Contestant
from fishd.lab.compare.figures import draw as draw_gaits
from fishd.lab.compare.live import LiveComparison
from fishd.lab.error_budget import estimate_thrust, format_fin_angle, format_thrust
from fishd.lab.experiment import Experiment, Progress
from fishd.lab.identification import experiment as swim_excitation
from fishd.lab.identification.figure import draw as draw_fit
from fishd.lab.optimise.figure import draw as draw_search
from fishd.lab.session import Session
from fishd.lab.simulation import simulate
from fishd.learning.adapt import steps
from fishd.learning.adapt.results import (
    FISH,
    POLICY,
    SQUARE,
    Adapted,
    Fitted,
    Rung,
    Trained,
    Wave,
)
from fishd.learning.adapt.verdict import judge
from fishd.learning.run_folder.figure import draw as draw_training

_BY_MEASUREMENT = "the fit is not used, the gaits are chosen by measurement alone"
_SIMULATED_FISH = 8
"""Number of fish of the cloud on which a gait is simulated."""


def adapt(
    session: Session,
    folder: Experiment,
    tank_time: float,
    training_steps: int,
    seed: int,
    show: Progress,
    pictures: Sequence[Path] = (),
) -> Adapted:
    """Adapt to one fish, from its first swim to the verdict.

    session: entered by the caller; the plant and the rig of its configuration are not used
    tank_time: time for all steps that need the fish, rests included [s]; at least 150, so that the
        excitation takes 30, the shortest time that a fit accepts
    training_steps: number of steps of the training
    pictures: files of the picture of the comparison; the other steps have theirs in the folder

    Raises `Unidentifiable`, `FishdError` where the tank time is used up, `Disturbed`, `NoDaemon`
    and `ConfigError`; earlier measurements are kept.
    """
    config = replace(session.read_config(), start=Start())

    def show_step(doing: str) -> None:
        show.at(session.used, doing)

    def done(line: str) -> None:
        show.done(line, session.used)

    def show_wave(wave: Wave) -> None:
        point = CurvePoint(
            wave.frequency, wave.thrust, wave.thrust_ci95, "frequency [Hz]", unit=session.unit
        )
        show.estimate([], point)

    def careful(*remarks: str) -> None:
        for remark in remarks:
            show.warn(f"fishctl: careful: {remark}")

    show_step("excitation")
    seconds = steps.BUDGET["excitation"] * tank_time
    table = swim_excitation(session, seconds)
    done(f"excitation: {seconds:.0f} s")

    show_step("fitting a model of the fish, which rests")

    def fit() -> Fitted:
        try:
            fish, fitted = steps.fit(table, session.servo, session.amplitude, seed)
        except FishdError:
            raise
        except (ArithmeticError, ValueError) as error:  # the numerics of a fit
            return steps.without_fit(f"the fit failed: {text.describe_error(error)}")
        folder.write(FISH, fish.to_yaml("fishctl adapt"))
        draw_fit(fish, folder.path / "fit.png")
        return fitted

    fitted = folder.once("fit.json", Fitted, fit)
    is_fitted = fitted.model.standard_error is not None
    report = fitted.identification
    explained = [f"{channel['explained']:.1%}" for channel in report.get("channels", {}).values()]
    done(f"fit: explains {' and '.join(explained)} of F_x and F_y" if explained else "fit: none")
    if not is_fitted:
        careful(f"{_BY_MEASUREMENT}: {report['headline']}")
    careful(*report["remarks"])

    show_step("swing --C auto")
    rung = steps.settle_swing(session, steps.BUDGET["swing"] * tank_time - MEAN_REST_S)
    lead = f", {rung.lead * 1e3:.0f} ms ahead" if rung.lead else ""
    unsure = "" if rung.is_finished else "; its search was not finished"
    done(f"swing --C auto: C = {rung.C:g}{lead}{unsure}")

    show_step("searching square waves")
    search = steps.square_waves(fitted, session, seed)
    budget = max(steps.BUDGET["search"] * tank_time, steps.min_search_time(session, search))
    waves = steps.search_square_waves(session, search, budget, show_wave)
    frequency, is_used = steps.best_of(search, waves, fitted, session.amplitude)
    draw_search([folder.path / "search.png"], search, search.propose(), {}, "thrust (mN)")
    is_rejected = is_fitted and not is_used
    basis = "in agreement with the fit" if is_used else "from these waves alone"
    basis = "they contradict the fit, which is not used" if is_rejected else basis
    tried = f"{len(waves)} trials of {len({wave.frequency for wave in waves})} square waves"
    done(f"search: {tried}; best at {frequency:.4g} Hz, {basis}")

    def train() -> Trained:
        if not is_fitted:
            return Trained(steps=0, refusal="the fit is not used")
        try:
            return steps.train_policy(config, fitted, folder.path, training_steps, seed, progress)
        except Exception as error:  # what the fish has swum is worth more than a training
            return Trained(steps=0, refusal=f"its training failed: {text.describe_error(error)}")

    def progress(count: int) -> None:
        repetition, step = divmod(count - 1, training_steps)
        number = f" (training {repetition + 1} of {steps.MAX_TRAININGS})" if repetition else ""
        show_step(f"training, {step + 1} of {training_steps} steps{number}; the fish rests")

    trained = folder.once("training.json", Trained, train)
    if trained.refusal and is_fitted:
        careful(f"no policy takes part: {trained.refusal}")
    elif trained.refusal:
        done(f"no policy is trained: {trained.refusal}")
    else:
        worst = trained.worst_relative_thrust
        on_worst = "" if worst is None else f", {worst:.1%} on the worst tried"
        cloud = f"{len(fitted.cloud)} fish within the errors of the fit"
        done(f"training on {cloud}: {trained.relative_thrust:.1%} in simulation{on_worst}")
        draw_training(folder.path / "training.png", folder.path / trained.folder)

    show_step("measuring the gaits")
    policy = None if trained.refusal else str((folder.path / POLICY).absolute())
    live = LiveComparison(session, list_gaits(rung, frequency, policy))
    live.swim(steps.share_time(tank_time - session.used, live.contestants))
    left_out = {gait.label: str(error) for gait, error, _ in live.left_out}
    gaits = live.standings()
    if SQUARE in left_out:
        raise FishdError(f"{SQUARE}: {left_out[SQUARE]}")
    for name, reason in left_out.items():
        show.warn(f"fishctl: {name}: left out: {reason}")
    for gait in gaits:
        show.estimate([estimate_thrust(g.contestant, g, session.unit) for g in gaits])
        fin = format_fin_angle(gait)
        done(
            f"{gait.contestant}: {format_thrust(gait, session.unit)} at {gait.frequency:.3f} Hz"
            + (f", largest fin angle {fin}" if fin else "")
        )
    for path in pictures:
        draw_gaits(path, gaits, live.traces(), session.amplitude, session.unit)
    for name, remark in live.remarks():
        show.warn(f"fishctl: {name}: {remark}")

    expected: dict[str, list[float]] = {}
    if is_fitted:
        try:
            expected = simulate_gaits(steps.simulated_config(config, fitted), fitted, gaits)
        except Exception as error:  # what the fish has swum is worth more than a simulation
            careful(
                f"{_BY_MEASUREMENT}: a simulation of the identified fish failed: "
                f"{text.describe_error(error)}"
            )
    model = replace(fitted.model, is_rejected=is_rejected)
    verdict = judge(gaits, model, expected)
    return Adapted(
        tank_time=session.used,
        fitted=replace(fitted, model=model),
        is_fit_rejected=is_rejected,
        swing=rung,
        waves=waves,
        trained=trained,
        gaits=gaits,
        left_out=left_out,
        expected_thrusts=expected,
        verdict=verdict.sentence,
        undecided=verdict.best,
    )


def list_gaits(rung: Rung, frequency: float, policy: str | None) -> list[Contestant]:
    """Return the gaits that take part in the comparison.

    rung: parameters of `swing`; frequency: that of the square wave [Hz]
    policy: path of the policy; None without one
    """
    swing = {"C": rung.C} | ({"lead": rung.lead} if rung.lead else {})
    gaits = [
        Contestant("swing", "swing", swing),
        Contestant(SQUARE, "square", {"frequency": frequency}),
    ]
    return [Contestant("policy", "ppo", {"policy": policy}), *gaits] if policy else gaits


def simulate_gaits(
    config: Config, fitted: Fitted, gaits: Sequence[Standing]
) -> dict[str, list[float]]:
    """Return thrusts of the gaits on the first fish of the cloud [N], by name."""
    fish = [replace(config, plant=plant) for plant in fitted.cloud[:_SIMULATED_FISH]]
    return {
        gait.contestant: [
            simulate(config, gait.controller, gait.parameters).mean_thrust for config in fish
        ]
        for gait in gaits
    }


def add_true_thrusts(adapted: Adapted, config: Config) -> Adapted:
    """Return the result with the true thrusts of the gaits of a simulated fish.

    The session must have ended: a virtual Pi can be open only once.
    """
    swims = {
        gait.contestant: simulate(config, gait.controller, gait.parameters)
        for gait in adapted.gaits
    }
    return replace(
        adapted,
        true_thrusts={name: swum.mean_thrust for name, swum in swims.items()},
        true_relative_thrusts={name: swum.relative_thrust for name, swum in swims.items()},
    )
