import os
import pty
import re
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

pytest.importorskip("torch", reason="the extra 'learn' is not installed")
pytest.importorskip("stable_baselines3", reason="the extra 'learn' is not installed")
pytest.importorskip("tensorboard", reason="the extra 'learn' is not installed")

from click.testing import CliRunner, Result
from processes import FISHCTL, PATIENCE, Daemon, running
from swimming import brief_job, rows

from fishd.cli.learn_ppo import report
from fishd.cli.main import fishctl
from fishd.client import Fish
from fishd.console import run
from fishd.learning import checkpoints, runs
from fishd.learning.checkpoints import Evaluation
from fishd.learning.jobs import Outcome

SETTINGS = """\
steps: 128
ppo: {n_steps: 64, n_epochs: 4}
evaluation: {seconds: 4.0, settle: 2.0}
"""


@pytest.fixture
def settings(tmp_path: Path) -> str:
    path = tmp_path / "settings.yaml"
    path.write_text(SETTINGS, encoding="utf-8")
    return str(path)


def learn(*arguments: str) -> Result:
    return CliRunner().invoke(fishctl, ["learn", *arguments], standalone_mode=False)


def complaint(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str]:
    """Exit status and the one line on standard error."""
    sys.argv[1:] = ["learn", *arguments]
    with pytest.raises(SystemExit) as caught:
        sys.exit(run(fishctl, "fishctl"))
    error = capsys.readouterr().err
    assert error.count("\n") == 1, error
    return int(caught.value.code or 0), error


@pytest.fixture(autouse=True)
def _arguments(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["fishctl"])


def test_it_trains_and_says_how_it_went(tmp_path: Path, settings: str) -> None:
    folder = tmp_path / "run"
    found = learn("ppo", "--settings", settings, "--folder", str(folder), "--steps", "768")
    assert found.exit_code == 0, found.output
    assert "768 steps in 0:3" in found.output
    assert f"fishctl learn export {folder}" in found.output
    assert found.output.count(" in the tank: ") >= 2  # a line for each evaluation
    assert runs.read(folder)[1].steps == 768


def test_it_goes_on_with_more_steps(tmp_path: Path, settings: str) -> None:
    folder = tmp_path / "run"
    learn("ppo", "--settings", settings, "--folder", str(folder), "--steps", "64")
    found = learn("ppo", "--resume", str(folder), "--steps", "128")
    assert found.exit_code == 0, found.output
    assert f"on from {folder}/step-000064" in found.output
    assert [row["steps"] for row in rows(folder / "progress.csv")] == ["64", "128"]


def test_a_new_run_can_begin_with_the_networks_and_settings_of_another(
    tmp_path: Path, settings: str
) -> None:
    first, second = tmp_path / "first", tmp_path / "second"
    learn("ppo", "--settings", settings, "--folder", str(first), "--steps", "64")
    found = learn("ppo", "--from", str(first), "--folder", str(second), "--steps", "128")
    assert found.exit_code == 0, found.output
    assert runs.read(second)[1].ppo == runs.read(first)[1].ppo
    note = checkpoints.read_card(checkpoints.newest(second)).provenance.note
    assert note.startswith("began with first/")


def test_the_folder_is_named_after_the_moment_by_default(
    tmp_path: Path, settings: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert learn("ppo", "--settings", settings, "--steps", "64").exit_code == 0
    (folder,) = (tmp_path / "runs").iterdir()
    assert folder.name.startswith("ppo-20")


def test_mistakes_are_one_line(
    tmp_path: Path, settings: str, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = str(tmp_path / "run")
    (tmp_path / "wrong.yaml").write_text("ppo:\n  gama: 0.9\n", encoding="utf-8")
    status, line = complaint(capsys, "ppo", "--settings", str(tmp_path / "wrong.yaml"))
    assert status == 78
    assert "wrong.yaml:2: ppo.gama: unknown key; did you mean 'gamma'?" in line
    assert learn("ppo", "--settings", settings, "--folder", folder).exit_code == 0
    assert complaint(capsys, "ppo", "--folder", folder)[0] == 78
    status, line = complaint(capsys, "ppo", "--resume", folder)
    assert status == 78
    assert "is finished, with 128 steps; to train it for longer, give more in all" in line
    status, line = complaint(capsys, "ppo", "--resume", folder, "--seed", "2")
    assert status == 2
    assert "--seed cannot be given here" in line
    status, line = complaint(capsys, "ppo", "--resume", str(tmp_path))
    assert status == 78
    assert "it holds no settings.yaml" not in line  # there is one, but nothing else of a run
    for name, what in (("a.onnx", "of a policy file the value network is gone"), ("b", "no such")):
        (tmp_path / "a.onnx").touch()
        status, line = complaint(capsys, "ppo", "--from", str(tmp_path / name))
        assert status == 78
        assert what in line
    status, line = complaint(capsys, "ppo", "--seeds", "2", "--on", "robot")
    assert status == 2
    assert "there is only one robot" in line


def test_it_says_that_it_learns_from_whole_rollouts(tmp_path: Path, settings: str) -> None:
    found = learn("ppo", "--settings", settings, "--folder", str(tmp_path / "a"), "--steps", "65")
    assert "128 steps, in whole rollouts of 64 on simulation" in found.output
    assert "\n128 steps in " in found.output


def test_a_policy_that_never_swam_is_not_for_a_file(tmp_path: Path) -> None:
    idle = tmp_path / "idle.yaml"
    idle.write_text(
        SETTINGS.replace("n_epochs: 4", "n_epochs: 1, learning_rate: 1.0e-9"), encoding="utf-8"
    )
    found = learn(
        "ppo", "--settings", str(idle), "--folder", str(tmp_path / "run"), "--steps", "64"
    )
    assert found.exit_code == 0, found.output
    assert "it stalled in every evaluation; train it for longer" in found.output
    assert "learn export" not in found.output


def start(folder: Path, *arguments: str) -> "subprocess.Popen[str]":
    return subprocess.Popen(
        [FISHCTL, "learn", "ppo", "--folder", str(folder), "--steps", "1000000", *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def wait_for_rows(process: "subprocess.Popen[str]", folder: Path, number: int) -> None:
    table = folder / "progress.csv"
    deadline = time.monotonic() + PATIENCE
    while time.monotonic() < deadline and process.poll() is None:
        if table.exists() and len(rows(table)) >= number:
            return
        time.sleep(0.05)
    process.kill()
    raise AssertionError(f"it did not come to {number} updates: {process.communicate()}")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_leaves_a_checkpoint_to_go_on_from(
    tmp_path: Path, settings: str, number: int
) -> None:
    folder = tmp_path / "run"
    process = start(folder, "--settings", settings)
    wait_for_rows(process, folder, 2)
    process.send_signal(number)
    _, err = process.communicate(timeout=PATIENCE)
    assert process.returncode == 130, err
    done = checkpoints.read_state(checkpoints.newest(folder)).steps
    dropped = r"(, \d+ of an unfinished rollout dropped)?"
    go_on = re.escape(f"to go on: fishctl learn ppo --resume {folder}\n")
    assert re.fullmatch(f"fishctl: stopped after {done} steps{dropped}; {go_on}", err)
    assert int(rows(folder / "progress.csv")[-1]["steps"]) == done
    found = learn("ppo", "--resume", str(folder), "--steps", str(done + 64))
    assert found.exit_code == 0, found.output


def test_whatever_kills_it_the_checkpoints_are_whole(tmp_path: Path, settings: str) -> None:
    text = SETTINGS.replace("steps: 128", "steps: 128\ncheckpoint_every: 64")
    Path(settings).write_text(text, encoding="utf-8")
    folder = tmp_path / "run"
    process = start(folder, "--settings", settings)
    wait_for_rows(process, folder, 3)
    process.kill()
    process.communicate(timeout=PATIENCE)
    for checkpoint in folder.glob("step-*"):
        checkpoints.load_policy(checkpoint)
        checkpoints.read_state(checkpoint)
    done = checkpoints.read_state(checkpoints.newest(folder)).steps
    assert done >= 128
    assert learn("ppo", "--resume", str(folder), "--steps", str(done + 64)).exit_code == 0
    steps = [int(row["steps"]) for row in rows(folder / "progress.csv")]
    assert steps == list(range(64, done + 65, 64))


def test_on_a_terminal_it_shows_a_bar(tmp_path: Path, settings: str) -> None:
    ours, theirs = pty.openpty()
    process = subprocess.Popen(
        [FISHCTL, "learn", "ppo", "--settings", settings, "--folder", str(tmp_path / "run")],
        stdout=theirs,
        env={**os.environ, "TERM": "xterm", "COLUMNS": "120"},
    )
    os.close(theirs)
    shown = b""
    while True:
        try:
            piece = os.read(ours, 4096)
        except OSError:  # the other end is closed
            break
        if not piece:
            break
        shown += piece
    os.close(ours)
    assert process.wait(PATIENCE) == 0
    text = shown.decode()
    assert "128/128" in text
    assert "tank 0:0" in text
    assert "left" in text


@pytest.fixture
def daemon(tmp_path: Path):  # type: ignore[no-untyped-def]
    folder = tmp_path / "daemon"
    folder.mkdir()
    with running(folder, "--set", "simulation.noise=0.001", "--set", "tick=0.01") as found:
        yield found


@pytest.fixture
def hasty(settings: str) -> str:
    """Settings with evaluations that take little time in the tank."""
    text = SETTINGS.replace("seconds: 4.0, settle: 2.0", "seconds: 1.0, settle: 0.2, rest: 0.3")
    Path(settings).write_text(text, encoding="utf-8")
    return settings


def test_on_a_running_fishd_it_trains_at_its_tick_and_leaves_the_fish_at_rest(
    tmp_path: Path, hasty: str, daemon: Daemon
) -> None:
    folder = tmp_path / "run"
    found = learn(
        *("ppo", "--on", "robot", "--endpoint", daemon.endpoint),
        *("--settings", hasty, "--folder", str(folder)),
    )
    assert found.exit_code == 0, found.output
    config, _ = runs.read(folder)
    assert (config.tick, config.simulation.noise) == (0.01, 0.001)  # all of it is that of fishd
    assert found.stderr == ""
    assert [row["steps"] for row in rows(folder / "progress.csv")] == ["64", "128"]
    evaluations = rows(folder / "evaluations.csv")
    assert float(evaluations[0]["tank_time"]) >= 0.64 + 1.0  # those are swum in the tank, too
    card = checkpoints.read_card(checkpoints.newest(folder))
    assert (card.provenance.on, card.tick) == ("robot", 0.01)
    with Fish(daemon.endpoint) as fish:
        assert fish.status().mode == "idle"


def test_an_estop_ends_it_with_the_reason_and_a_checkpoint(
    tmp_path: Path, hasty: str, daemon: Daemon
) -> None:
    folder = tmp_path / "run"

    def press() -> None:
        while not (folder / "progress.csv").exists() or not rows(folder / "progress.csv"):
            time.sleep(0.05)
        with Fish(daemon.endpoint) as fish:
            fish.estop("the tail hit the glass")

    thread = threading.Thread(target=press, daemon=True)
    thread.start()
    found = learn(
        *("ppo", "--on", "robot", "--endpoint", daemon.endpoint, "--steps", "100000"),
        *("--settings", hasty, "--folder", str(folder)),
    )
    thread.join()
    assert found.return_value == 1
    assert found.stderr == (
        "fishctl: fishd is in mode estop: the tail hit the glass; "
        f"to go on: fishctl learn ppo --resume {folder} --endpoint {daemon.endpoint}\n"
    )
    assert checkpoints.read_state(checkpoints.newest(folder)).steps >= 64


def test_nothing_begins_while_an_emergency_stop_is_latched(tmp_path: Path, daemon: Daemon) -> None:
    with Fish(daemon.endpoint) as fish:
        fish.estop("the tail hit the glass")
    folder = tmp_path / "run"
    found = learn("ppo", "--on", "robot", "--endpoint", daemon.endpoint, "--folder", str(folder))
    assert "fishd is in mode estop: the tail hit the glass; " in str(found.exception)
    assert not folder.exists()


def test_another_plant_than_that_of_the_fishd_is_told(
    tmp_path: Path, hasty: str, daemon: Daemon
) -> None:
    found = learn(
        *("ppo", "--on", "robot", "--endpoint", daemon.endpoint, "--steps", "64"),
        *("--settings", hasty, "--folder", str(tmp_path / "run"), "--set", "plant.omega0=11"),
    )
    assert found.exit_code == 0, found.output
    assert "another plant than that of the fishd that runs: plant.omega0 is 11.0 here" in (
        found.stderr
    )


def test_a_configuration_that_is_not_that_of_the_fishd_is_explained(
    tmp_path: Path, daemon: Daemon, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "fish.yaml"
    file.write_text("amplitude_limit: 0.3\ntick: 0.01\n", encoding="utf-8")
    status, line = complaint(
        capsys, "ppo", "--on", "robot", "--endpoint", daemon.endpoint, "--config", str(file)
    )
    assert status == 78
    assert "amplitude_limit: 0.3 rad in this configuration, 0.42 rad in the fishd" in line


@pytest.mark.parametrize(("efficiency", "careful"), [(1.01, False), (1.1, True)])
def test_more_thrust_than_is_possible_is_said_to_be_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], efficiency: float, careful: bool
) -> None:
    best = Evaluation(128, 32.4, 0.028, efficiency, 1.67, 1.0, stalled=False)
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
