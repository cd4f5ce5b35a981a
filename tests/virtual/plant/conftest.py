import csv
from collections.abc import Callable
from pathlib import Path

import pytest

REFERENCE = Path(__file__).parents[2] / "reference"


@pytest.fixture
def reference() -> Callable[[str], list[dict[str, str]]]:
    """Read a table of reference numbers by its name."""

    def read(name: str) -> list[dict[str, str]]:
        with (REFERENCE / f"{name}.csv").open(newline="") as file:
            return list(csv.DictReader(file))

    return read
