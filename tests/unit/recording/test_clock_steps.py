"""Steps of the unix clock: no length and no axis of a recording follows them; they are listed."""

from collections.abc import Sequence
from pathlib import Path

import msgspec
import pandas
import pytest
from mcap.writer import Writer
from msgspec.structs import replace
from rigs.processes import fishctl
from rigs.recordings import status, swum, write

from fishd.core.signals import Event, Tick
from fishd.lab.run_traces import traces
from fishd.recording import RunWriter, open_run
from fishd.recording.axis import Axis, ClockSteps
from fishd.recording.folder import read_overview
from fishd.recording.summary import place

UNIX = 1.8e9
"""Unix time at the monotonic time 0 of these recordings [s]."""
STEP_S = -30.0
FIRST = 40
"""Index of the first tick after the step."""


def stepped(step: float = STEP_S, unix: float = UNIX) -> list[Tick]:
    """Return the ticks of 3 s, during which the unix clock is set by `step`."""
    return [
        replace(tick, t=tick.time + unix + (step if index >= FIRST else 0.0))
        for index, tick in enumerate(swum().recorder.ticks)
    ]


@pytest.fixture(scope="module", params=[-30.0, 1.7e9], ids=["back", "forward"])
def step(request: pytest.FixtureRequest) -> float:
    return float(request.param)


def test_a_step_of_the_clock_changes_no_length_and_is_listed(tmp_path: Path, step: float) -> None:
    path = write(tmp_path / "run", stepped(step, 10.0 if step > 0 else UNIX))
    for summary in (open_run(path).summary, read_overview(path).summary):
        assert summary.duration == pytest.approx(2.95)
        (clock_step,) = summary.clock_steps
        assert (clock_step.at, clock_step.by) == pytest.approx((2.0, step), abs=1e-3)
    listed = fishctl("runs", "--folder", str(tmp_path)).stdout
    assert "  3.0 s  " in listed
    assert f"the clock was set by {clock_step.by:+.1f} s at 2.0 s".replace("-", "−") in listed


def test_the_figures_and_tables_after_a_step_have_the_axis_of_the_ticks(tmp_path: Path) -> None:
    ticks = stepped()
    path = tmp_path / "run.mcap"
    with RunWriter(path) as writer:
        writer.describe(swum(0.1).config)
        for tick in ticks:
            writer.tick(tick)
            if tick is ticks[50]:
                writer.event(Event(tick.t, "info", "mark", "here", time=tick.time))
    drawn = traces(open_run(path), 1.0)
    assert drawn.time == pytest.approx([0.05 * index for index in range(20, 60)])
    assert [event.time for event in drawn.events] == pytest.approx([2.5])
    done = fishctl("export", str(path), "--csv", "--to", str(tmp_path))
    assert "the clock was set by −30.0 s at 2.0 s" in done.stderr
    table, events = map(pandas.read_csv, done.stdout.split())
    assert table["elapsed"].tolist() == pytest.approx([0.05 * index for index in range(60)])
    assert table["t"].tolist() == [tick.t for tick in ticks]
    assert events["elapsed"].tolist() == pytest.approx([2.5])
    assert events["time"].tolist() == [ticks[50].time]


def test_viewers_get_log_times_that_never_run_back_and_publish_times_that_are_unix(
    tmp_path: Path,
) -> None:
    from mcap.reader import make_reader

    ticks = stepped()
    with write(tmp_path / "run", ticks).open("rb") as file:
        messages = [message for _, _, message in make_reader(file).iter_messages("tick")]
    begin = round(ticks[0].t * 1e9)
    assert [message.log_time - begin for message in messages] == pytest.approx(
        [5e7 * index for index in range(60)]
    )
    assert [message.publish_time for message in messages] == [round(t.t * 1e9) for t in ticks]


def test_a_clock_before_1970_is_recorded_as_it_is(tmp_path: Path) -> None:
    ticks = stepped(unix=-5000.0)
    with RunWriter(tmp_path / "run") as writer:
        writer.describe(swum(0.1).config)
        for tick in ticks:
            writer.message("tick", msgspec.json.encode(tick))
    run = open_run(writer.path)
    assert run.ticks == ticks
    assert run.summary.duration == pytest.approx(2.95)


def find_steps(offsets: Sequence[float], times: Sequence[float] = ()) -> list[tuple[float, float]]:
    """Return the steps of a clock that has these offsets, one per tick."""
    finder = ClockSteps()
    for index, offset in enumerate(offsets):
        time = times[index] if times else 0.05 * index
        finder.add(time, time + offset, time)
    return [(step.at, round(step.by, 3)) for step in finder.steps]


def test_a_gradual_change_a_small_one_and_a_delayed_tick_are_no_steps() -> None:
    assert find_steps([0.003 * index for index in range(1000)]) == []  # the fastest of chrony
    assert find_steps([0.0] * 50 + [0.09] * 50) == []
    assert find_steps([0.0] * 50 + [0.8] + [0.0] * 50) == []
    assert find_steps([0.0, 0.0, 0.9, 0.9], [0.0, 1.0, 1000.0, 1001.0]) == []  # a lost hour, slewed
    assert find_steps([0.0] * 50 + [0.12] * 50) == [(2.5, 0.12)]
    assert find_steps([0.0] * 10 + [5.0] * 10 + [-7.0] * 10) == [(0.5, 5.0), (1.0, -12.0)]


def test_the_slow_time_of_a_swimmer_is_no_step_of_the_clock(tmp_path: Path) -> None:
    ticks = [replace(t, t=UNIX + 4.0 * t.time + (t.seq > 30)) for t in swum().recorder.ticks]
    with RunWriter(tmp_path / "run") as writer:
        writer.describe(swum(0.1).config, {"robot": "swimmer"})
        for tick in ticks:
            writer.tick(tick)
    summary = open_run(writer.path).summary
    assert summary.clock_steps == ()
    assert summary.duration == pytest.approx(2.95)


@pytest.mark.parametrize(
    ("time", "t", "expected"),
    [
        (160.0, UNIX + 160.0, 60.0),  # the same boot
        (160.0, 5.0, 60.0),  # and its clock was set meanwhile: the arrival confirms it
        (9.0, UNIX + 160.0, 60.2),  # another boot
        (9.0, 5.0, 60.2),  # and without a battery for its clock
        (90000.0, UNIX + 160.0, 60.2),  # another machine that has run for longer
    ],
)
def test_another_fishd_continues_where_its_first_message_arrives(
    time: float, t: float, expected: float
) -> None:
    last = replace(swum(0.1).recorder.ticks[-1], seq=900, time=100.0, t=UNIX + 100.0)
    axis = Axis()
    assert place(axis, last, 7.0) == 0.0
    first = replace(last, seq=1, time=time, t=t)
    assert place(axis, first, 67.2) == pytest.approx(expected)
    following = replace(first, seq=2, time=time + 0.05, t=t + 0.05)
    assert place(axis, following, 67.2) == pytest.approx(expected + 0.05)


def test_events_and_statuses_are_placed_beside_the_ticks(tmp_path: Path) -> None:
    ticks = stepped()
    with RunWriter(tmp_path / "run") as writer:
        for index, tick in enumerate(ticks):
            writer.tick(tick)
            if index == FIRST - 1:
                # Both are sent after the step, the second one by an fishd without `time`.
                writer.event(Event(tick.t + STEP_S, "info", "mark", "1", {}, tick.time + 0.01))
                writer.event(Event(tick.t + STEP_S, "info", "mark", "2"))
                writer.status(replace(status(ticks[FIRST], 7), clock=tick.time + 0.02))
    run = open_run(writer.path)
    assert run.times_of("event") == pytest.approx([1.96, 1.95])
    assert run.times_of("status") == pytest.approx([1.97])


def test_a_recording_of_another_layout_is_refused_in_one_line(tmp_path: Path) -> None:
    path = tmp_path / "old.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="", library="fishd")
        writer.add_metadata("fishd.run", {"run": path.stem, "format": "2", "version": "0.1"})
        writer.finish()
    done = fishctl("export", str(path), "--csv", "--to", str(tmp_path))
    why = "its layout is 2, and this fishd reads layout 3: it was recorded by another version"
    assert done.stderr == f"fishctl: {path}: {why}, 0.1\n"
