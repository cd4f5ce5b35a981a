"""`fishctl measure` on a real fishd: its result, its effect on fishd, and how it ends."""

import math
import signal
from pathlib import Path

import msgspec
import pytest
from rigs.processes import (
    EXPERIMENT,
    PATIENCE,
    Daemon,
    Process,
    Subscriber,
    call,
    one_line,
    running,
    wait_until,
)

from fishd.client import Fish
from fishd.core.errors import Refused


@pytest.fixture(scope="module")
def drifting(tmp_path_factory: pytest.TempPathFactory):  # type: ignore[no-untyped-def]
    with running(tmp_path_factory.mktemp("daemon"), "--set", "simulation.drift=0.005") as daemon:
        yield daemon


@pytest.fixture(autouse=True)
def runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Set the folder of all experiments."""
    monkeypatch.setenv("FISHD_RUNS", str(tmp_path))
    return tmp_path


@pytest.fixture
def daemon(drifting: Daemon) -> Daemon:
    return drifting.at_rest()


def start_measurement(daemon: Daemon) -> Process:
    """Start a measurement; return its process when the fish swims."""
    process = Process(*EXPERIMENT, "--endpoint", daemon.endpoint, "measure", "swing", "--for", "60")
    wait_until(lambda: daemon.status().mode == "running")
    return process


def test_it_finds_the_thrust_and_fishd_shows_it_from_then_on(daemon: Daemon) -> None:
    words = ("--endpoint", daemon.endpoint, "measure", "swing", "--for", "21", "--json")
    ended = call(*EXPERIMENT, *words)
    assert ended.returncode == 0, ended.stderr
    result = msgspec.json.decode(ended.stdout)
    assert result["thrust"] == pytest.approx(25.74e-3, abs=1.5e-3)
    # Ticks that a busy machine loses make it larger; tests in virtual time check its size.
    assert 0.0 < result["thrust_ci95"] < 0.1 * result["thrust"]
    assert daemon.status().mode == "idle"
    daemon.fishctl("set-controller", "swing")

    def is_shown() -> bool:
        status = daemon.status()
        ci95 = status.thrust_ci95 or math.inf
        return ci95 < 2e-3 and abs(status.thrust - result["thrust"]) <= ci95

    wait_until(is_shown)


@pytest.mark.parametrize("verb", ["measure", "compare"])
def test_a_length_that_is_too_short_is_refused_and_leaves_no_folder(
    daemon: Daemon, runs: Path, verb: str
) -> None:
    line = one_line(daemon.fishctl(verb, "swing", "--for", "5"))
    assert "a measurement of 5 s is not possible: 20.25 to 3600 s are needed" in line
    assert not list(runs.iterdir())


def test_another_controller_in_the_middle_ends_it_and_swims_on(daemon: Daemon) -> None:
    measuring = start_measurement(daemon)
    assert daemon.fishctl("set-controller", "square").returncode == 0
    status, out, err = measuring.finish()
    assert (status, out.count("\n")) == (1, 1)
    assert err.startswith(
        "fishctl: this program no longer holds the fish: square was set by hand: this measurement "
        "is lost; resume with: fishctl measure --resume "
    )
    assert daemon.status().controller == "square"


def test_another_parameter_in_the_middle_ends_it_too(daemon: Daemon) -> None:
    with Subscriber(daemon.telemetry, b"tick") as ticks:
        measuring = start_measurement(daemon)
        ticks.until(controller="swing", mode="running")
    assert daemon.fishctl("set-parameter", "C=0.1").returncode == 0
    status, _, err = measuring.finish()
    assert status == 1
    assert "another client changed the controller: swing continues with C=0.1" in err


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_whoever_ends_it_leaves_the_fish_at_rest(
    daemon: Daemon, how: signal.Signals, runs: Path
) -> None:
    status, out, err = start_measurement(daemon).end(how)
    assert (status, out.count("\n")) == (130, 1)
    (folder,) = runs.glob("[!.]*")
    resume = f"fishctl measure --resume {folder}"
    assert err == f"fishctl: interrupted, the fish rests; resume with: {resume}\n"
    assert daemon.status().mode == "idle"


def test_an_emergency_stop_ends_it_and_says_so(daemon: Daemon) -> None:
    measuring = start_measurement(daemon)
    daemon.fishctl("estop")
    status, _, err = measuring.finish()
    assert status == 1
    # The message names the mode of a tick or the refusal of a request, whichever comes first.
    assert "estop" in err
    assert "requested with fishctl" in err
    assert daemon.status().mode == "estop"


def test_what_is_no_factor_is_refused_and_stops_no_fish(daemon: Daemon) -> None:
    with Fish(daemon.endpoint, timeout=PATIENCE) as fish:
        for factor, error in ((1e308, 1.0), (0.0, 1.0), (1.0, 1e308), (-1.0, 1.0)):
            with pytest.raises(Refused, match="calibrate-thrust: "):
                fish.calibrate_thrust(factor, error)
        assert fish.status().mode == "idle"
