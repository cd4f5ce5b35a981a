"""The fin angle from a real fishd-camera above a real fishd: learned, shown, recorded."""

import contextlib
import json
import signal
import subprocess
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas
import pytest
from msgspec import UNSET
from rigs.camera_process import CameraProcess, running_camera
from rigs.processes import (
    FISHCTL,
    PATIENCE,
    Daemon,
    Process,
    fishctl,
    one_line,
    running,
    wait_until,
)

from fishd.camera.client import CameraClient
from fishd.client import Fish
from fishd.config import load
from fishd.core.errors import RecordingError
from fishd.lab.simulation import simulate
from fishd.recording import open_run

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("tail")


@pytest.fixture(scope="module")
def daemon(folder: Path) -> Iterator[Daemon]:
    with running(folder) as daemon:
        yield daemon


def settings(daemon: Daemon, learned: Path) -> tuple[str, ...]:
    small = ("simulated.width=320", "simulated.height=240")
    return (
        f"simulated.fishd={daemon.endpoint}",
        "simulated.rate=30",
        f"tail.learned={learned}",
        *small,
    )


@pytest.fixture(scope="module")
def camera(folder: Path, daemon: Daemon) -> Iterator[CameraProcess]:
    """The camera, which has learned the tail of the resting and swimming fish."""
    with running_camera(folder, *settings(daemon, folder / "tail.bin")) as camera:
        camera.is_in("streaming")
        refused = fishctl("camera", "measure", "--camera", camera.endpoint)
        assert "run 'fishctl camera measure --learn'" in one_line(refused)
        done = measure(daemon, camera, "--learn", "--json")
        assert done.returncode == 0, done.stderr
        assert json.loads(done.stdout)["zero_ci95"] < 2e-3
        assert (folder / "tail.bin").exists()
        yield camera


def measure(daemon: Daemon, camera: CameraProcess, *words: str) -> subprocess.CompletedProcess[str]:
    addresses = ("--endpoint", daemon.endpoint, "--camera", camera.endpoint)
    return fishctl("camera", "measure", *addresses, *words)


def wait_for_line(*words: str, ending: str) -> str:
    """Return the first line with this ending that a verb prints; a verb that ends is repeated."""
    lines: list[str] = []

    def has_shown() -> bool:
        with Process(FISHCTL, *words) as process:
            assert process.process.stdout
            for line in process.process.stdout:
                if line.rstrip().endswith(ending):
                    lines.append(line)
                    return True
        return False

    wait_until(has_shown)
    return lines[0]


def swim(daemon: Daemon, controller: str) -> None:
    with Fish(daemon.endpoint, timeout=PATIENCE) as fish:
        fish.set_controller(controller)


def wait_for_rest(daemon: Daemon) -> None:
    latest: deque[float] = deque(maxlen=20)
    with Fish(daemon.endpoint, timeout=PATIENCE) as fish:
        for tick in fish.ticks():
            assert tick.alpha is not UNSET
            latest.append(abs(tick.alpha))
            if len(latest) == 20 and max(latest) < 1e-3:
                return


def test_a_recording_has_the_true_fin_angle_at_its_ticks(
    daemon: Daemon, camera: CameraProcess, folder: Path
) -> None:
    swim(daemon, "swing")
    words = ("--endpoint", daemon.endpoint, "record", "run", "--folder", str(folder))
    process = Process(FISHCTL, *words, "--camera", camera.endpoint)

    def has_enough() -> bool:
        with contextlib.suppress(RecordingError, FileNotFoundError):  # not yet begun
            part = open_run(folder / "run.mcap.part")
            return bool(part.tails) and part.frame()["fin_angle"].count() > 40
        return False

    wait_until(has_enough)
    assert process.end(signal.SIGINT)[0] in (0, 3)  # a busy machine may lose frames
    run = open_run(folder / "run.mcap")
    assert run.problem == ""
    seen = {head.seq for head in run.frame_heads}
    assert {tail.seq for tail in run.tails if tail.seq >= min(seen)} <= seen
    table = run.frame()
    error = (table["fin_angle"] - table["alpha"]).dropna()
    assert len(error) > 20
    assert np.abs(error).max() < 0.01
    assert error.std() < 2e-3


def test_it_is_shown_live_with_its_maximum_and_its_lag(
    daemon: Daemon, camera: CameraProcess
) -> None:
    swim(daemon, "swing")
    tails = measure(daemon, camera, "--json", "--for", "2").stdout.splitlines()
    assert len(tails) > 3
    assert {len(json.loads(line)["midline"]) for line in tails} == {16}
    with Fish(daemon.endpoint, timeout=PATIENCE) as fish:
        assert fish.status().controller == "swing"
    addresses = ("--endpoint", daemon.endpoint, "--camera", camera.endpoint)
    shown = wait_for_line("camera", "measure", *addresses, ending=" ms after φ_c")
    assert shown.startswith("fin angle ")
    assert " rad, maximum 0." in shown
    assert " rad, maximum 0." in wait_for_line("watch", *addresses, ending=" ms after φ_c")
    state = fishctl("camera", "status", "--camera", camera.endpoint).stdout
    assert "measured in " in state


def test_an_experiment_measures_the_largest_fin_angle(
    daemon: Daemon, camera: CameraProcess, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    swim(daemon, "hold")
    monkeypatch.setenv("FISHD_CAMERA", camera.endpoint)
    wave = ("--frequency", "1", "--amplitude", "0.3")  # a swing within the learned one
    results: list[Any] = []

    def has_maximum() -> bool:
        """Measure; a busy machine may lose the pictures of too many reversals."""
        target = folder / f"measure-{len(results)}"
        words = ("--for", "21", "--folder", str(target), "--tail", "--json")
        done = fishctl("--endpoint", daemon.endpoint, "measure", "square", *wave, *words)
        assert done.returncode == 0, done.stderr
        assert len(open_run(target / "measure.mcap").tails) > 20
        results.append(json.loads(done.stdout))
        return results[-1]["fin_angle_max"] is not None

    assert any(has_maximum() for _ in range(4))
    result = results[-1]
    truth = simulate(load(), "square", {"frequency": 1.0, "amplitude": 0.3}).fin_amplitude
    assert result["fin_angle_max"] == pytest.approx(truth, rel=0.02)
    assert 0.0 < result["fin_angle_max_ci95"] < 0.01


def test_each_point_of_a_sweep_has_the_largest_fin_angle(
    daemon: Daemon, camera: CameraProcess, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    swim(daemon, "hold")
    monkeypatch.setenv("FISHD_CAMERA", camera.endpoint)
    waves = ("--frequency", "1,1.4", "--amplitude", "0.3")  # swings within the learned one
    target = folder / "sweep"
    words = ("--on", "live", "--for", "21", "--folder", str(target), "--tail")
    done = fishctl("--endpoint", daemon.endpoint, "sweep", "square", *waves, *words)
    assert done.returncode == 0, done.stderr
    table = pandas.read_csv(target / "rows.csv")
    assert list(table["parameters.frequency"]) == [1.0, 1.4]
    known = table.dropna(subset="fin_angle_max")  # a busy machine may lose too many pictures
    assert len(known) or "fin angles are unknown" in done.stderr
    for _, row in known.iterrows():
        wave = {"frequency": row["parameters.frequency"], "amplitude": 0.3}
        truth = simulate(load(), "square", wave).fin_amplitude
        assert row["fin_angle_max"] == pytest.approx(truth, rel=0.02)


def test_an_experiment_without_a_camera_is_refused_before_the_fish_swims(
    daemon: Daemon, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ("measure", "swing", "--tail", "--folder", str(tmp_path / "measure"))
    monkeypatch.setenv("FISHD_CAMERA", f"ipc://{tmp_path}/none")
    refused = one_line(fishctl("--endpoint", daemon.endpoint, *words))
    assert "no camera at" in refused
    with running_camera(tmp_path, *settings(daemon, tmp_path / "tail.bin")) as other:
        monkeypatch.setenv("FISHD_CAMERA", other.endpoint)
        words = (*words[:-1], str(tmp_path / "second"))
        assert "run 'fishctl camera measure --learn'" in one_line(
            fishctl("--endpoint", daemon.endpoint, *words)
        )


def test_a_camera_that_starts_again_measures_at_once(
    daemon: Daemon, camera: CameraProcess, folder: Path, tmp_path: Path
) -> None:
    with running_camera(tmp_path, *settings(daemon, folder / "tail.bin")) as second:
        state = second.until(lambda state: state.measured_pictures > 3)
        assert (state.tail, state.tail_learned) == ("measuring", camera.status().tail_learned)


def test_a_fish_that_another_client_lets_swim_is_not_disturbed(
    daemon: Daemon, camera: CameraProcess, tmp_path: Path
) -> None:
    with running_camera(tmp_path, *settings(daemon, tmp_path / "tail.bin")) as other:
        other.is_in("streaming")
        swim(daemon, "hold")
        wait_for_rest(daemon)
        nothing = measure(daemon, other, "--learn", "--for", "8")
        assert "fishctl: nothing swings: let the fish swim" in nothing.stderr
        assert other.status().tail == "unlearned"
        swim(daemon, "swing")
        done = measure(daemon, other, "--learn", "--for", "8")
        assert "the fish was not seen at rest" in done.stdout
        with Fish(daemon.endpoint, timeout=PATIENCE) as fish:
            assert fish.status().controller == "swing"


def test_a_camera_measures_on_when_learning_is_interrupted(
    daemon: Daemon, camera: CameraProcess
) -> None:
    before = camera.until(lambda state: state.tail == "measuring")
    addresses = ("--endpoint", daemon.endpoint, "--camera", camera.endpoint)
    with Process(FISHCTL, "camera", "measure", "--learn", *addresses) as process:
        camera.until(lambda state: state.tail == "learning")
        status, _, said = process.end(signal.SIGINT)
    assert status == 130
    assert "fishctl: interrupted: nothing is learned" in said
    after = camera.status()
    assert (after.tail, after.tail_learned) == ("measuring", before.tail_learned)


def test_learning_that_another_client_ends_is_no_success(
    daemon: Daemon, camera: CameraProcess, monkeypatch: pytest.MonkeyPatch
) -> None:
    def cancel(client: CameraClient, _: float) -> None:
        client.requests.cancel_tail()

    swim(daemon, "swing")
    monkeypatch.setattr("fishd.cli.camera.measure._watch_swim", cancel)
    done = measure(daemon, camera, "--learn")
    assert "nothing is learned: another client has ended it; learn again" in one_line(done)


def test_a_fish_that_is_taken_ends_no_learning_of_another_client(
    daemon: Daemon, camera: CameraProcess
) -> None:
    with Fish(daemon.endpoint, timeout=PATIENCE) as fish, camera.client() as client:
        fish.stop()
        client.requests.learn_tail()
        with fish.lease("experiment"):
            done = measure(daemon, camera, "--learn")
        assert "the fish is taken" in one_line(done)
        assert client.status().tail == "learning"
        client.requests.cancel_tail()
