"""`fishctl adapt`: the cloud of fish, the choice of the gait, and a resume without repeats."""

import dataclasses
from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path
from typing import Any, cast

import msgspec
import numpy as np
import pytest
from rigs.processes import fishctl
from rigs.virtual_daemon import VirtualDaemon

from fishd.cli.adapt import format_command, gait_words
from fishd.cli.experiment import ChosenFish
from fishd.client import Fish
from fishd.config import Config, load
from fishd.core.errors import ConfigError, FishdError, Refused
from fishd.lab.compare.comparison import Standing, Verdict
from fishd.lab.experiment import Experiment, Header, open_experiment
from fishd.lab.identification import Channel, Estimate, Fit, Identification, Unidentifiable
from fishd.lab.session import LiveSession, Session, VirtualSession
from fishd.lab.swim_log import SwimLog
from fishd.learning.adapt import adaptation, steps
from fishd.learning.adapt.prior import MODEL_ERROR, model_of
from fishd.learning.adapt.results import TRAINING, Adapted, Fitted, Model, Trained, Wave
from fishd.learning.adapt.steps import draw_cloud, train_policy
from fishd.learning.adapt.verdict import judge
from fishd.learning.env.fish_variation import draw_edge_fish, draw_fish
from fishd.learning.settings import Randomisation
from fishd.virtual.imperfections import SimulationSettings
from fishd.virtual.plant.optimum import square_wave
from fishd.virtual.plant.parameters import PlantParameters

PHI = 0.42
FITTED_IN_BRIEF = ("omega0", "xi", "rotation")


def identification() -> Identification:
    """Return an identification with ω₀ to 2 % and ξ to 4 %, and negatively correlated errors."""
    plain = msgspec.structs.asdict(PlantParameters())
    known = [
        Estimate("omega0", 12.5, 12.5 / 1.02, 12.5 * 1.02),
        Estimate("xi", 1.2, 1.2 / 1.04, 1.2 * 1.04),
        *(
            Estimate(name, plain[name], plain[name], plain[name], fitted=False)
            for name in ("coupling", "servo_speed", "servo_lag")
        ),
        Estimate("rotation", 0.1, 0.1, 0.1, fitted=False),
    ]
    explained = {"explained": 0.99, "explained_out_of_sample": 0.99}
    channel = Channel("fx", **explained, noise=1e-3, drift=0.0, white=True)
    errors = np.log([1.02, 1.04]) / 1.96
    empty = np.zeros((2, 0))
    return Identification(
        headline="identified",
        identified=True,
        estimates=tuple(known),
        products=(),
        channels=(channel, channel),
        seconds=56.0,
        passages=1,
        remarks=(),
        names=("omega0", "xi"),
        covariance=np.array([[1.0, -0.9], [-0.9, 1.0]]) * np.outer(errors, errors),
        inflation=1.0,
        failed_assumptions=(),
        fit=Fit(np.zeros(0), empty, empty, empty),
        servo_law="linear",
    )


def test_a_cloud_has_the_errors_of_the_fit_and_their_correlation() -> None:
    fish = draw_cloud(identification(), PHI, count=400)
    assert (fish[0].omega0, fish[0].xi, fish[0].coupling) == (12.5, 1.2, 0.46)
    logs = np.log([[plant.omega0 / 12.5, plant.xi / 1.2] for plant in fish])
    assert logs.std(axis=0) == pytest.approx(np.log([1.02, 1.04]) / 1.96, rel=0.1)
    assert np.corrcoef(logs.T)[0, 1] == pytest.approx(-0.9, abs=0.03)


def test_draws_beyond_the_bounds_of_the_fit_are_rejected_and_few_may_be_left() -> None:
    at_a_bound = dataclasses.replace(
        identification(),
        covariance=np.diag([1e-6, 100.0]),  # ξ by a factor of e¹⁰ either way
    )
    fish = draw_cloud(at_a_bound, PHI, count=32)
    assert all(1e-3 < plant.xi < 10.0 for plant in fish)
    assert len({plant.xi for plant in fish}) == len(fish)
    hopeless = dataclasses.replace(identification(), covariance=np.diag([1e6, 1e6]))
    assert len(draw_cloud(hopeless, PHI)) < steps.MIN_CLOUD_SIZE


class StoringDisplay:
    """A display that stores its lines."""

    def __init__(self) -> None:
        self.lines: list[str] = []

    def done(self, line: str, amount: float) -> None:
        self.lines.append(line)

    def at(self, amount: float, text: str | None = None) -> None:
        pass

    def estimate(self, *_: object) -> None:
        pass

    def warn(self, line: str) -> None:
        self.lines.append(line)

    def has(self, text: str) -> bool:
        return any(text in line for line in self.lines)


def open_folder(path: Path) -> AbstractContextManager[Experiment]:
    header = Header(kind="adapt", on="live", settings={"seed": 0})
    return open_experiment(path, header, resume=path.exists())


def adapt(rig: Session, path: Path, show: StoringDisplay, seconds: float = 160.0) -> Adapted:
    with open_folder(path) as experiment:
        return adaptation.adapt(rig, experiment, seconds, 640, 0, show)


@pytest.fixture
def brief(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave out what takes long to compute: most fish, most fitted parameters, and a training."""
    monkeypatch.setattr(steps, "train_policy", no_policy)
    monkeypatch.setattr(steps, "draw_cloud", partial(draw_cloud, count=2))
    monkeypatch.setattr(steps, "MIN_CLOUD_SIZE", 2)
    monkeypatch.setattr(steps, "FITTED", FITTED_IN_BRIEF)


def no_policy(*_: Any) -> Trained:
    return Trained(steps=0, refusal="this test trains no policy")


@pytest.mark.usefixtures("brief")
def test_a_training_and_a_simulation_that_fail_are_left_out_and_lose_no_measurement(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: Any) -> Any:
        raise ValueError("low >= high")

    monkeypatch.setattr(steps, "train_policy", fail)
    monkeypatch.setattr(adaptation, "simulate_gaits", fail)
    show = StoringDisplay()
    with VirtualSession(Config()) as rig:
        adapted = adapt(rig, tmp_path / "run", show)
    assert adapted.trained.refusal == "its training failed: ValueError: low >= high"
    assert show.has("no policy takes part: its training failed: ValueError: low >= high")
    assert show.has("a simulation of the identified fish failed: ValueError: low >= high")
    assert {gait.contestant for gait in adapted.gaits} == {"swing", "square"}
    assert adapted.expected_thrusts == {}


def test_a_fit_that_fails_is_left_out_and_the_gaits_are_chosen_by_measurement(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: Any, **__: Any) -> Identification:
        raise np.linalg.LinAlgError("SVD did not converge")

    monkeypatch.setattr(steps, "identify", fail)
    show = StoringDisplay()
    with VirtualSession(Config()) as rig:
        adapted = adapt(rig, tmp_path / "run", show)
    assert show.has("the fit failed: LinAlgError: SVD did not converge")
    assert show.has("no policy is trained: the fit is not used")
    assert not (tmp_path / "run" / TRAINING).exists()
    assert {gait.contestant for gait in adapted.gaits} == {"swing", "square"}


def test_each_episode_of_a_training_swims_a_fish_of_the_cloud() -> None:
    fish = draw_cloud(identification(), PHI, count=5)
    spread = Randomisation(fish=fish)
    assert {draw_fish(Config(), spread, seed).plant for seed in range(60)} == set(fish)
    assert [draw_edge_fish(Config(), spread, seed).plant for seed in range(5)] == list(fish)


CONTROLLERS = {"policy": "ppo", "swing": "swing", "square": "square"}
GOOD = Model(explained_fraction=0.995, standard_error=MODEL_ERROR)
USELESS = Model(explained_fraction=0.61, standard_error=None)


def gait(name: str, thrust: float, error: float) -> Standing:
    return Standing(
        contestant=name, controller=CONTROLLERS[name], parameters={}, thrust=thrust,
        thrust_ci95=error, frequency=1.7, fullness=1.0, form_factor=1.0, thrusts=[thrust],
    )  # fmt: skip


def decide(gaits: list[Standing], model: Model, **expected: tuple[float, ...]) -> Verdict:
    return judge(gaits, model, expected)


def test_the_verdict_is_that_of_a_comparison_where_the_measurement_is_decisive() -> None:
    won = decide([gait("swing", 21e-3, 0.2e-3), gait("square", 20e-3, 0.2e-3)], GOOD)
    assert won.best == ("swing",)
    assert won.sentence.startswith("swing wins: it thrusts 105.0 % [103.6 %, 106.5 %] of square")


def test_without_a_decisive_measurement_the_simplest_is_chosen_and_nothing_wins() -> None:
    near = [gait("policy", 20.2e-3, 2e-4), gait("square", 20e-3, 2e-4)]
    swing = gait("swing", 20.1e-3, 2e-4)
    two, three = decide(near, GOOD), decide([swing, *near], USELESS)
    assert two.best[0] == "square"
    assert three.best == ("square", "swing", "policy")
    assert three.sentence == (
        "undecided between square, swing and policy; square is chosen because it is the simplest; "
        "the fit, which explains 61% of the forces, is not used for this"
    )


@pytest.mark.parametrize(
    ("model", "chosen"),
    [
        (GOOD, "policy"),
        (Model(explained_fraction=0.9, standard_error=0.3), "square"),  # as good as no model
        (USELESS, "square"),
        (Model(explained_fraction=0.995, standard_error=MODEL_ERROR, is_rejected=True), "square"),
    ],
)
def test_the_identified_fish_has_weight_by_how_well_it_explains(model: Model, chosen: str) -> None:
    # Measured to 7 %; on the fish of the cloud the policy has 15 % more.
    vague = [gait("policy", 20.5e-3, 1.4e-3), gait("square", 20e-3, 1.4e-3)]
    verdict = decide(vague, model, policy=(23e-3, 24e-3), square=(20e-3, 21e-3))
    assert (verdict.best[0], len(verdict.best)) == (chosen, 2)
    reason = "because the identified fish, which explains 99.5% of its forces, thrusts most with it"
    assert (reason in verdict.sentence) == (chosen == "policy")


def test_an_identified_fish_that_thrusts_contradict_is_not_used() -> None:
    measured = [gait("policy", 19.9e-3, 2e-4), gait("square", 20e-3, 2e-4)]
    verdict = decide(measured, GOOD, policy=(30e-3, 30e-3), square=(20e-3, 20e-3))
    assert verdict.best[0] == "square"


@pytest.mark.parametrize(
    ("failed", "explained", "error"),
    [
        ((), 0.4, MODEL_ERROR),  # the rest is noise
        (("white residual of fx",), 0.99, 0.1005),
        (("white residual of fx",), 0.61, None),
    ],
)
def test_the_weight_of_a_fit_follows_what_it_explains_out_of_sample(
    failed: tuple[str, ...], explained: float, error: float | None
) -> None:
    fit = identification()
    vague = dataclasses.replace(fit.channels[0], explained_out_of_sample=explained)
    fit = dataclasses.replace(
        fit,
        channels=(fit.channels[0], vague),
        failed_assumptions=failed,
        identified=not failed or explained > 0.9,
    )
    model = model_of(fit)
    assert model.explained_fraction == explained
    assert model.standard_error == (error and pytest.approx(error, rel=1e-3))


def fitted(model: Model) -> Fitted:
    return Fitted(
        plant=PlantParameters(), rig=SimulationSettings(), offset=0.0, cloud=(PlantParameters(),),
        model=model, identification={},
    )  # fmt: skip


@pytest.mark.slow
def test_a_policy_is_not_one_tick_off_the_best_wave_of_a_weakly_damped_fish(tmp_path: Path) -> None:
    # Half beats of six ticks, where PPO alone settles, give 74 % of those of seven.
    plant = msgspec.structs.replace(
        PlantParameters(), omega0=9.14, xi=0.66, coupling=0.4, servo_speed=4.83, servo_lag=0.335
    )
    fish = msgspec.structs.replace(fitted(GOOD), plant=plant, cloud=(plant,))
    trained = train_policy(Config(), fish, tmp_path, 64, 0, lambda steps: None)
    assert trained.worst_relative_thrust
    assert trained.worst_relative_thrust > 0.98


@pytest.mark.parametrize(
    ("model", "scale", "used"),
    [
        (GOOD, lambda f: 0.9, True),
        (GOOD, lambda f: f, False),  # the tank disagrees
        (
            Model(explained_fraction=0.8, standard_error=0.45),
            lambda f: f,
            True,
        ),  # so uncertain that the tank decides
        (USELESS, lambda f: f, False),
    ],
)
def test_the_fit_decides_on_the_best_square_wave_if_it_explains_well(
    model: Model, scale: Any, used: bool
) -> None:
    with VirtualSession(Config()) as rig:
        search = steps.square_waves(fitted(model), rig, 0)
    tried = []
    for frequency in search.ranges[0].values:
        thrust = scale(frequency) * square_wave(PlantParameters(), PHI, frequency).thrust
        tried.append(Wave(frequency, thrust, 0.2e-3))
        search.observe({"frequency": frequency}, thrust, 0.2e-3)
    true = max(tried, key=lambda trial: trial.thrust).frequency
    frequency, is_used = steps.best_of(search, tried, fitted(model), PHI)
    assert is_used == used
    assert frequency == pytest.approx(true)
    fastest = max(search.ranges[0].values)
    # All frequencies are searched without a fit
    assert (fastest > 4.0) == (model.standard_error is None)


def test_with_a_good_fit_few_noisy_waves_do_not_move_the_maximum() -> None:
    with VirtualSession(Config()) as rig:
        search = steps.square_waves(fitted(GOOD), rig, 0)
    for frequency, luck in ((10 / 8, 1.04), (10 / 6, 0.96), (2.0, 1.0)):
        thrust = luck * square_wave(PlantParameters(), PHI, frequency).thrust
        search.observe({"frequency": frequency}, thrust, 2e-3)
    forces = search.read_measurements("frequency")
    tried = [Wave(*measurement) for measurement in zip(*forces, strict=True)]
    assert steps.best_of(search, tried, fitted(GOOD), PHI) == (pytest.approx(10 / 6), True)


class Stopped(BaseException):
    """The exception of Ctrl-C."""


@pytest.mark.slow
@pytest.mark.usefixtures("brief")
def test_a_resume_repeats_no_measurement(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, daemon = tmp_path / "run", VirtualDaemon(load("config/simulated.yaml"))
    fits: list[object] = []
    identify = steps.identify

    def count(*args: Any, **options: Any) -> Identification:
        fits.append(args)
        return identify(*args, **options)

    def adapt_on_daemon() -> Adapted:
        with (
            LiveSession(cast(Fish, daemon)) as rig,
            open_folder(path) as experiment,
            rig.recorded(experiment.recording("adapt"), "") as writer,
            rig.logged(SwimLog(experiment, writer, rig.tick).swim),
        ):
            gaits = [path / "gaits.png"]
            return adaptation.adapt(rig, experiment, 160.0, 640, 0, StoringDisplay(), gaits)

    def stop(*_: Any, **__: Any) -> None:
        raise Stopped

    monkeypatch.setattr(LiveSession, "describe", lambda self, writer: None)
    monkeypatch.setattr(steps, "identify", count)
    with monkeypatch.context() as broken:
        broken.setattr(steps, "search_square_waves", stop)
        with pytest.raises(Stopped):
            adapt_on_daemon()
    assert daemon.status().mode == "idle"
    swum = daemon.run.loop.seq
    assert swum * 0.05 == pytest.approx(0.34 * 160.0, abs=0.2)
    adapted = adapt_on_daemon()
    assert len(fits) == 1
    assert daemon.run.loop.seq * 0.05 == pytest.approx(160.0, abs=0.3)
    assert adapted.tank_time == pytest.approx(160.0, abs=0.2)
    assert adapt_on_daemon() == adapted
    assert {gait.contestant for gait in adapted.gaits} == {"swing", "square"}
    assert adapted.undecided == ("square", "swing")
    assert all(len(thrusts) == 2 for thrusts in adapted.expected_thrusts.values())
    for picture in ("fit.png", "search.png", "gaits.png"):
        assert (path / picture).stat().st_size > 10_000
    assert gait_words(adapted.chosen)[:2] == ["square", "--frequency"]


def test_a_fish_that_is_only_noise_is_refused_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(steps, "FITTED", FITTED_IN_BRIEF)
    fish = ["plant.thrust_coefficient=1e-6", "plant.lateral_drag=1e-6", "simulation.noise=0.01"]
    with (
        VirtualSession(load(None, fish)) as rig,
        pytest.raises(Unidentifiable, match="neither F_x nor F_y follows φ_c"),
    ):
        adapt(rig, tmp_path / "run", StoringDisplay(), 150.0)


@pytest.mark.parametrize(
    ("error", "code", "status"),
    [(Refused("leased", "a lease is held"), " [leased]", 1), (ConfigError("run: another"), "", 78)],
)
def test_an_error_ends_an_adaptation_in_one_line_with_the_command_to_resume(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: FishdError, code: str, status: int
) -> None:
    def fail(*_: Any) -> Adapted:
        raise error

    message = str(error)
    monkeypatch.setattr(adaptation, "adapt", fail)
    done = fishctl("adapt", "--folder", str(tmp_path / "run"))
    command = f"fishctl adapt --resume {tmp_path / 'run'}"
    assert done.stderr == f"fishctl: {message}; resume with: {command}{code}\n"
    assert done.returncode == status


def test_the_last_line_is_the_command_to_type() -> None:
    winner = msgspec.structs.replace(gait("square", 1.0, 0.1), parameters={"frequency": 5.0 / 3.0})
    live = ChosenFish("live", None, (), None)
    assert format_command(winner, live) == "fishctl set-controller square --frequency 1.66667"
    command = format_command(winner, live._replace(endpoint="ipc:///run/a"))
    assert command.endswith(" --endpoint ipc:///run/a")
    keys = ("plant.xi=0.9", "tick=0.05")
    assert format_command(winner, ChosenFish("simulation", Path("a fish.yaml"), keys, None)) == (
        "fishctl simulate square --frequency 1.66667 --config 'a fish.yaml' --set plant.xi=0.9 "
        "--set tick=0.05"
    )
