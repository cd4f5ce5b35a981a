"""Ten minutes that a window keeps for a page that opens: extremes of bins, in messages."""

from typing import Any

import msgspec
import pytest

from fishd.core.signals import Tick
from fishd.window.past import BIN_S, KEPT_S, MAX_COLUMNS, PART_BINS, Past

PERIOD_S = 0.05
PART_S = BIN_S * PART_BINS


def tick(seq: int, **changes: Any) -> Tick:
    """Return a tick of a fish that swims."""
    values: dict[str, Any] = {
        "t": 1.7e9 + seq * PERIOD_S, "seq": seq, "time": seq * PERIOD_S, "mode": "running",
        "controller": "swing", "fx": 0.01, "fy": 0.0, "fy_rate": 0.0, "fin_velocity": 0.0,
        "phi_c": 0.4, "servo_on": True, "thrust": 0.02, "frequency": 1.7, "samples": 2,
        "sample_age_ms": 1.0, "lateness_us": 50.0, "busy_time_us": 90.0, "missed_slots": 0,
    }  # fmt: skip
    return Tick(**values | changes)


def rows_of(past: Past) -> list[dict[str, Any]]:
    """Return the rows of all messages, as a page reads them."""
    rows: list[dict[str, Any]] = []
    for message in past.messages():
        kind, columns = msgspec.json.decode(message)
        assert kind == "past"
        (length,) = {len(column) for column in columns.values()}
        rows += ({name: columns[name][row] for name in columns} for row in range(length))
    return rows


def test_each_bin_has_the_lowest_and_the_highest_value_of_its_ticks() -> None:
    past = Past()
    for seq in range(1, 1000):
        past.add(tick(seq, fx=0.9 if seq == 333 else -0.7 if seq == 335 else 0.01))
    rows = rows_of(past)
    assert [row["time"] for row in rows[:3]] == [0.125, 0.375, 0.625]
    assert max((row["fx"], row["time"]) for row in rows) == (
        0.9,
        333 * PERIOD_S // BIN_S * BIN_S + 0.375,
    )
    assert min(row["fx"] for row in rows) == -0.7
    assert [(row["seq"], row["t"]) for row in rows[2:4]] == [(10, 1.7e9 + 0.5), (19, 1.7e9 + 0.95)]


def test_ten_minutes_are_kept_and_nothing_more_whatever_the_tick() -> None:
    past, size = Past(), 0
    for seq in range(1, 40_000):
        past.add(tick(seq))
        if seq * PERIOD_S == KEPT_S + PART_S:
            size = sum(map(len, past.messages()))
    times = [row["time"] for row in rows_of(past)]
    assert KEPT_S - BIN_S <= times[-1] - times[0] <= KEPT_S + PART_S
    assert times[-1] > 40_000 * PERIOD_S - BIN_S
    assert sum(map(len, past.messages())) == pytest.approx(size, rel=0.1)


def test_what_is_unknown_is_absent_and_a_time_without_ticks_has_no_bins() -> None:
    past = Past()
    for seq in range(1, 1000):
        if not 100 <= seq < 300:
            past.add(tick(seq, servo_on=seq > 300, **({"suspect": "clipped"} if seq == 50 else {})))
    rows = rows_of(past)
    assert not [row for row in rows if 5.5 < row["time"] < 14.5]
    assert {row["phi_c"] for row in rows if row["time"] < 5.0} == {None}
    assert {row["phi_c"] for row in rows if row["time"] > 15.5} == {0.4}
    assert [row["time"] for row in rows if row.get("suspect_fx") is not None] == [2.625, 2.875]
    assert "thrust_low" not in rows[0]


def test_intervals_quantities_and_readings_have_the_names_of_the_pages_columns() -> None:
    past = Past()
    for seq in range(1, 1000):
        past.add(tick(seq, thrust_ci95=0.005, quantities={"C": 0.6}, readings={"power": 1.5}))
    row = rows_of(past)[0]
    assert (row["thrust_low"], row["thrust_high"]) == (0.015, 0.025)
    assert (row["quantity:C"], row["reading:power"]) == (0.6, 1.5)


def test_a_fish_with_ever_new_names_fills_no_memory() -> None:
    past = Past()
    for seq in range(1, 1000):
        past.add(tick(seq, quantities={f"q{seq}-{n}": 1.0 for n in range(100)}))
    for message in past.messages():
        assert len(msgspec.json.decode(message)[1]) <= MAX_COLUMNS + 1


def test_another_fishd_has_no_past() -> None:
    past = Past()
    for seq in range(1, 1000):
        past.add(tick(seq))
    assert rows_of(past)
    past.clear()
    assert rows_of(past) == []
