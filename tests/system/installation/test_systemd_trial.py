"""The trial under a real systemd, without one: the messages of fishd that it expects."""

import os
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest
from rigs.documents import ROOT
from rigs.processes import FISHD, Daemon, call, fishctl, running, wait_until

from common.report import BrokenPromise
from fishd.cli import status as status_verb
from fishd.core.signals import Status
from reliability.systemd import trials

CHECKOUT = ROOT


@pytest.fixture(scope="module")
def daemon(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Daemon]:
    with running(tmp_path_factory.mktemp("daemon")) as daemon:
        yield daemon


@pytest.mark.parametrize("realtime", [True, False])
def test_the_trial_finds_the_scheduling_in_the_output_of_its_command(
    daemon: Daemon, monkeypatch: pytest.MonkeyPatch, realtime: bool
) -> None:
    status = msgspec.structs.replace(daemon.status(), realtime=realtime)

    class Client(status_verb.Fish):
        def status(self) -> Status:
            return status

    monkeypatch.setattr(status_verb, "Fish", Client)
    command, *arguments = trials.STATUS
    assert command == "fishctl"
    shown = fishctl("--endpoint", daemon.endpoint, *arguments).stdout
    if realtime:
        trials.check_scheduling(shown)
    else:
        with pytest.raises(BrokenPromise, match="no real-time scheduling"):
            trials.check_scheduling(shown)


def test_the_trial_knows_a_fault_in_the_log(tmp_path: Path) -> None:
    with running(tmp_path, "--set", "start.controller=remote") as daemon:
        wait_until(lambda: daemon.status().mode == "fault")  # no agent answers
        log = daemon.end()[2]
    assert trials.FAULT in log


def test_the_trial_knows_what_fishd_says_of_its_wrong_configuration(tmp_path: Path) -> None:
    file = tmp_path / "fishd.yaml"
    file.write_text((CHECKOUT / "config/virtual-pi.yaml").read_text() + trials.WRONG_LINE)
    done = call(FISHD, "--config", file)
    assert done.returncode == os.EX_CONFIG
    assert trials.SUGGESTION in done.stderr


def test_the_trial_waits_for_the_words_of_the_failure_unit() -> None:
    unit = (CHECKOUT / "systemd/fishd-failure.service").read_text()
    assert trials.FAILED in unit
