"""All steps of an adaptation in order; each is done once, and its result is stored."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

from msgspec.structs import replace

from fishd.config import Config, Start
from fishd.core import text
from fishd.core.errors import FishdError, RecordingError
from fishd.lab import error_budget
from fishd.lab.experiment import Progress
from fishd.lab.identification import experiment
from fishd.lab.measurement import measure
from fishd.lab.session import Session, concerns_one_controller
from fishd.lab.simulation import simulate
from fishd.lab.swim_plan import MEAN_REST_S
from fishd.learning.adapt import steps as do
from fishd.learning.adapt.state import (
    FISH,
    POLICY,
    AdaptFolder,
    Contender,
    Model,
    State,
    Trained,
    Tried,
)
from fishd.learning.adapt.steps import MAX_TRAININGS, simulated_config, train_policy
from fishd.learning.adapt.verdict import SQUARE, judge


class Gait(NamedTuple):
    """A gait that takes part in the comparison."""

    name: str
    controller: str
    parameters: dict[str, Any]


class Adaptation:
    """The adaptation to one fish, from its first swim to the verdict."""

    def __init__(
        self,
        session: Session,
        run: AdaptFolder,
        tank_time: float,
        steps: int,
        seed: int,
        show: Progress,
    ) -> None:
        """
        session: entered by the caller; the plant and the rig of its configuration are not used
        tank_time: time for all steps that need the fish, rests included [s]; at least
            150, so that the excitation takes 30, the shortest time that a fit accepts
        steps: number of steps of the training
        """
        self._session = session
        self._config = replace(session.read_config(), start=Start())
        self._run = run
        self._tank_time = tank_time
        self._steps = steps
        self._seed = seed
        self._show = show
        self._doing = ""
        session.used = run.state.tank_time
        session.progress = lambda used: show.at(used, self._doing)

    def run(self) -> State:
        """Do the steps that are not done yet.

        Raises `Unidentifiable`, `FishdError` where the tank time is used up, `Disturbed`,
        `NoDaemon` and `ConfigError`; earlier measurements are kept.
        """
        state = self._run.state
        self._show.at(self._session.used)
        if state.excitation is None:
            self._excite(state)
        if state.fitted is None:
            self._fit(state)
        if state.swing is None:
            self._settle_swing(state)
        if state.square is None:
            self._search(state)
        if state.trained is None:
            self._train(state)
        if state.verdict is None:
            self._compare(state)
            self._simulate(state)
            state.verdict = judge(state.contenders, self._model(state))
            self._save()
        return state

    def _excite(self, state: State) -> None:
        seconds = do.BUDGET["excitation"] * self._tank_time
        path = self._run.experiment.recording("excitation")
        with self._count_tank_time("excitation", "excitation"), self._session.recorded(path, _NOTE):
            experiment(self._session, seconds)
        state.excitation = path.name
        self._done(f"excitation: {seconds:.0f} s, recorded in {path.name}")

    def _fit(self, state: State) -> None:
        assert state.excitation
        self._show.at(self._session.used, "fitting a model of the fish, which rests")
        path = self._run.path / state.excitation
        try:
            identification, state.fitted = do.fit(path, self._session.amplitude, self._seed)
        except RecordingError as error:
            state.excitation = None
            self._save()
            raise RecordingError(f"{error}; if resumed, the fish swims it again") from None
        except FishdError:
            raise
        except (ArithmeticError, ValueError) as error:  # the numerics of a fit
            reason = f"the fit failed: {text.describe_error(error)}"
            state.fitted = do.without_fit(reason)
            self._done("fit: none")
            self._show.warn(f"fishctl: careful: {_BY_MEASUREMENT}: {reason}")
            return
        self._run.experiment.write(FISH, identification.to_yaml("fishctl adapt"))
        explained = " and ".join(f"{channel.explained:.1%}" for channel in identification.channels)
        self._done(f"fit: explains {explained} of F_x and F_y")
        if state.fitted.model.standard_error is None:
            self._show.warn(f"fishctl: careful: {_BY_MEASUREMENT}: {identification.headline}")
        for remark in identification.remarks:
            self._show.warn(f"fishctl: careful: {remark}")

    def _settle_swing(self, state: State) -> None:
        seconds = do.BUDGET["swing"] * self._tank_time - MEAN_REST_S
        path = self._run.experiment.recording("swing")
        with self._count_tank_time("swing", "swing --C auto"), self._session.recorded(path, _NOTE):
            state.swing = do.settle_swing(self._session, seconds)
        rung = state.swing
        lead = f", {rung.lead * 1e3:.0f} ms ahead" if rung.lead else ""
        unsure = "" if rung.is_finished else "; its search was not finished"
        self._done(f"swing --C auto: C = {rung.C:g}{lead}{unsure}")

    def _search(self, state: State) -> None:
        assert state.fitted
        search = do.square_waves(state.fitted, self._session, self._seed)
        budget = max(
            do.BUDGET["search"] * self._tank_time, do.min_search_time(self._session, search)
        )

        def add_trial(trial: Tried) -> None:
            state.trials.append(trial)
            state.tank_time = self._session.used
            self._save()

        path = self._run.experiment.recording("search")
        with (
            self._count_tank_time("search", "searching square waves"),
            self._session.recorded(path, _NOTE),
        ):
            do.search_square_waves(self._session, search, budget, tuple(state.trials), add_trial)
        state.square, used = do.best_of(search, state.trials, state.fitted, self._session.amplitude)
        state.is_fit_rejected = not used and state.fitted.model.standard_error is not None
        waves = len({trial.frequency for trial in state.trials})
        tried = f"{len(state.trials)} trials of {waves} square waves"
        basis = "in agreement with the fit" if used else "from these waves alone"
        basis = "they contradict the fit, which is not used" if state.is_fit_rejected else basis
        self._done(f"search: {tried}; best at {state.square:.4g} Hz, {basis}")

    def _model(self, state: State) -> Model:
        """Return the model of the fit, marked as rejected where the square waves disagree."""
        assert state.fitted
        return replace(state.fitted.model, is_rejected=state.is_fit_rejected)

    def _train(self, state: State) -> None:
        assert state.fitted
        if state.fitted.model.standard_error is None:
            state.trained = Trained(steps=0, refusal="the fit is not used")
            self._done("no policy is trained: the fit is not used")
            return

        def progress(done: int) -> None:
            repetition, step = divmod(done - 1, self._steps)
            more = f" (training {repetition + 1} of {MAX_TRAININGS})" if repetition else ""
            doing = f"training, {step + 1} of {self._steps} steps{more}; the fish rests"
            self._show.at(self._session.used, doing)

        try:
            trained = train_policy(
                self._config, state.fitted, self._run.path, self._steps, self._seed, progress
            )
        except Exception as error:  # what the fish has swum is worth more than a training
            trained = Trained(steps=0, refusal=f"its training failed: {text.describe_error(error)}")
        state.trained = trained
        if trained.refusal:
            self._save()
            self._show.warn(f"fishctl: careful: no policy takes part: {trained.refusal}")
            return
        worst = (
            ""
            if trained.worst_relative_thrust is None
            else f", {trained.worst_relative_thrust:.1%} on the worst tried"
        )
        cloud = f"{len(state.fitted.cloud)} fish within the errors of the fit"
        self._done(f"training on {cloud}: {trained.relative_thrust:.1%} in simulation{worst}")

    def gaits(self, state: State) -> list[Gait]:
        """Return the gaits that take part in the comparison."""
        assert state.swing
        assert state.square
        swing = {"C": state.swing.C} | ({"lead": state.swing.lead} if state.swing.lead else {})
        gaits = [
            Gait("swing", "swing", swing),
            Gait(SQUARE, "square", {"frequency": state.square}),
        ]
        if state.trained and not state.trained.refusal:
            policy = str((self._run.path / POLICY).absolute())
            gaits.insert(0, Gait("policy", "ppo", {"policy": policy}))
        return gaits

    def _compare(self, state: State) -> None:
        known = {contender.name for contender in state.contenders} | set(state.exclusions)
        todo = [gait for gait in self.gaits(state) if gait.name not in known]
        left = self._tank_time - self._session.used
        needed = sum(do.min_measurement_time(gait.parameters) for gait in todo)
        if left < needed:
            raise FishdError(
                f"{max(0.0, left):.0f} s are left of the tank time, and the comparison needs "
                f"{needed:.0f} s: a larger --budget is needed"
            )
        for index, gait in enumerate(todo):
            rest = sum(do.min_measurement_time(other.parameters) for other in todo[index + 1 :])
            left = self._tank_time - self._session.used
            seconds = min(left / (len(todo) - index), left - rest)
            self._measure(state, gait, max(seconds, do.min_measurement_time(gait.parameters)))

    def _measure(self, state: State, gait: Gait, seconds: float) -> None:
        path = self._run.experiment.recording(f"measured-{gait.name}")
        try:
            with (
                self._count_tank_time("comparison", f"measuring {gait.name}"),
                self._session.recorded(path, _NOTE),
            ):
                measurement = measure(self._session, gait.controller, gait.parameters, seconds)
        except FishdError as error:
            if not concerns_one_controller(error) or gait.name == SQUARE:
                raise
            state.exclusions[gait.name] = str(error)
            self._save()
            self._show.warn(f"fishctl: {gait.name}: left out: {error}")
            return
        state.contenders.append(
            Contender(
                name=gait.name,
                controller=gait.controller,
                parameters=gait.parameters,
                thrust=measurement.thrust,
                thrust_ci95=measurement.thrust_ci95,
                calibration_ci95=measurement.calibration_ci95,
                total_ci95=measurement.total_ci95,
                frequency=measurement.frequency,
                seconds=seconds,
                remark=measurement.remark,
            )
        )
        measured = error_budget.format_with_budget(
            measurement.thrust,
            measurement.thrust_ci95,
            measurement.calibration_ci95,
            measurement.total_ci95,
            measurement.unit,
        )
        self._done(f"{gait.name}: {measured} at {measurement.frequency:.3f} Hz")
        if measurement.remark:
            self._show.warn(f"fishctl: {gait.name}: {measurement.remark}")

    def _simulate(self, state: State) -> None:
        """Simulate the measured gaits on the first fish of the cloud, if the fit is used."""
        assert state.fitted
        if state.fitted.model.standard_error is None:
            return
        identified = simulated_config(self._config, state.fitted)
        fish = [replace(identified, plant=plant) for plant in state.fitted.cloud[:_SIMULATED_FISH]]
        try:
            state.contenders = [
                replace(
                    gait,
                    expected_thrusts=[
                        simulate(config, gait.controller, gait.parameters).mean_thrust
                        for config in fish
                    ],
                )
                for gait in state.contenders
            ]
        except Exception as error:  # what the fish has swum is worth more than a simulation
            self._show.warn(
                f"fishctl: careful: {_BY_MEASUREMENT}: a simulation of the identified fish "
                f"failed: {text.describe_error(error)}"
            )
        self._save()

    @contextmanager
    def _count_tank_time(self, step: str, doing: str) -> Iterator[None]:
        """Add the time in the tank of a step to the state, also if the step fails."""
        state, begun = self._run.state, self._session.used
        self._doing = doing
        try:
            yield
        finally:
            spent = self._session.used - begun
            state.step_times[step] = state.step_times.get(step, 0.0) + spent
            state.tank_time = self._session.used
            self._save()

    def _save(self) -> None:
        self._run.save()

    def _done(self, line: str) -> None:
        self._save()
        self._show.done(line, self._session.used)


_NOTE = "fishctl adapt"
_BY_MEASUREMENT = "the fit is not used, the gaits are chosen by measurement alone"
_SIMULATED_FISH = 8
"""Number of fish of the cloud on which a gait is simulated."""


def add_true_thrusts(run: AdaptFolder, config: Config) -> None:
    """Add the true thrusts of the gaits of a simulated fish to the state.

    The session must have ended: a virtual Pi can be open only once.
    """
    for index, gait in enumerate(run.state.contenders):
        swum = simulate(config, gait.controller, gait.parameters)
        run.state.contenders[index] = replace(
            gait, true_thrust=swum.mean_thrust, true_relative_thrust=swum.relative_thrust
        )
    run.save()
