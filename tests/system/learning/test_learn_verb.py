import contextlib
import os
import pty
import re
import signal
import subprocess
from concurrent.futures import ThreadPoolExecutor
from functools import partialmethod
from pathlib import Path
from typing import Any

import msgspec
import pytest
from rich.progress import Progress
from rigs.processes import PATIENCE, Daemon, fishctl, one_line
from rigs.swimming import brief_job, rows, while_it_trains

from fishd.cli.learn.ppo import print_outcome
from fishd.cli.main import fishctl as commands
from fishd.client import Fish
from fishd.config import load
from fishd.learning.env.evaluation import Evaluation
from fishd.learning.links import fishd_link
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
    """Return the exit status and the one line on standard error."""
    done = learn(*arguments)
    return done.returncode, one_line(done)


def test_a_run_a_resume_and_a_run_that_begins_with_its_networks(
    tmp_path: Path, settings: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    result = learn("ppo", "--settings", settings, "--steps", "65")
    assert result.returncode == 0, result.stderr
    assert "128 steps, in whole rollouts of 64 in simulation" in result.stdout
    assert re.search("\n128 steps in 0:0. of tank time without evaluations\n", result.stdout)
    (folder,) = Path("runs").glob("[!.]*")
    assert folder.name.startswith("ppo-20")
    assert result.stdout.count(" in the tank without evaluations: ") >= 2  # one per evaluation
    result = learn("ppo", "--resume", str(folder), "--steps", "192")
    assert result.returncode == 0, result.stderr
    assert f"resumed from {folder}/step-000128" in result.stdout
    assert [row["steps"] for row in rows(folder / "progress.csv")] == ["64", "128", "192"]
    result = learn("ppo", "--fine-tune", str(folder), "--folder", "second", "--steps", "64")
    assert result.returncode == 0, result.stderr
    assert runs.read(Path("second"))[1].ppo == runs.read(folder)[1].ppo
    note = checkpoints.read_card(checkpoints.newest(Path("second"))).provenance.note
    assert note.startswith("began with ppo-20")


def test_the_result_of_a_training_is_printed_as_json(tmp_path: Path, settings: str) -> None:
    folder = str(tmp_path / "run")
    done = learn("ppo", "--settings", settings, "--steps", "64", "--folder", folder, "--json")
    assert done.returncode == 0, done.stderr
    result = msgspec.json.decode(done.stdout)
    assert (result["folder"], result["steps"], result["ended"]) == (folder, 64, "finished")


def test_mistakes_are_one_line(tmp_path: Path) -> None:
    folder = str(tmp_path / "run")
    (tmp_path / "wrong.yaml").write_text("ppo:\n  gama: 0.9\n", encoding="utf-8")
    status, line = complaint("ppo", "--settings", str(tmp_path / "wrong.yaml"))
    assert status == 78
    assert "wrong.yaml:2: ppo.gama: unknown key; did you mean 'gamma'?" in line
    status, line = complaint("ppo", "--resume", folder, "--seed", "2")
    assert status == 2
    assert "--seed cannot be given with --resume" in line
    status, line = complaint("ppo", "--resume", str(tmp_path))
    assert status == 78
    assert "it has no settings.yaml" in line
    (tmp_path / "several" / "seed-0").mkdir(parents=True)
    status, line = complaint("ppo", "--resume", str(tmp_path / "several"))
    assert status == 1
    assert "holds several trainings, seed-0 to seed-0; name one of them" in line
    for name, what in (("a.onnx", "a policy file has no value network"), ("b", "no such")):
        (tmp_path / "a.onnx").touch()
        status, line = complaint("ppo", "--fine-tune", str(tmp_path / name))
        assert status == 78
        assert what in line
    status, line = complaint("ppo", "--seeds", "2", "--on", "live")
    assert status == 2
    assert "there is only one live fish" in line


def test_no_export_is_advised_for_a_policy_that_never_swam(tmp_path: Path) -> None:
    idle = tmp_path / "idle.yaml"
    slow = SETTINGS.replace("n_epochs: 4", "n_epochs: 1, learning_rate: 1.0e-9")
    idle.write_text(slow, encoding="utf-8")
    folder = str(tmp_path / "run")
    result = learn("ppo", "--settings", str(idle), "--folder", folder, "--steps", "64")
    assert result.returncode == 0, result.stderr
    assert "it stalled in every evaluation; train it for longer" in result.stdout
    assert "learn export" not in result.stdout


ENDLESS = ("--steps", "1000000")


def updates(folder: Path) -> int:
    """Return the number of updates of a run."""
    table = folder / "progress.csv"
    return len(rows(table)) if table.exists() else 0


def test_a_signal_leaves_a_checkpoint_to_resume_from(tmp_path: Path, settings: str) -> None:
    folder = tmp_path / "run"
    result = while_it_trains(
        lambda: updates(folder) >= 2,
        lambda: os.kill(os.getpid(), signal.SIGHUP),
        *("learn", "ppo", "--folder", str(folder), *ENDLESS, "--settings", settings),
    )
    assert result.returncode == 130, result.stderr
    done = checkpoints.read_state(checkpoints.newest(folder)).steps
    dropped = r"(, \d+ of an unfinished rollout dropped)?"
    go_on = re.escape(f"resume with: fishctl learn ppo --resume {folder}\n")
    assert re.fullmatch(f"fishctl: stopped after {done} steps{dropped}; {go_on}", result.stderr)
    assert int(rows(folder / "progress.csv")[-1]["steps"]) == done
    result = learn("ppo", "--resume", str(folder), "--steps", str(done + 64))
    assert result.returncode == 0, result.stderr


def test_on_a_terminal_a_training_shows_a_bar(
    tmp_path: Path, settings: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "120")
    # A training of a moment may end before the next refresh.
    monkeypatch.setattr(Progress, "update", partialmethod(Progress.update, refresh=True))
    ours, theirs = pty.openpty()

    def read_terminal() -> str:
        pieces = []
        with contextlib.suppress(OSError):  # the other end is closed
            while piece := os.read(ours, 4096):
                pieces.append(piece)
        os.close(ours)
        return b"".join(pieces).decode()

    command = ["learn", "ppo", "--settings", settings, "--folder", str(tmp_path / "run")]
    with ThreadPoolExecutor(1) as reader:
        text = reader.submit(read_terminal)
        with os.fdopen(theirs, "w") as terminal, contextlib.redirect_stderr(terminal):
            assert commands.main(command, standalone_mode=False) == 0
    assert "128 of 128 steps" in text.result()
    assert "tank 0:0" in text.result()
    assert "left" in text.result()


@pytest.fixture
def hasty(settings: str) -> str:
    """Settings with short rollouts, and without evaluations."""
    text = SETTINGS.replace("every: 1, patience: null, seconds: 4.0, settle: 2.0", "every: 0")
    text = text.replace("n_steps: 64", "n_steps: 16, batch_size: 16").replace("128", "32")
    Path(settings).write_text(text, encoding="utf-8")
    return settings


@pytest.mark.realtime
def test_a_training_on_a_running_fishd_uses_its_tick_and_leaves_the_fish_at_rest(
    tmp_path: Path, hasty: str, daemon: Daemon
) -> None:
    folder = tmp_path / "run"
    live = ("ppo", "--on", "live", "--endpoint", daemon.endpoint)
    result = learn(*live, "--settings", hasty, "--folder", str(folder))
    assert result.returncode == 0, result.stderr
    config, _ = runs.read(folder)
    # The configuration is that of fishd
    assert (config.tick, config.simulation.noise) == (0.05, 0.001)
    assert result.stderr == ""
    assert [row["steps"] for row in rows(folder / "progress.csv")] == ["16", "32"]
    card = checkpoints.read_card(checkpoints.newest(folder))
    assert (card.provenance.on, card.tick) == ("live", 0.05)
    with Fish(daemon.endpoint, timeout=PATIENCE) as fish:
        assert fish.status().mode == "idle"


@pytest.mark.realtime
def test_an_estop_ends_a_training_with_the_reason_and_a_checkpoint_and_no_other_begins(
    tmp_path: Path, hasty: str, daemon: Daemon
) -> None:
    folder = tmp_path / "run"

    def press() -> None:
        with Fish(daemon.endpoint, timeout=PATIENCE) as fish:
            fish.estop("the tail hit the glass")

    on = ("ppo", "--on", "live", "--endpoint", daemon.endpoint)
    result = while_it_trains(
        lambda: updates(folder),
        press,
        *("learn", *on, *ENDLESS, "--settings", hasty, "--folder", str(folder)),
    )
    why = (
        "fishctl: fishd is in mode estop: the tail hit the glass; when that is mended, leave it "
        "with 'fishctl clear-fault'"
    )
    go_on = f"; resume with: fishctl learn ppo --resume {folder} --endpoint {daemon.endpoint}\n"
    assert (result.returncode, result.stderr) == (1, why + go_on)
    assert checkpoints.read_state(checkpoints.newest(folder)).steps >= 16
    result = learn(*on, "--folder", str(tmp_path / "other"))
    assert why in result.stderr
    assert not (tmp_path / "other").exists()


def test_a_configuration_unlike_that_of_fishd_is_explained(tmp_path: Path, daemon: Daemon) -> None:
    file = tmp_path / "fish.yaml"
    file.write_text("amplitude_limit: 0.3\ntick: 0.05\n", encoding="utf-8")
    live = ("ppo", "--on", "live", "--endpoint", daemon.endpoint)
    status, line = complaint(*live, "--config", str(file))
    assert status == 78
    assert "amplitude_limit: 0.3 rad in this configuration, 0.42 rad in the fishd" in line


@pytest.mark.parametrize(
    ("relative_thrust", "error", "careful"),
    [(1.01, None, False), (1.1, None, True), (1.1, 0.001, True), (1.1, 0.003, False)],
)
def test_more_thrust_than_is_possible_is_warned_of(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    relative_thrust: float,
    error: float | None,
    careful: bool,
) -> None:
    best = Evaluation(
        thrust=0.028,
        thrust_ci95=error,
        relative_thrust=relative_thrust,
        frequency=1.67,
        fullness=1.0,
        is_stalled=False,
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
    assert print_outcome(outcome, brief_job(tmp_path / "tank")) == 0
    output = capsys.readouterr().out
    assert ("careful: that is more than the best square wave" in output) is careful
    assert "learn export" in output


@pytest.mark.parametrize("changes", [(), ("--set", "plant.omega0=11")])
def test_a_training_on_a_robot_reads_the_configuration_of_fishd_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, changes: tuple[str, ...]
) -> None:
    endpoints: list[str | None] = []

    def config_of(endpoint: str | None) -> dict[str, Any]:
        endpoints.append(endpoint)
        config: dict[str, Any] = msgspec.to_builtins(load())
        return config

    monkeypatch.setattr(fishd_link, "config_of", config_of)
    endpoint = f"ipc://{tmp_path}/nobody"
    result = learn("ppo", "--on", "live", "--endpoint", endpoint, *changes)
    assert "no process listens there" in result.stderr
    assert endpoints == [endpoint]
    assert ("plant.omega0 is 11.0 here, 12.5 there" in result.stderr) is bool(changes)


def test_a_training_is_drawn_at_its_end_and_later(tmp_path: Path) -> None:
    picture = tmp_path / "training.png"
    words = ("--on", "simulation", "--steps", "64", "--folder", str(tmp_path / "run"))
    assert fishctl("learn", "ppo", *words, "--plot", str(picture)).returncode == 0
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert fishctl("plot", str(tmp_path / "run")).returncode == 0
    assert (tmp_path / "run" / "run.png").read_bytes() == picture.read_bytes()
