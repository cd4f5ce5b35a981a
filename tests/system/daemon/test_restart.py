"""A start of fishd with another configuration, which systemd carries out."""

import asyncio
import os
import signal
from pathlib import Path

import pytest
from rigs.processes import PATIENCE, Daemon, running, sets, wait_until

from fishd.client import Fish
from fishd.config import load
from fishd.core.errors import Refused
from fishd.daemon.main import Daemon as DaemonInProcess


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


def test_files_with_which_it_would_not_start_are_refused_and_the_fish_goes_on(
    service: Daemon, tmp_path: Path
) -> None:
    file, state = tmp_path / "fishd.yaml", tmp_path / "state"
    calibration = state / "pi" / "force-2020-01-01T000000.000000Z.yaml"
    calibration.parent.mkdir(parents=True)
    calibration.write_text("xx: 1.0\n")
    with Fish(service.endpoint, timeout=PATIENCE) as fish:
        for content, problem in (
            ("name: pike\ntick: fast\n", f"{file}:2"),
            (f"network: {{keys: {tmp_path}/keys}}\n", f"{tmp_path}/keys/key: there is no such"),
            (f"robot: pi\nstate_folder: {state}\n", str(calibration)),
            (None, f"{file}: no such file"),
        ):
            file.write_text(content) if content else file.unlink()
            refused = refusal(fish)
            assert refused.code == "bad-configuration"
            assert problem in str(refused)
        first = fish.status()
        wait_until(lambda: fish.status().seq > first.seq)
        assert (first.mode, first.name) == ("idle", "pike")


def test_without_systemd_nothing_would_start_it_again(tmp_path: Path) -> None:
    with running(tmp_path) as daemon, Fish(daemon.endpoint, timeout=PATIENCE) as fish:
        assert refusal(fish).code == "no-service"


def test_where_systemd_does_not_listen_nothing_would_start_it_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "of-an-ended-service"))
    with running(tmp_path) as daemon, Fish(daemon.endpoint, timeout=PATIENCE) as fish:
        assert refusal(fish).code == "no-service"


def test_an_experiment_keeps_its_fish_while_that_rests(service: Daemon) -> None:
    with (
        Fish(service.endpoint, timeout=PATIENCE) as fish,
        Fish(service.endpoint, timeout=PATIENCE) as experiment,
        experiment.lease("sweep"),
    ):
        refused = refusal(fish)
        assert refused.code == "leased"
        assert "sweep" in str(refused)
        assert experiment.stop().mode == "idle"


@pytest.mark.parametrize("is_cleared", [False, True])
def test_an_emergency_stop_during_the_restart_is_not_ended_by_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_cleared: bool
) -> None:
    monkeypatch.setattr(signal, "raise_signal", lambda number: None)
    names = ("control", "telemetry")
    addresses = sets(*(f"{name}.address=ipc://{tmp_path}/{name}" for name in names))

    async def restart() -> bool:
        config = load(None, ["lockstep=true", *addresses[1::2]])
        with DaemonInProcess(config, print_status=False) as daemon:
            daemon._end_for_restart()
            daemon._loop.estop("while it fades")
            if is_cleared:
                daemon._loop.clear_fault()
        return daemon.shall_restart()

    assert asyncio.run(restart()) is is_cleared
