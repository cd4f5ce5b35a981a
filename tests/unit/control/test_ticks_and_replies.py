"""Every controller commands, and fishd answers, what `tests/reference` keeps of them."""

import csv
import json
from typing import Any

import pytest
from rigs.references import COLUMNS, RUNS, TICKS, WIRE, answers, swim

with TICKS.open(encoding="utf-8") as _file:
    ROWS = list(csv.DictReader(_file))
EXCHANGED = json.loads(WIRE.read_text("utf-8"))


@pytest.mark.parametrize("run", RUNS)
def test_a_controller_swims_as_before(run: str) -> None:
    kept = [tuple(float(row[column]) for column in COLUMNS) for row in ROWS if row["run"] == run]
    assert swim(run) == [pytest.approx(row, rel=1e-6, abs=1e-9) for row in kept]


def test_a_tick_and_each_reply_have_the_same_keys_in_the_same_order_and_the_same_values() -> None:
    found = answers()
    assert json.dumps(_names(found)) == json.dumps(_names(EXCHANGED))
    assert _flat(found) == pytest.approx(_flat(EXCHANGED), rel=1e-6, abs=1e-9)


def _names(value: Any) -> Any:
    """Return a value of JSON with a zero for each number."""
    match value:
        case dict():
            return {key: _names(item) for key, item in value.items()}
        case list():
            return [_names(item) for item in value]
        case bool() | str() | None:
            return value
    return 0


def _flat(value: Any) -> list[float]:
    """Return all numbers of a value of JSON."""
    if isinstance(value, dict | list):
        items = value.values() if isinstance(value, dict) else value
        return [number for item in items for number in _flat(item)]
    return [value] if isinstance(value, int | float) and not isinstance(value, bool) else []
