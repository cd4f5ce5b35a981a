"""`fishctl adapt`: the cloud of fish, the choice of the gait, and a resume without repeats."""

import dataclasses
from functools import partial
from pathlib import Path
from typing import Any, cast

import msgspec
import numpy as np
import pytest
from rigs.processes import fishctl
from rigs.virtual_daemon import VirtualDaemon

from fishd.cli.adapt import format_command
from fishd.cli.experiment_options import ChosenFish
from fishd.client import Fish
from fishd.config import Config, load
from fishd.core.errors import ConfigError, FishdError, RecordingError, Refused
from fishd.lab.experiment import Header, find_answer, open_experiment
from fishd.lab.identification import Channel, Estimate, Fit, Identification, Unidentifiable
from fishd.lab.ranking import format_ratio
from fishd.lab.session import LiveSession, VirtualSession
from fishd.learning.adapt import adaptation, report, steps
from fishd.learning.adapt.adaptation import Adaptation
from fishd.learning.adapt.prior import MODEL_ERROR, model_of
from fishd.learning.adapt.state import (
    TRAINING,
    AdaptFolder,
    Contender,
    Fitted,
    Model,
    State,
    Trained,
    Tried,
)
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


def test_a_training_that_fails_is_left_out_and_loses_no_measurement(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: Any) -> Trained:
        raise ValueError("low >= high")

    monkeypatch.setattr(adaptation, "train_policy", fail)
    run, show = folder(tmp_path / "run"), StoringDisplay()
    run.state.fitted = fitted(GOOD)
    with VirtualSession(Config()) as rig:
        Adaptation(rig, run, 150.0, 640, 0, show)._train(run.state)
    trained = folder(run.path).state.trained
    assert trained
    assert trained.refusal == "its training failed: ValueError: low >= high"


def test_a_fit_that_fails_is_left_out_and_the_gaits_are_chosen_by_measurement(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: Any, **__: Any) -> Identification:
        raise np.linalg.LinAlgError("SVD did not converge")

    monkeypatch.setattr(steps, "identify", fail)
    run, show = folder(tmp_path / "run"), StoringDisplay()
    with VirtualSession(Config()) as rig:
        state = Adaptation(rig, run, 160.0, 640, 0, show).run()
    assert any("the fit failed: LinAlgError: SVD did not converge" in line for line in show.lines)
    assert {gait.name for gait in state.contenders} == {"swing", "square"}
    assert state.verdict
    _, page = report.write(run, PHI, "fishctl simulate")
    assert "the fit failed: LinAlgError: SVD did not converge" in page.read_text(encoding="utf-8")


def test_a_simulation_that_fails_loses_no_measurement(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: Any, **__: Any) -> None:
        raise ValueError("low >= high")

    monkeypatch.setattr(adaptation, "simulate", fail)
    run, show = folder(tmp_path / "run"), StoringDisplay()
    run.state.fitted = fitted(GOOD)
    run.state.contenders = [contender("square", 0.02, 1e-4), contender("swing", 0.03, 1e-4)]
    with VirtualSession(Config()) as rig:
        Adaptation(rig, run, 160.0, 640, 0, show)._simulate(run.state)
    assert [gait.expected_thrusts for gait in folder(run.path).state.contenders] == [[], []]
    assert judge(run.state.contenders, GOOD).chosen_gait == "swing"
    assert any("failed: ValueError: low >= high" in line for line in show.lines)


def test_each_episode_of_a_training_swims_a_fish_of_the_cloud() -> None:
    fish = draw_cloud(identification(), PHI, count=5)
    spread = Randomisation(fish=fish)
    assert {draw_fish(Config(), spread, seed).plant for seed in range(60)} == set(fish)
    assert [draw_edge_fish(Config(), spread, seed).plant for seed in range(5)] == list(fish)


CONTROLLERS = {"policy": "ppo", "swing": "swing", "square": "square"}
GOOD = Model(explained_fraction=0.995, standard_error=MODEL_ERROR)
USELESS = Model(explained_fraction=0.61, standard_error=None)


def contender(name: str, thrust: float, error: float, *expected: float) -> Contender:
    return Contender(
        name=name, controller=CONTROLLERS[name], parameters={}, thrust=thrust, thrust_ci95=error,
        frequency=1.7, seconds=46.0, expected_thrusts=list(expected),
    )  # fmt: skip


def test_the_largest_thrust_wins_where_the_measurement_is_decisive() -> None:
    won = judge([contender("swing", 21e-3, 0.2e-3), contender("square", 20e-3, 0.2e-3)], GOOD)
    assert (won.chosen_gait, won.is_decided, won.undecided_gaits) == ("swing", True, ["swing"])
    assert won.relative_thrust == pytest.approx(1.05)
    # √2 · 1 % of relative error, for a single comparison
    low, high = won.relative_thrust_ci95_low, won.relative_thrust_ci95_high
    assert (low, high) == pytest.approx((1.0354, 1.0648), abs=5e-4)
    assert "swing wins: its thrust is 105.0 %" in won.claim


def test_without_a_decisive_measurement_the_simplest_is_chosen_and_nothing_wins() -> None:
    near = [contender("policy", 20.2e-3, 2e-4), contender("square", 20e-3, 2e-4)]
    swing = contender("swing", 20.1e-3, 2e-4)
    two, three = judge(near, GOOD), judge([swing, *near], USELESS)
    assert (two.chosen_gait, two.is_decided, two.relative_thrust) == ("square", False, 1.0)
    assert three.undecided_gaits == ["square", "swing", "policy"]
    assert three.claim.startswith(
        "undecided between the best square wave tried, swing and the policy; the best square "
        "wave tried is chosen because it is the simplest. Thrusts relative to the best square "
    )
    assert "The fit, which explains 61% of the forces, is not used for this" in three.claim
    assert not any("wins" in verdict.claim for verdict in (two, three))


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
    vague = [
        contender("policy", 20.5e-3, 1.4e-3, 23e-3, 24e-3),
        contender("square", 20e-3, 1.4e-3, 20e-3, 21e-3),
    ]
    verdict = judge(vague, model)
    assert (verdict.chosen_gait, verdict.is_decided) == (chosen, False)
    reason = "because the identified fish, which explains 99.5% of its forces, thrusts most with it"
    assert (reason in verdict.claim) == (chosen == "policy")


def test_an_identified_fish_that_thrusts_contradict_is_not_used() -> None:
    measured = [
        contender("policy", 19.9e-3, 2e-4, 30e-3, 30e-3),
        contender("square", 20e-3, 2e-4, 20e-3, 20e-3),
    ]
    assert judge(measured, GOOD).chosen_gait == "square"


def test_intervals_of_two_are_wider_than_that_of_one() -> None:
    square, swing = contender("square", 20e-3, 0.2e-3), contender("swing", 21e-3, 0.2e-3)
    policy = contender("policy", 1e-3, 0.2e-3)
    single, double = judge([swing, square], GOOD), judge([policy, swing, square], GOOD)
    assert double.relative_thrust_ci95_high - double.relative_thrust_ci95_low == pytest.approx(
        2.2414 / 1.96 * (single.relative_thrust_ci95_high - single.relative_thrust_ci95_low),
        rel=2e-3,
    )


def test_a_square_wave_that_hardly_thrusts_is_no_reference_but_the_best_gait_is_named() -> None:
    undecided = judge([contender("swing", 1e-4, 2e-4), contender("square", 1e-4, 2e-4)], GOOD)
    assert (undecided.chosen_gait, undecided.relative_thrusts) == ("square", {})
    assert undecided.claim.endswith("as the best square wave tried hardly thrusts")
    won = judge([contender("swing", 5e-3, 2e-4), contender("square", 1e-4, 2e-4)], GOOD)
    assert (won.chosen_gait, won.is_decided, won.relative_thrust) == ("swing", True, None)


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
        tried.append(Tried(frequency, thrust, 0.2e-3, 0, 0.0))
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
    tried = [Tried(*measurement, 0, 0.0) for measurement in zip(*forces, strict=True)]
    assert steps.best_of(search, tried, fitted(GOOD), PHI) == (pytest.approx(10 / 6), True)


class StoringDisplay:
    """A display that stores its lines."""

    def __init__(self) -> None:
        self.lines: list[str] = []

    def done(self, line: str, amount: float) -> None:
        self.lines.append(line)

    def at(self, amount: float, text: str = "") -> None:
        pass

    def warn(self, line: str) -> None:
        self.lines.append(line)


def no_policy(*_: Any) -> Trained:
    return Trained(steps=0, refusal="this test trains no policy")


def folder(path: Path) -> AdaptFolder:
    header = Header(kind="adapt", on="live", settings={"seed": 0})
    with open_experiment(path, header, resume=path.exists()) as experiment:
        return AdaptFolder(experiment)


class Stopped(BaseException):
    """The exception of Ctrl-C."""


@pytest.mark.slow
def test_a_resume_repeats_no_measurement(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(adaptation, "train_policy", no_policy)
    # Each fish, and each fitted parameter, takes long to compute
    monkeypatch.setattr(steps, "draw_cloud", partial(draw_cloud, count=2))
    monkeypatch.setattr(steps, "MIN_CLOUD_SIZE", 2)
    monkeypatch.setattr(steps, "FITTED", FITTED_IN_BRIEF)
    path, config = tmp_path / "run", load("config/simulated.yaml")
    daemon, show = VirtualDaemon(config), StoringDisplay()

    def adapt() -> State:
        with LiveSession(cast(Fish, daemon)) as rig:
            adapting = Adaptation(rig, folder(path), 160.0, 640, 0, show)
            return adapting.run()

    def stop(*_: Any, **__: Any) -> None:
        raise Stopped

    monkeypatch.setattr(LiveSession, "describe", lambda self, writer: None)
    with monkeypatch.context() as broken:
        broken.setattr(steps, "search_square_waves", stop)
        with pytest.raises(Stopped):
            adapt()
    stored = folder(path).state
    assert daemon.status().mode == "idle"
    assert stored.excitation == "excitation.mcap"
    assert stored.fitted
    assert stored.swing
    assert stored.tank_time == pytest.approx(0.34 * 160.0, abs=0.2)
    state = adapt()
    assert state.verdict
    assert state.tank_time == pytest.approx(160.0, abs=0.2)
    assert sum(line.startswith("excitation") for line in show.lines) == 1
    assert any("this test trains no policy" in line for line in show.lines)
    assert {gait.name for gait in state.contenders} == {"swing", "square"}
    assert state.verdict.chosen_gait == "square"
    assert state.verdict.undecided_gaits == ["square", "swing"]
    assert all(len(gait.expected_thrusts) == 2 for gait in state.contenders)
    for name, (value, low, high) in state.verdict.relative_thrusts.items():
        assert 0.95 < value < 1.05, name
        assert low < 1.0 < high
    state.contenders[0] = msgspec.structs.replace(state.contenders[0], true_thrust=0.0257)
    picture, page = report.write(folder(path), PHI, "fishctl set-controller <swing>")
    assert picture.stat().st_size > 10_000
    assert find_answer(path).summary == f"chosen: square --frequency {state.square:.6g}"
    text = page.read_text(encoding="utf-8")
    assert "fishctl set-controller &lt;swing&gt;" in text
    assert "the best square wave tried, chosen" in text
    in_the_tank = text.partition("<h2>In the tank</h2>")[2]
    assert format_ratio(state.verdict.relative_thrusts["swing"]) in in_the_tank
    assert "<td>rad/s</td>" in text
    assert "<td>–</td>" in text
    assert "e-" not in text.partition("<h2>The fish</h2>")[2]


def test_no_policy_is_trained_on_a_fish_that_explains_too_little(tmp_path: Path) -> None:
    run, show = folder(tmp_path / "run"), StoringDisplay()
    run.state.fitted = fitted(USELESS)
    with VirtualSession(Config()) as rig:
        adapting = Adaptation(rig, run, 150.0, 640, 0, show)
        adapting._train(run.state)
    assert show.lines == ["no policy is trained: the fit is not used"]
    stored = folder(run.path).state
    assert stored.trained
    assert stored.trained.refusal
    assert not (run.path / TRAINING).exists()


def test_a_fish_that_is_only_noise_is_refused_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(steps, "FITTED", FITTED_IN_BRIEF)
    fish = ["plant.thrust_coefficient=1e-6", "plant.lateral_drag=1e-6", "simulation.noise=0.01"]
    config = load(None, fish)
    run = folder(tmp_path / "run")
    with (
        VirtualSession(config) as rig,
        pytest.raises(Unidentifiable, match="neither F_x nor F_y follows φ_c"),
    ):
        Adaptation(rig, run, 150.0, 640, 0, StoringDisplay()).run()
    assert folder(run.path).state.excitation == "excitation.mcap"


@pytest.mark.parametrize("content", [b"", bytes(999)], ids=["empty", "zeros"])
def test_an_excitation_that_a_power_cut_has_emptied_is_swum_again(
    tmp_path: Path, content: bytes
) -> None:
    run = folder(tmp_path / "run")
    run.state.excitation = "excitation.mcap"
    run.save()
    (run.path / "excitation.mcap").write_bytes(content)
    with (
        VirtualSession(Config()) as rig,
        pytest.raises(RecordingError, match=r"mcap is .*; if resumed, the fish swims it again"),
    ):
        Adaptation(rig, run, 150.0, 640, 0, StoringDisplay()).run()
    assert folder(run.path).state.excitation is None


@pytest.mark.parametrize(
    ("error", "code", "status"),
    [(Refused("leased", "a lease is held"), " [leased]", 1), (ConfigError("run: another"), "", 78)],
)
def test_an_error_ends_an_adaptation_in_one_line_with_the_command_to_resume(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: FishdError, code: str, status: int
) -> None:
    def run(_: Adaptation) -> State:
        raise error

    message = str(error)
    monkeypatch.setattr(Adaptation, "run", run)
    done = fishctl("adapt", "--folder", str(tmp_path / "run"))
    command = f"fishctl adapt --resume {tmp_path / 'run'}"
    assert done.stderr == f"fishctl: {message}; resume with: {command}{code}\n"
    assert done.returncode == status


def test_the_last_line_is_the_command_to_type() -> None:
    winner = msgspec.structs.replace(
        contender("square", 1.0, 0.1), controller="square", parameters={"frequency": 5.0 / 3.0}
    )
    live = ChosenFish("live", None, (), None)
    assert format_command(winner, live) == "fishctl set-controller square --frequency 1.66667"
    command = format_command(winner, live._replace(endpoint="ipc:///run/a"))
    assert command.endswith(" --endpoint ipc:///run/a")
    keys = ("plant.xi=0.9", "tick=0.05")
    assert format_command(winner, ChosenFish("simulation", Path("a fish.yaml"), keys, None)) == (
        "fishctl simulate square --frequency 1.66667 --config 'a fish.yaml' --set plant.xi=0.9 "
        "--set tick=0.05"
    )
