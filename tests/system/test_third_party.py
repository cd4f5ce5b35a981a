"""Controllers of other packages: slow and broken ones do no harm to fishd."""

import json
import os
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from rigs.processes import PATIENCE, Daemon, Subscriber, install, one_line, running

from fishd.client import Fish, Refused

MODULE = '''
"""Controllers with bad manners."""

import time
from pathlib import Path

from fishd.controllers.base import Controller
from fishd.controllers.hold import Hold


class Slow(Hold):
    """Takes its time to load."""

    def __init__(self, parameters, limits):
        super().__init__(parameters, limits)
        time.sleep(1.0)


class Waiting(Hold):
    """Loads until a file is there, and no longer than fishd waits for it."""

    def __init__(self, parameters, limits):
        super().__init__(parameters, limits)
        go_on, deadline = Path(__file__).with_name("go_on"), time.monotonic() + 8.0
        while not go_on.exists() and time.monotonic() < deadline:
            time.sleep(0.01)


class Shapeless(Controller):
    """Has no parameters struct."""

    def update(self, observation):
        return 0.0


class Explosive(Hold):
    """Fails while it loads."""

    def __init__(self, parameters, limits):
        raise RuntimeError("no such model")


'''
QUITTER = "import sys\nsys.exit(3)\n"
UNTYPED = '''
from msgspec import Struct

from fishd.controllers.hold import Hold


class Parameters(Struct):
    x: "Missing" = 1


class Untyped(Hold):
    """Has parameters of no known type."""

    Parameters = Parameters
'''
CONTROLLERS = {
    "slow": "manners:Slow",
    "waiting": "manners:Waiting",
    "shapeless": "manners:Shapeless",
    "explosive": "manners:Explosive",
    "absent": "nowhere:Absent",
    "quitter": "quitter:Quitter",
    "untyped": "untyped:Untyped",
    "function": "time:sleep",
}


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder of packages in which bad controllers are installed."""
    folder = tmp_path_factory.mktemp("packages") / "site"
    modules = {"manners": MODULE, "quitter": QUITTER, "untyped": UNTYPED}
    install(folder, modules, **CONTROLLERS)
    return folder


@pytest.fixture(scope="module")
def shared_daemon(site: Path) -> Iterator[Daemon]:
    """Run a daemon on a machine with these packages."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", str(site), prepend=os.pathsep)
        with running(site.parent) as daemon:
            yield daemon


def test_the_good_ones_are_listed_beside_the_built_in_ones(daemon: Daemon) -> None:
    known = [info["name"] for info in json.loads(daemon.fishctl("controllers", "--json").stdout)]
    assert {"slow", "explosive", "swing"} <= set(known)
    assert not {"shapeless", "absent", "function"} & set(known)
    assert "swing" in daemon.fishctl("simulate", "--help").stdout


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("shapeless", "(manners:Shapeless in slow 1.0) has no Parameters, a msgspec.Struct"),
        ("quitter", "(quitter:Quitter in slow 1.0) does not load: SystemExit: 3"),
        ("untyped", "(untyped:Untyped in slow 1.0) has Parameters that cannot be read: NameError"),
        ("absent", "(nowhere:Absent in slow 1.0) does not load: ModuleNotFoundError"),
        ("function", "(time:sleep in slow 1.0) is not a subclass of fishd.controllers.base.Con"),
        ("explosive", "controller 'explosive' cannot start: RuntimeError: no such model"),
    ],
)
def test_one_that_cannot_start_says_why_in_a_line(daemon: Daemon, name: str, message: str) -> None:
    done = daemon.fishctl_apart("set-controller", name)
    assert done.returncode == 1
    assert message in one_line(done)


def test_one_that_is_installed_while_fishd_runs_needs_a_restart(daemon: Daemon, site: Path) -> None:
    late = "from fishd.controllers.hold import Hold\nclass Late(Hold):\n    'Comes late.'\n"
    install(site, {"late": late}, late="late:Late")
    described = daemon.fishctl_apart("controllers", "late")
    assert described.stdout.startswith("late  Comes late.")
    assert (
        described.stderr == "fishctl: late was installed after fishd had started: restart fishd\n"
    )
    refused = daemon.fishctl_apart("set-controller", "late")
    assert refused.returncode == 1
    assert "no controller is named 'late'" in one_line(refused)
    assert "if late was installed since, restart fishd" in one_line(refused)


@pytest.mark.realtime
def test_one_that_loads_slowly_costs_no_tick(daemon: Daemon) -> None:
    def missed() -> int:
        with Subscriber(daemon.at_rest().telemetry, b"tick") as ticks:
            before = ticks.message()
            daemon.fishctl("set-controller", "slow")
            after = ticks.until(controller="slow")
        assert after["seq"] - before["seq"] > 15
        return int(after["missed_slots"] - before["missed_slots"])

    # A real cost of ticks recurs each time; a short stall of the machine does not.
    assert any(missed() == 0 for _ in range(3))


def test_one_that_is_still_loading_is_not_held_up_by_a_refused_request(daemon: Daemon) -> None:
    with (
        ThreadPoolExecutor() as threads,
        Fish(daemon.endpoint, timeout=PATIENCE) as first,
        Fish(daemon.endpoint, timeout=PATIENCE) as second,
    ):
        loading = threads.submit(first.set_controller, "slow")
        while not loading.done():
            with pytest.raises(Refused, match="swnig"):
                second.set_controller("swnig")
        assert loading.result().controller == "slow"


@pytest.mark.parametrize("newer", ["stop", "estop"])
def test_one_still_loading_undoes_no_newer_request(daemon: Daemon, site: Path, newer: str) -> None:
    go_on = site / "go_on"
    go_on.unlink(missing_ok=True)
    refusals: list[str] = []

    def start() -> None:
        with Fish(daemon.endpoint, timeout=PATIENCE) as fish:
            try:
                fish.set_controller("waiting")
            except Refused as refusal:
                refusals.append(refusal.code)

    loading = [threading.Thread(target=start) for _ in range(8)]
    for thread in loading:
        thread.start()
    with Fish(daemon.endpoint, timeout=PATIENCE) as fish:
        while refusals.count("busy") < 4:  # then all eight have been heard
            assert fish.status().mode == "idle"
        assert getattr(fish, newer)().mode == {"stop": "idle", "estop": "estop"}[newer]
        fish.clear_fault()
        go_on.touch()
        for thread in loading:
            thread.join(PATIENCE)
        assert fish.status().mode == "idle"
    assert set(refusals) == {"busy", "superseded"}
    assert len(refusals) == 8
