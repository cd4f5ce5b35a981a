"""`fishctl camera` on a real fishd-camera above a real fishd."""

import json
import re
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import pytest
from rigs.camera_process import CameraProcess, running_camera
from rigs.processes import (
    FISHCTL,
    PATIENCE,
    Daemon,
    Process,
    Subscriber,
    fishctl,
    one_line,
    running,
    sets,
    wait_until,
)

from fishd.camera.settings import load
from fishd.client import Fish

TICK = 0.05
OFF, TILT, LATENCY = 3.0, 0.04, 0.03
CAMERA = (
    "simulated.rate=30", f"simulated.latency={LATENCY}", "simulated.jitter=0.003",
    f"simulated.off_axis={OFF}", f"simulated.tilt={TILT}", "simulated.noise=6",
    "simulated.caustics=12",
)  # fmt: skip


DAEMON = sets("control.lease=10")  # it outlasts a program that is stopped for 3 s


@pytest.fixture(scope="module")
def camera(
    shared_daemon: Daemon, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[CameraProcess]:
    folder = tmp_path_factory.mktemp("camera")
    with running_camera(folder, f"simulated.fishd={shared_daemon.endpoint}", *CAMERA) as camera:
        camera.until(lambda state: state.seq > 30)
        yield camera


@pytest.fixture
def daemon(shared_daemon: Daemon, camera: CameraProcess) -> Daemon:
    """The fishd, at rest."""
    return shared_daemon.at_rest()


@pytest.fixture
def swimming(daemon: Daemon) -> Daemon:
    with Fish(daemon.endpoint, timeout=PATIENCE) as fish:
        fish.set_controller("swing")
    return daemon


@pytest.fixture(autouse=True)
def _addresses(daemon: Daemon, camera: CameraProcess, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FISHD_ENDPOINT", daemon.endpoint)
    monkeypatch.setenv("FISHD_CAMERA", camera.endpoint)


def output_of(*words: str | Path) -> str:
    """Return the output of a verb that succeeds."""
    done = fishctl("camera", *map(str, words))
    assert done.returncode == 0, done.stderr
    return done.stdout


def json_of(*words: str) -> Any:
    return json.loads(output_of(*words, "--json"))


def width_of(picture: Path) -> int:
    image = cv2.imread(str(picture))
    return image.shape[1]


def test_status_says_how_the_camera_is(camera: CameraProcess, daemon: Daemon) -> None:
    shown = output_of("status")
    described = f"a simulated camera above the fish at {daemon.endpoint}"
    assert re.search(rf"^camera +{described}$", shown, re.M)
    assert re.search(r"^state +streaming for 0:\d\d:\d\d$", shown, re.M)
    assert re.search(r"^rate +(29|30|31)\.\d frames a second$", shown, re.M)
    assert re.search(r"^age +\d+\.\d ms when available, exposed for 10\.0 ms$", shown, re.M)
    assert re.search(rf"^process +fishd-camera .*, pid {camera.process.pid}, up 0:", shown, re.M)
    assert json_of("status")["session"] == camera.status().session


def test_without_a_camera_a_verb_says_so_in_one_line(tmp_path: Path) -> None:
    nowhere = f"ipc://{tmp_path}/nobody"
    assert re.match(
        rf"fishctl: no camera at {nowhere}: .*start one with 'fishd-camera', or name another with "
        r"--camera or \$FISHD_CAMERA, for the page with 'cameras' in its settings\n",
        one_line(fishctl("camera", "status", "--camera", nowhere)),
    )


def test_a_view_is_a_file_with_a_line_or_json_about_it(tmp_path: Path) -> None:
    now = tmp_path / "now.png"
    assert re.fullmatch(
        rf"{now}: frame \d+, \d+ ms old when it came\n", output_of("view", "--plot", now)
    )
    assert width_of(now) == 84 * 7
    facts = json.loads(output_of("view", "--json", "--whole", "--plot", tmp_path / "whole.png"))
    assert facts["path"] == str(tmp_path / "whole.png")
    assert facts["frame"] > 0
    assert 0.0 < facts["age"] < PATIENCE
    assert width_of(tmp_path / "whole.png") >= 84


def test_a_picture_of_another_kind_is_refused_at_once(tmp_path: Path) -> None:
    for verb in ("view", "align"):
        done = fishctl("camera", verb, "--plot", str(tmp_path / "a.jpg"))
        assert done.returncode == 2
        assert "a name ending in .png is needed" in one_line(done)


def test_a_picture_that_cannot_be_written_is_refused_before_the_fish_swims(
    daemon: Daemon, tmp_path: Path
) -> None:
    with Subscriber(daemon.telemetry, b"tick") as ticks:
        done = fishctl("camera", "align", "--swim", "--plot", f"{tmp_path}/nowhere/a.png")
        seen = [ticks.message() for _ in range(3)]
    assert done.returncode == 2
    assert "its folder does not exist; create it" in one_line(done)
    assert {tick["mode"] for tick in seen} == {"idle"}
    looked = fishctl("camera", "view", "--plot", f"{tmp_path}/nowhere/a.png")
    assert "its folder does not exist; create it" in one_line(looked)


def test_alignment_needs_a_fish_that_swims(daemon: Daemon) -> None:
    complaint = one_line(fishctl("camera", "align"))
    assert complaint == (
        "fishctl: the fish rests (mode idle), so nothing moves: let it swim, with 'fishctl "
        "set-controller swing', or add --swim\n"
    )


def test_a_fish_that_swims_without_moving_has_no_axis(daemon: Daemon) -> None:
    daemon.wait_until_still()
    with Fish(daemon.endpoint, timeout=PATIENCE) as fish:
        fish.set_controller("hold")
    complaint = one_line(fishctl("camera", "align", "--for", "3"))
    assert "let the fish swim, and see that the camera looks at its tail" in complaint


def test_alignment_finds_the_axis_within_a_pixel(swimming: Daemon, tmp_path: Path) -> None:
    alignment = json_of("align", "--for", "8", "--plot", str(tmp_path / "motion.png"))
    assert alignment["offset"] == pytest.approx(OFF, abs=1.0)
    assert alignment["tilt"] == pytest.approx(TILT, abs=0.02)
    assert not alignment["is_aligned"]
    assert alignment["settings"]["simulated.off_axis"] == pytest.approx(0.0, abs=1.0)
    assert width_of(tmp_path / "motion.png") == 84 * 7


def test_alignment_lets_the_fish_swim_with_swim_then_rest(daemon: Daemon, tmp_path: Path) -> None:
    done = fishctl("camera", "align", "--swim", "--for", "5")
    assert done.returncode == 0, done.stderr
    assert done.stderr == "fishctl: it swims for 5 s; Ctrl-C stops it\n"
    assert re.search(r"^offset +\d\.\d px below the middle row$", done.stdout, re.M)
    assert re.search(r"^tilt +\d\.\d°, down to the right$", done.stdout, re.M)
    pasted = re.search(r"write into the file of the camera:\n(.+)\nor try: (.+)", done.stdout, re.S)
    (tmp_path / "camera.yaml").write_text(pasted[1])
    off_axis = load(tmp_path / "camera.yaml").simulated.off_axis
    assert off_axis == pytest.approx(0.0, abs=1.0)
    assert f"fishd-camera --set simulated.off_axis={off_axis}" in pasted[2]
    assert daemon.status().mode == "idle"


def test_a_swim_goes_on_after_the_program_was_itself_held_up(daemon: Daemon) -> None:
    process = Process(FISHCTL, "camera", "align", "--swim", "--for", "6")
    with Fish(daemon.endpoint, timeout=PATIENCE) as fish:
        wait_until(lambda: fish.status().mode == "running")
        ticks = fish.ticks()
        first = next(ticks).seq
        process.stop()
        try:
            wait_until(lambda: next(ticks).seq > first + 3.0 / TICK)
        finally:
            process.process.send_signal(signal.SIGCONT)
        status, out, err = process.finish()
    assert status == 0, err
    assert out.startswith("offset")


def test_ctrl_c_stops_the_fish(daemon: Daemon) -> None:
    process = Process(FISHCTL, "camera", "latency")
    with Fish(daemon.endpoint, timeout=PATIENCE) as fish:
        deadline = time.monotonic() + PATIENCE
        while fish.status().mode != "running":
            assert time.monotonic() < deadline
            time.sleep(0.05)
        status, out, err = process.end(signal.SIGINT)
        assert (status, out) == (130, "")
        assert err.splitlines()[-1] == "fishctl: interrupted: the fish rests, nothing is measured"
        assert fish.status().mode == "idle"


@pytest.mark.realtime
def test_the_latency_of_the_whole_path_is_measured_within_milliseconds(daemon: Daemon) -> None:
    latency = json_of("latency", "--for", "30")
    assert latency["stamps"] == pytest.approx(0.0, abs=3e-3)
    assert latency["arrival"] >= LATENCY - 1e-3
    assert latency["delay"] == pytest.approx(latency["arrival"], abs=3e-3)
    assert latency["ci95"] < 4e-3
    assert latency["latest"] < 0.1
    assert latency["stack_delay"] == 0.0
    assert latency["advice"][-1] == "young enough for learning: nothing to set in a training"
    assert daemon.status().mode == "idle"


def test_a_fishd_in_lockstep_does_not_swim(tmp_path: Path) -> None:
    with (
        running(tmp_path, "--set", "lockstep=true") as daemon,
        running_camera(tmp_path, f"simulated.fishd={daemon.endpoint}") as camera,
    ):
        camera.until(lambda state: state.virtual)
        words = ("--endpoint", daemon.endpoint, "--camera", camera.endpoint)
        complaint = one_line(fishctl("camera", "align", "--swim", "--for", "3", *words))
    assert "lockstep" in complaint
