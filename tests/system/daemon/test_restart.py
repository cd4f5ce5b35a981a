"""A start of fishd with another configuration, which systemd carries out."""

import os
from pathlib import Path

import pytest
from rigs.processes import PATIENCE, Daemon, running

from fishd.client import Fish
from fishd.core.errors import Refused


def refusal(fish: Fish) -> Refused:
    with pytest.raises(Refused) as caught:
        fish.restart()
    return caught.value


def test_a_fish_at_rest_ends_with_the_status_at_which_systemd_starts_it_again(
    service: Daemon,
) -> None:
    with Fish(service.endpoint, timeout=PATIENCE) as fish:
        fish.set_controller("swing")
        assert refusal(fish).code == "running"
        fish.estop()
        assert refusal(fish).code == "estop"
        fish.clear_fault()
        assert fish.restart().mode == "idle"
    assert service.process.wait(PATIENCE) == os.EX_TEMPFAIL
    _, _, errors = service.end()
    assert "a restart was requested" in errors
    assert "stopping: fading to neutral" in errors


def test_a_wrong_configuration_is_refused_and_the_fish_goes_on(
    service: Daemon, tmp_path: Path
) -> None:
    file = tmp_path / "fishd.yaml"
    with Fish(service.endpoint, timeout=PATIENCE) as fish:
        file.write_text("name: pike\ntick: fast\n")
        refused = refusal(fish)
        assert refused.code == "bad-configuration"
        assert f"{file}:2" in str(refused)
        first = fish.status()
        assert fish.status().seq >= first.seq
        assert (first.mode, first.name) == ("idle", "pike")


def test_without_systemd_nothing_would_start_it_again(tmp_path: Path) -> None:
    with running(tmp_path) as daemon, Fish(daemon.endpoint, timeout=PATIENCE) as fish:
        assert refusal(fish).code == "no-service"
