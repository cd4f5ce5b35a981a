"""The device of docs/example-bluesky, in a scan of Bluesky on a simulated fish."""

import importlib.util
from pathlib import Path
from types import ModuleType
from typing import Any

import bluesky.plan_stubs as bps
import bluesky.plans as bp
import pytest
from bluesky import RunEngine
from bluesky.protocols import Movable, Readable, Stageable, Status, Triggerable
from bluesky.utils import FailedStatus
from rigs.documents import ROOT
from rigs.processes import Daemon

from fishd.client import Fish, Refused

MODULE = ROOT / "docs" / "example-bluesky" / "fishd_bluesky.py"


@pytest.fixture(scope="module")
def example() -> ModuleType:
    spec = importlib.util.spec_from_file_location("fishd_bluesky", MODULE)
    assert spec
    assert spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def documents_of(plan: Any) -> dict[str, list[dict[str, Any]]]:
    """Run a plan; return its documents by name."""
    documents: dict[str, list[dict[str, Any]]] = {}
    RunEngine()(plan, lambda name, document: documents.setdefault(name, []).append(document))
    return documents


def test_the_example_is_short() -> None:
    assert MODULE.read_text(encoding="utf-8").count("\n") <= 150


def test_a_scan_over_the_frequency_reads_a_thrust_at_each(
    daemon: Daemon, example: ModuleType
) -> None:
    fish = example.SwimmingFish(endpoint=daemon.endpoint, seconds=3.0)
    documents = documents_of(bp.scan([fish], fish.frequency, 0.4, 1.7, 2))
    (stop,) = documents["stop"]
    assert stop["exit_status"] == "success"
    (descriptor,) = documents["descriptor"]
    assert descriptor["data_keys"]["fish_thrust"]["units"] == "N"
    assert descriptor["hints"]["fish"] == {"fields": ["fish_thrust"]}
    slow, fast = (event["data"] for event in documents["event"])
    assert (slow["fish_frequency"], fast["fish_frequency"]) == (0.4, 1.7)
    assert fast["fish_thrust"] > slow["fish_thrust"]
    assert daemon.status().lease is None
    assert daemon.status().mode == "idle"


def test_the_parts_are_those_that_bluesky_asks_for(daemon: Daemon, example: ModuleType) -> None:
    fish = example.SwimmingFish(endpoint=daemon.endpoint)
    for protocol in (Readable, Triggerable, Stageable):
        assert isinstance(fish, protocol)
    assert isinstance(fish.frequency, Movable)
    fish.stage()
    task = fish.frequency.set(1.0)
    assert isinstance(task, Status)
    assert task.exception(timeout=60.0) is None
    assert (task.done, task.success) == (True, True)
    assert daemon.status().parameters["frequency"] == 1.0
    fish.unstage()
    with pytest.raises(RuntimeError, match="fish is not staged"):
        fish.trigger()


def test_a_frequency_that_fishd_refuses_fails_the_plan_and_frees_the_fish(
    daemon: Daemon, example: ModuleType
) -> None:
    fish = example.SwimmingFish(endpoint=daemon.endpoint)
    with pytest.raises(FailedStatus) as failed:
        documents_of(bp.scan([fish], fish.frequency, -1.0, 1.0, 2))
    assert isinstance(failed.value.__cause__, Refused)
    assert daemon.status().lease is None


def test_a_fish_of_another_experiment_is_not_taken(
    tmp_path: Path, daemon: Daemon, example: ModuleType
) -> None:
    fish = example.SwimmingFish(endpoint=daemon.endpoint)
    with Fish(daemon.endpoint) as other, other.lease("mine"), pytest.raises(Refused, match="mine"):
        documents_of(bps.stage(fish))
