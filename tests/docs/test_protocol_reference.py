"""The tables of the protocol and of faults in docs/, and what they are written from."""

import subprocess
import sys
from typing import get_args

from rigs.documents import ROOT

from fishd.core.signals import EVENTS, EventKind


def test_the_committed_tables_are_what_the_code_says() -> None:
    program = [sys.executable, str(ROOT / "tools" / "protocol_reference.py"), "--check"]
    done = subprocess.run(program, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_every_kind_of_event_is_described() -> None:
    assert {kind for kind, *_ in EVENTS} == set(get_args(EventKind))
