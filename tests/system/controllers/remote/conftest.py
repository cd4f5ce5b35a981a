"""Loops for a controller `remote`, and an agent for it."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from rigs.harness import Rig
from rigs.scripted_agent import ScriptedAgent

SLOW = ("tick=0.2",)
"""A tick with a deadline of 80 ms, so that a busy machine does not spoil a test."""


@pytest.fixture
def agent(tmp_path: Path) -> Iterator[ScriptedAgent]:
    agent = ScriptedAgent(tmp_path)
    yield agent
    agent.close()


@pytest.fixture
def rig() -> Iterator[Rig]:
    rig = Rig(*SLOW)
    yield rig
    rig.loop.close()


@pytest.fixture
def still() -> Iterator[Rig]:
    """Loop whose virtual time stops while an agent computes."""
    rig = Rig("lockstep=true")
    yield rig
    rig.loop.close()
