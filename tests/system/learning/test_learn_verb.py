import contextlib
import os
import pty
import re
import signal
import subprocess
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import msgspec
import pytest
from rigs.processes import FISHCTL, Daemon, Process, fishctl, one_line, running
from rigs.swimming import brief_job, rows, wait_for, while_it_trains

from fishd.cli.learn.ppo import report
from fishd.cli.main import fishctl as commands
from fishd.client import Fish
from fishd.config import load
from fishd.learning.env import fishd_link
from fishd.learning.env.evaluation import Evaluation
from fishd.learning.run_folder import checkpoints, runs
from fishd.learning.train.jobs import Outcome

SETTINGS = """\
steps: 128
ppo: {n_steps: 64, n_epochs: 4, log_std_init: 0.7}
evaluation: {every: 1, patience: null, seconds: 4.0, settle: 2.0}
"""


@pytest.fixture
def settings(tmp_path: Path) -> str:
    path = tmp_path / "settings.yaml"
    path.write_text(SETTINGS, encoding="utf-8")
    return str(path)


def learn(*arguments: str) -> subprocess.CompletedProcess[str]:
    return fishctl("learn", *arguments)


def complaint(*arguments: str) -> tuple[int, str]:
    """Exit status and the one line on standard error."""
    done = learn(*arguments)
    return done.returncode, one_line(done)


def test_it_trains_and_says_how_it_went(tmp_path: Path, settings: str) -> None:
    folder = tmp_path / "run"
    found = learn("ppo", "--settings", settings, "--folder", str(folder), "--steps", "512")
    assert found.returncode == 0, found.stderr
    assert re.search("512 steps in 0:2. of tank time without evaluations", found.stdout)
    assert f"fishctl learn export {folder}" in found.stdout
    lines = found.stdout.count(" in the tank without evaluations: ")
    assert lines >= 2  # a line for each evaluation
    assert runs.read(folder)[1].steps == 512


def test_it_goes_on_with_more_steps(tmp_path: Path, settings: str) -> None:
    folder = tmp_path / "run"
    learn("ppo", "--settings", settings, "--folder", str(folder), "--steps", "64")
    found = learn("ppo", "--resume", str(folder), "--steps", "128")
    assert found.returncode == 0, found.stderr
    assert f"resumed from {folder}/step-000064" in found.stdout
    assert [row["steps"] for row in rows(folder / "progress.csv")] == ["64", "128"]


def test_a_new_run_can_begin_with_the_networks_and_settings_of_another(
    tmp_path: Path, settings: str
) -> None:
    first, second = tmp_path / "first", tmp_path / "second"
    learn("ppo", "--settings", settings, "--folder", str(first), "--steps", "64")
    found = learn("ppo", "--from", str(first), "--folder", str(second), "--steps", "128")
    assert found.returncode == 0, found.stderr
    assert runs.read(second)[1].ppo == runs.read(first)[1].ppo
    note = checkpoints.read_card(checkpoints.newest(second)).provenance.note
    assert note.startswith("began with first/")


def test_the_folder_is_named_after_the_moment_by_default(
    tmp_path: Path, settings: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert learn("ppo", "--settings", settings, "--steps", "64").returncode == 0
    (folder,) = (tmp_path / "runs").iterdir()
    assert folder.name.startswith("ppo-20")


def test_mistakes_are_one_line(tmp_path: Path, settings: str) -> None:
    folder = str(tmp_path / "run")
    (tmp_path / "wrong.yaml").write_text("ppo:\n  gama: 0.9\n", encoding="utf-8")
    status, line = complaint("ppo", "--settings", str(tmp_path / "wrong.yaml"))
    assert status == 78
    assert "wrong.yaml:2: ppo.gama: unknown key; did you mean 'gamma'?" in line
    assert learn("ppo", "--settings", settings, "--folder", folder).returncode == 0
    assert complaint("ppo", "--folder", folder)[0] == 78
    status, line = complaint("ppo", "--resume", folder)
    assert status == 78
    assert "is finished, with 128 steps; to train it for longer, give a larger total" in line
    status, line = complaint("ppo", "--resume", folder, "--seed", "2")
    assert status == 2
    assert "--seed cannot be given with --resume" in line
    status, line = complaint("ppo", "--resume", str(tmp_path))
    assert status == 78
    assert "it holds no settings.yaml" not in line  # there is one, but nothing else of a run
    (tmp_path / "several" / "seed-0").mkdir(parents=True)
    status, line = complaint("ppo", "--resume", str(tmp_path / "several"))
    assert status == 1
    assert "holds several trainings, seed-0 to seed-0; name one of them" in line
    for name, what in (("a.onnx", "a policy file has no value network"), ("b", "no such")):
        (tmp_path / "a.onnx").touch()
        status, line = complaint("ppo", "--from", str(tmp_path / name))
        assert status == 78
        assert what in line
    status, line = complaint("ppo", "--seeds", "2", "--on", "live")
    assert status == 2
    assert "there is only one live fish" in line


def test_it_says_that_it_learns_from_whole_rollouts(tmp_path: Path, settings: str) -> None:
    found = learn("ppo", "--settings", settings, "--folder", str(tmp_path / "a"), "--steps", "65")
    assert "128 steps, in whole rollouts of 64 in simulation" in found.stdout
    assert "\n128 steps in " in found.stdout


def test_a_policy_that_never_swam_is_not_for_a_file(tmp_path: Path) -> None:
    idle = tmp_path / "idle.yaml"
    idle.write_text(
        SETTINGS.replace("n_epochs: 4", "n_epochs: 1, learning_rate: 1.0e-9"), encoding="utf-8"
    )
    found = learn(
        "ppo", "--settings", str(idle), "--folder", str(tmp_path / "run"), "--steps", "64"
    )
    assert found.returncode == 0, found.stderr
    assert "it stalled in every evaluation; train it for longer" in found.stdout
    assert "learn export" not in found.stdout


ENDLESS = ("--steps", "1000000")


def updates(folder: Path) -> int:
    """How many updates the run has."""
    table = folder / "progress.csv"
    return len(rows(table)) if table.exists() else 0


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_leaves_a_checkpoint_to_go_on_from(
    tmp_path: Path, settings: str, number: int
) -> None:
    folder = tmp_path / "run"
    found = while_it_trains(
        lambda: updates(folder) >= 2,
        lambda: os.kill(os.getpid(), number),
        *("learn", "ppo", "--folder", str(folder), *ENDLESS, "--settings", settings),
    )
    assert found.returncode == 130, found.stderr
    done = checkpoints.read_state(checkpoints.newest(folder)).steps
    dropped = r"(, \d+ of an unfinished rollout dropped)?"
    go_on = re.escape(f"resume with: fishctl learn ppo --resume {folder}\n")
    assert re.fullmatch(f"fishctl: stopped after {done} steps{dropped}; {go_on}", found.stderr)
    assert int(rows(folder / "progress.csv")[-1]["steps"]) == done
    found = learn("ppo", "--resume", str(folder), "--steps", str(done + 64))
    assert found.returncode == 0, found.stderr


def test_whatever_kills_it_the_checkpoints_are_whole(tmp_path: Path, settings: str) -> None:
    text = SETTINGS.replace("steps: 128", "steps: 128\ncheckpoint_every: 64")
    Path(settings).write_text(text, encoding="utf-8")
    folder = tmp_path / "run"
    training = Process(
        *(FISHCTL, "learn", "ppo", "--folder", str(folder), *ENDLESS, "--settings", settings)
    )
    try:
        wait_for(lambda: updates(folder) >= 3)
    finally:
        training.end(signal.SIGKILL)
    for checkpoint in folder.glob("step-*"):
        checkpoints.load_policy(checkpoint)
        checkpoints.read_state(checkpoint)
    done = checkpoints.read_state(checkpoints.newest(folder)).steps
    assert done >= 128
    assert learn("ppo", "--resume", str(folder), "--steps", str(done + 64)).returncode == 0
    steps = [int(row["steps"]) for row in rows(folder / "progress.csv")]
    assert steps == list(range(64, done + 65, 64))


def test_on_a_terminal_it_shows_a_bar(
    tmp_path: Path, settings: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "120")
    ours, theirs = pty.openpty()

    def shown() -> str:
        pieces = []
        with contextlib.suppress(OSError):  # the other end is closed
            while piece := os.read(ours, 4096):
                pieces.append(piece)
        os.close(ours)
        return b"".join(pieces).decode()

    command = ["learn", "ppo", "--settings", settings, "--folder", str(tmp_path / "run")]
    with ThreadPoolExecutor(1) as reader:
        text = reader.submit(shown)
        with os.fdopen(theirs, "w") as terminal, contextlib.redirect_stderr(terminal):
            assert commands.main(command, standalone_mode=False) == 0
    assert "128 of 128 steps" in text.result()
    assert "tank 0:0" in text.result()
    assert "left" in text.result()


@pytest.fixture
def hasty(settings: str) -> str:
    """Settings with rollouts that take little time in the tank, and no evaluations."""
    text = SETTINGS.replace("every: 1, patience: null, seconds: 4.0, settle: 2.0", "every: 0")
    text = text.replace("n_steps: 64", "n_steps: 16, batch_size: 16").replace("128", "32")
    Path(settings).write_text(text, encoding="utf-8")
    return settings


@pytest.mark.realtime
def test_on_a_running_fishd_it_trains_at_its_tick_and_leaves_the_fish_at_rest(
    tmp_path: Path, hasty: str, daemon: Daemon
) -> None:
    folder = tmp_path / "run"
    found = learn(
        *("ppo", "--on", "live", "--endpoint", daemon.endpoint),
        *("--settings", hasty, "--folder", str(folder)),
    )
    assert found.returncode == 0, found.stderr
    config, _ = runs.read(folder)
    assert (config.tick, config.simulation.noise) == (0.05, 0.001)  # all of it is that of fishd
    assert found.stderr == ""
    assert [row["steps"] for row in rows(folder / "progress.csv")] == ["16", "32"]
    card = checkpoints.read_card(checkpoints.newest(folder))
    assert (card.provenance.on, card.tick) == ("live", 0.05)
    with Fish(daemon.endpoint) as fish:
        assert fish.status().mode == "idle"


def test_an_evaluation_on_a_running_fishd_is_soon_over_where_the_policy_does_not_swim(
    tmp_path: Path, hasty: str
) -> None:
    text = Path(hasty).read_text(encoding="utf-8")
    Path(hasty).write_text(text.replace("every: 0", "every: 2, on_robot: 30"), encoding="utf-8")
    with running(tmp_path, "--set", "lockstep=true") as daemon:
        found = learn(
            *("ppo", "--on", "live", "--endpoint", daemon.endpoint),
            *("--settings", hasty, "--folder", str(tmp_path / "run")),
        )
    assert found.returncode == 0, found.stderr
    (evaluation,) = rows(tmp_path / "run" / "evaluations.csv")
    assert evaluation["stalled"] == "1"
    assert float(evaluation["swam"]) <= 2.0
    assert 32 * 0.05 + 5.5 <= float(evaluation["tank_time"]) < 10.0  # two rests and that swim


@pytest.mark.realtime
def test_an_estop_ends_it_with_the_reason_and_a_checkpoint_and_no_other_begins(
    tmp_path: Path, hasty: str, daemon: Daemon
) -> None:
    folder = tmp_path / "run"

    def press() -> None:
        with Fish(daemon.endpoint) as fish:
            fish.estop("the tail hit the glass")

    on = ("ppo", "--on", "live", "--endpoint", daemon.endpoint)
    found = while_it_trains(
        lambda: updates(folder),
        press,
        *("learn", *on, *ENDLESS, "--settings", hasty, "--folder", str(folder)),
    )
    why = (
        "fishctl: fishd is in mode estop: the tail hit the glass; when that is mended, leave it "
        "with 'fishctl clear-fault'"
    )
    go_on = f"; resume with: fishctl learn ppo --resume {folder} --endpoint {daemon.endpoint}\n"
    assert (found.returncode, found.stderr) == (1, why + go_on)
    assert checkpoints.read_state(checkpoints.newest(folder)).steps >= 16
    found = learn(*on, "--folder", str(tmp_path / "other"))
    assert why in found.stderr
    assert not (tmp_path / "other").exists()


@pytest.mark.realtime
def test_another_plant_than_that_of_the_fishd_is_told(
    tmp_path: Path, hasty: str, daemon: Daemon
) -> None:
    found = learn(
        *("ppo", "--on", "live", "--endpoint", daemon.endpoint, "--steps", "16"),
        *("--settings", hasty, "--folder", str(tmp_path / "run"), "--set", "plant.omega0=11"),
    )
    assert found.returncode == 0, found.stderr
    assert "another plant than that of the fishd that runs: plant.omega0 is 11.0 here" in (
        found.stderr
    )


def test_a_configuration_that_is_not_that_of_the_fishd_is_explained(
    tmp_path: Path, daemon: Daemon
) -> None:
    file = tmp_path / "fish.yaml"
    file.write_text("amplitude_limit: 0.3\ntick: 0.05\n", encoding="utf-8")
    status, line = complaint(
        "ppo", "--on", "live", "--endpoint", daemon.endpoint, "--config", str(file)
    )
    assert status == 78
    assert "amplitude_limit: 0.3 rad in this configuration, 0.42 rad in the fishd" in line


@pytest.mark.parametrize(
    ("relative_thrust", "error", "careful"),
    [(1.01, None, False), (1.1, None, True), (1.1, 0.001, True), (1.1, 0.003, False)],
)
def test_more_thrust_than_is_possible_is_said_to_be_so(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    relative_thrust: float,
    error: float | None,
    careful: bool,
) -> None:
    best = Evaluation(
        thrust=0.028,
        error=error,
        relative_thrust=relative_thrust,
        frequency=1.67,
        fullness=1.0,
        stalled=False,
    )
    outcome = Outcome(
        folder=tmp_path / "tank",
        steps=128,
        dropped=0,
        tank_time=32.4,
        ended="finished",
        message="",
        checkpoint=None,
        best=None,
        latest_evaluation=best,
        best_evaluation=best,
    )
    assert report(outcome, brief_job(tmp_path / "tank")) == 0
    said = capsys.readouterr().out
    assert ("careful: that is more than the best square wave" in said) is careful
    assert "learn export" in said


@pytest.mark.parametrize("changes", [(), ("--set", "plant.omega0=11")])
def test_a_training_on_a_robot_asks_fishd_for_its_configuration_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, changes: tuple[str, ...]
) -> None:
    asked: list[str | None] = []

    def config_of(endpoint: str | None) -> dict[str, Any]:
        asked.append(endpoint)
        config: dict[str, Any] = msgspec.to_builtins(load())
        return config

    monkeypatch.setattr(fishd_link, "config_of", config_of)
    endpoint = f"ipc://{tmp_path}/nobody"
    found = learn("ppo", "--on", "live", "--endpoint", endpoint, *changes)
    assert "nobody listens there" in found.stderr
    assert asked == [endpoint]
    assert ("plant.omega0 is 11.0 here, 12.5 there" in found.stderr) is bool(changes)
