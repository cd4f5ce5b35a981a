"""`fishctl learn ppo --see camera` with a true fishd, and a true fishd-camera above its fish."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

import pytest
from rigs.camera_process import CameraProcess, running_camera
from rigs.processes import Daemon, fishctl, running, sets
from rigs.swimming import rows, while_it_trains

from fishd.learning.links import fishd_link

if find_spec("torch") is None:
    pytest.skip("learning needs torch", allow_module_level=True)

BRIEF = """
see: camera
steps: 320
camera: {random_excitation: 128}
ppo: {n_steps: 64}
evaluation: {every: 0}
"""
BRIEFEST = """
see: camera
camera: {random_excitation: 64}
ppo: {n_steps: 32, batch_size: 32}
evaluation: {every: 0}
"""


class Rig(NamedTuple):
    daemon: Daemon
    camera: CameraProcess
    words: tuple[str, ...]
    """Command line of a training on the rig."""
    folder: Path


@contextmanager
def rig_of(folder: Path, *settings: str, brief: str = BRIEF) -> Iterator[Rig]:
    file = folder / "brief.yaml"
    file.write_text(brief, encoding="utf-8")
    run = folder / "run"
    with running(folder, *sets(*settings)) as daemon:
        fishd = f"simulated.fishd={daemon.endpoint}"
        with running_camera(folder, fishd) as camera:
            on = ("--on", "live", "--endpoint", daemon.endpoint, "--camera", camera.endpoint)
            words = ("learn", "ppo", *on, "--settings", str(file), "--folder", str(run))
            yield Rig(daemon, camera, words, run)


@pytest.fixture
def lockstep(tmp_path: Path) -> Iterator[Rig]:
    agent = f"start.parameters.agent=ipc://{tmp_path}/agent"
    with rig_of(tmp_path, "lockstep=true", "start.controller=remote", agent) as rig:
        yield rig


def test_it_learns_from_the_frames_of_each_tick_in_lockstep(lockstep: Rig) -> None:
    done = fishctl(*lockstep.words)
    assert done.returncode == 0, done.stderr
    assert "from pictures with the feature extractor modes" in done.stdout
    table = rows(lockstep.folder / "progress.csv")
    assert [row["steps"] for row in table] == ["192", "256", "320"]
    assert {row["lost_ticks"] for row in table} == {"0"}


@pytest.mark.realtime
def test_a_camera_that_dies_ends_training(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with rig_of(tmp_path, "tick=0.05", "start.controller=hold", brief=BRIEFEST) as rig:
        begun = rig.folder / "progress.csv"

        def kill_camera() -> None:
            rig.camera.process.send_signal(signal.SIGKILL)
            monkeypatch.setattr(fishd_link, "FRAMES_TIMEOUT_S", 2.0)

        done = while_it_trains(
            lambda: begun.exists() and rows(begun), kill_camera, *rig.words, *("--steps", "100000")
        )
        assert done.returncode == 1
        assert f"camera at {rig.camera.endpoint}" in done.stderr
        assert "; resume with: fishctl learn ppo --resume" in done.stderr
        assert rig.daemon.status().mode == "idle"


def test_without_a_camera_nothing_begins(tmp_path: Path) -> None:
    with rig_of(tmp_path) as rig:
        rig.camera.process.kill()
        rig.camera.process.wait()
        done = fishctl(*rig.words)
        assert done.returncode == 1
        assert "start one with 'fishd-camera'" in done.stderr
        assert not rig.folder.exists()


def test_a_camera_of_another_size_is_refused(tmp_path: Path) -> None:
    with rig_of(tmp_path) as rig:
        file = tmp_path / "brief.yaml"
        text = BRIEF.replace("random_excitation: 128", "random_excitation: 128, stack: {size: 42}")
        file.write_text(text, encoding="utf-8")
        done = fishctl(*rig.words)
        assert done.returncode == 1
        assert "shows 84 x 84; start it with --set picture.size=42" in done.stderr
