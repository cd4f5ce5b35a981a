import csv
from collections.abc import Callable

import pytest
from rigs.documents import ROOT

REFERENCE = ROOT / "tests" / "reference"


@pytest.fixture
def reference() -> Callable[[str], list[dict[str, str]]]:
    """Read a table of reference numbers by its name."""

    def read(name: str) -> list[dict[str, str]]:
        with (REFERENCE / f"{name}.csv").open(newline="") as file:
            return list(csv.DictReader(file))

    return read
