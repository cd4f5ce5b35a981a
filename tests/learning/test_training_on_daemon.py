from pathlib import Path

import pytest

pytest.importorskip("torch", reason="the extra 'learn' is not installed")
pytest.importorskip("stable_baselines3", reason="the extra 'learn' is not installed")
pytest.importorskip("tensorboard", reason="the extra 'learn' is not installed")

from msgspec.structs import replace
from processes import Subscriber, running
from swimming import NOISY, brief_job

from fishd.client import Fish
from fishd.learning.settings import EvaluationSettings
from fishd.learning.training import train

NEVER = EvaluationSettings(every=0)


def test_in_lockstep_it_gives_the_numbers_of_a_training_in_process(tmp_path: Path) -> None:
    here = train(brief_job(tmp_path / "here", steps=1024, evaluation=NEVER))
    settings = [
        "lockstep=true",
        "start.controller=remote",
        f"start.parameters.agent=ipc://{tmp_path}/agent",
        *NOISY,
    ]
    with running(tmp_path, *(word for setting in settings for word in ("--set", setting))) as fishd:
        job = brief_job(tmp_path / "there", steps=1024, evaluation=NEVER)
        there = train(replace(job, on="robot", endpoint=fishd.endpoint))
        with Fish(fishd.endpoint) as fish:
            assert fish.status().mode == "idle"
    assert (there.steps, there.tank_time) == (1024, here.tank_time)
    tables = [(outcome.folder / "progress.csv").read_text() for outcome in (here, there)]
    assert tables[0] == tables[1]


def test_fishd_is_told_where_to_reach_the_agent(tmp_path: Path) -> None:
    elsewhere = f"ipc://{tmp_path}/elsewhere"
    settings = [word for setting in ("lockstep=true", *NOISY) for word in ("--set", setting)]
    with running(tmp_path, *settings) as fishd, Subscriber(fishd.telemetry, b"event") as events:
        job = brief_job(tmp_path / "run", steps=128, evaluation=NEVER)
        train(replace(job, on="robot", endpoint=fishd.endpoint, agent=elsewhere))
        taken = events.until(kind="controller")["data"]
    assert (taken["controller"], taken["parameters"]["agent"]) == ("remote", elsewhere)
