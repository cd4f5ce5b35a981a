"""Recordings: all written data can be read, even after a failure of the writer."""

import errno
import os
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from itertools import count
from pathlib import Path
from unittest.mock import MagicMock

import msgspec
import pytest
from msgspec.structs import replace
from rigs.harness import Rig
from rigs.kills import ends_before
from rigs.recordings import record_run, status, swum, write

from fishd.cli.recording.record import _print_summary
from fishd.config import Config
from fishd.core.errors import RecordingError
from fishd.core.signals import Tick
from fishd.recording import Gap, RunWriter, open_run, read
from fishd.recording import recorder as recorder_module
from fishd.recording.folder import find_recording, list_recordings, read_overview, read_overviews
from fishd.recording.recorder import TAKEOVER_MESSAGE, Description, Recorder
from fishd.recording.recover import recover
from fishd.recording.summary import Tally


def test_a_recording_gives_back_every_bit_of_a_run(tmp_path: Path) -> None:
    rig = swum()
    path = record_run(rig, tmp_path / "run", operator="Ada", subject="fish 3", note="stiff fin")
    run = open_run(str(path))
    assert path.name == "run.mcap"
    assert run.ticks == rig.recorder.ticks
    assert run.events == rig.recorder.events
    assert run.config == rig.config
    about = ("operator", "subject", "note", "source")
    assert [run.about[key] for key in about] == ["Ada", "fish 3", "stiff fin", "fishd"]
    assert run.finished
    assert (run.gaps, run.summary.swim_ticks) == ([], {"swing": 60})
    assert list(read(path).fx) == [tick.fx for tick in rig.recorder.ticks]


def test_its_thrust_is_the_mean_over_all_its_swimming() -> None:
    quiet = "simulation.noise=0"  # the interval contains the effect of noise
    fish, tally, impulse = Rig("simulation.offset_x=0.02", quiet), Tally(), 0.0
    fish.run_for(10)
    for controller, parameters in (("swing", {}), ("square", {"frequency": 0.8})):
        fish.start(controller, **parameters)
        for _ in range(1200):
            fish.run()
            impulse += fish.fish.take_window().thrust
    for tick in fish.recorder.ticks:
        tally.tick(tick, tick.time)
    thrust, error = tally.summary.thrust, tally.summary.thrust_ci95
    assert thrust is not None
    assert error is not None
    assert thrust == pytest.approx(impulse / 2400, abs=0.2e-3)
    assert 0.5e-3 < error < 5.0e-3


def test_an_older_recording_is_never_overwritten(tmp_path: Path) -> None:
    path = record_run(swum(), tmp_path / "run.mcap")
    before = path.read_bytes()
    with pytest.raises(RecordingError, match="already exists; choose another name"):
        RunWriter(path)
    unfinished = pytest.raises(RecordingError, match="in progress or not finished")
    with RunWriter(tmp_path / "other"), unfinished:
        RunWriter(tmp_path / "other")
    assert path.read_bytes() == before


def test_ticks_that_are_missing_are_counted(tmp_path: Path) -> None:
    ticks = swum().recorder.ticks
    again = swum(1.0).recorder.ticks
    path = write(tmp_path / "run", [*ticks[:10], *ticks[13:], *again[2:]])
    for summary in (open_run(path).summary, read_overview(path).summary):
        assert (summary.gaps, summary.lost_ticks, summary.restarts) == (2, 5, 1)
    assert open_run(path).gaps == [Gap(ticks[9].t, 11, 3), Gap(ticks[-1].t, 1, 2)]


def test_whatever_is_left_of_a_file_is_read_and_recovered(tmp_path: Path) -> None:
    whole = record_run(swum(), tmp_path / "whole", flush_every=10)
    content, ticks = whole.read_bytes(), open_run(whole).ticks
    kept = []
    for share in (0.3, 0.7, 0.999):
        part = tmp_path / f"cut{share}.mcap.part"
        part.write_bytes(content[: int(share * len(content))])
        (cut,) = (overview for overview in read_overviews(tmp_path) if overview.path == part)
        assert not cut.finished
        run = recover(part)
        assert run.path == tmp_path / f"cut{share}.mcap"
        assert not part.exists()
        assert run.finished
        assert run.reason.startswith("recovered")
        assert run.ticks == ticks[: len(run.ticks)]
        assert read_overview(run.path).summary == run.summary
        kept.append(len(run.ticks))
    assert kept == sorted(kept)
    assert kept[0] < kept[-1] == len(ticks)


def test_what_is_recorded_now_is_not_recovered(tmp_path: Path) -> None:
    with RunWriter(tmp_path / "run") as writer:
        assert read_overview(writer.part).writing
        busy = "is being recorded or recovered; end that process first"
        with pytest.raises(RecordingError, match=busy):
            recover(writer.part)


@pytest.mark.slow
@pytest.mark.parametrize("damaged", [False, True], ids=["cut off", "damaged"])
def test_a_recovery_that_is_killed_is_finished_by_the_next(tmp_path: Path, damaged: bool) -> None:
    whole = record_run(swum(), tmp_path / "whole", flush_every=10)
    content = bytearray(whole.read_bytes())
    for call in count():
        folder = tmp_path / f"{call}"
        folder.mkdir()
        if damaged:
            content[int(0.4 * len(content))] ^= 0x55 if call == 0 else 0
            source, final = folder / "run.mcap", folder / "run-recovered.mcap"
            source.write_bytes(content)
        else:
            source, final = folder / "run.mcap.part", folder / "run.mcap"
            source.write_bytes(content[: len(content) // 2])
        ticks = open_run(source).ticks
        ended = ends_before(call, partial(recover, source))
        with suppress(RecordingError):  # there is nothing left to do
            recover(source)
        assert set(folder.iterdir()) == ({source, final} if damaged else {final})
        assert (open_run(final).ticks, open_run(final).is_damaged) == (ticks, False)
        if ended:
            break
    assert call > 5


def test_a_recording_killed_while_it_got_its_name_gets_it_from_a_recovery(tmp_path: Path) -> None:
    whole = record_run(swum(), tmp_path / "run")
    content, part = whole.read_bytes(), whole.with_name("run.mcap.part")
    part.hardlink_to(whole)
    assert recover(part).path == whole
    assert not part.exists()
    whole.rename(part)
    assert recover(part).path == whole
    assert not part.exists()
    assert whole.read_bytes() == content
    part.write_bytes(content[: len(content) // 2])
    whole.write_bytes(record_run(swum(), tmp_path / "other").read_bytes())
    with pytest.raises(RecordingError, match=r"run\.mcap already exists; move it away first"):
        recover(part)


@pytest.mark.slow
def test_a_damaged_byte_costs_its_chunk_at_most_and_is_told(tmp_path: Path) -> None:
    rig = swum()
    path = record_run(rig, tmp_path / "run", flush_every=10)
    whole, ticks = path.read_bytes(), rig.recorder.ticks
    worst = 0
    for offset in range(30, len(whole) - 40, 797):
        content = bytearray(whole)
        content[offset] ^= 0x55
        path.write_bytes(content)
        run = open_run(path)
        read = {tick.seq for tick in run.ticks}
        worst = max(worst, lost := len(ticks) - len(read))
        assert run.ticks == [tick for tick in ticks if tick.seq in read]
        assert run.damaged == lost, offset
        assert read_overview(path).problem == run.problem
        assert f"{lost} ticks lost" in run.problem or lost == 0
        assert run.finished
    assert worst == 10


def test_what_names_a_recording_and_its_channels_may_be_damaged_too(tmp_path: Path) -> None:
    path = record_run(swum(), tmp_path / "run", flush_every=10)
    whole, ticks = path.read_bytes(), open_run(path).ticks
    first_chunk = whole.index(b"\x04\0\0\0zstd")
    for offset in (whole.index(b"fishd.run") - 4, first_chunk + 60, len(whole) // 2):
        content = bytearray(path.read_bytes())
        content[offset] ^= 0x55
        path.write_bytes(content)
    run, recovered = open_run(path), recover(path)
    assert run.about == {}
    assert 0 < len(run.ticks) < len(ticks)
    assert recovered.ticks == run.ticks
    assert not recovered.is_damaged


def test_what_is_recovered_of_a_damaged_recording_is_whole(tmp_path: Path) -> None:
    path = record_run(swum(), tmp_path / "run", flush_every=10)
    content = bytearray(path.read_bytes())
    content[int(0.4 * len(content))] ^= 0x55
    path.write_bytes(content)
    damaged, run = open_run(path), recover(path)
    assert run.path == tmp_path / "run-recovered.mcap"
    assert (damaged.damaged, run.is_damaged, run.summary.lost_ticks) == (10, False, 10)
    assert run.ticks == damaged.ticks
    assert run.reason == run.problem == "recovered: damaged: 10 ticks lost"
    with pytest.raises(RecordingError, match="there is nothing to recover"):
        recover(run.path)


def test_a_full_disk_ends_a_recording_of_which_all_stays_readable(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    writer, ticks, room = RunWriter(tmp_path / "run"), swum().recorder.ticks, 20000
    written = os.write

    def full(fd: int, data: bytes) -> int:
        nonlocal room
        if room <= 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        room -= len(data := bytes(data)[:room])  # the last write is cut short
        return written(fd, data)

    monkeypatch.setattr(os, "write", full)

    def record() -> None:
        for tick in ticks * 10:
            writer.tick(tick)
            writer.flush()

    with pytest.raises(RecordingError, match="No space left on device; the written part is reada"):
        record()
    with pytest.raises(RecordingError, match="has ended"):
        writer.tick(ticks[0])
    writer.close()
    monkeypatch.undo()
    run = recover(writer.part)
    assert 0 < len(run.ticks) < 600
    assert run.ticks == (ticks * 10)[: len(run.ticks)]


def test_messages_from_no_time_are_left_out_and_counted(tmp_path: Path) -> None:
    lines: list[str] = []
    ticks = swum(0.4).recorder.ticks
    recorder = Recorder(None, partial(RunWriter, tmp_path / "run"), tell=lines.append)
    recorder._writer = recorder._open_writer()
    wrong = [
        replace(ticks[1], t=1e300),
        replace(ticks[1], t=-1.1e10),
        replace(ticks[1], time=1e300),
    ]
    for tick in (ticks[0], *wrong, ticks[1]):
        recorder._take("tick", msgspec.json.encode(tick))
    recorder.__exit__(None, None, None)
    ignored = "a message of topic tick is not fishd's: ignored"
    assert lines == [ignored, "messages that are not fishd's, ignored: 3"]
    run = open_run(tmp_path / "run.mcap")
    assert run.ticks == ticks[:2]
    assert run.summary == read_overview(run.path).summary


@pytest.mark.parametrize("seq", [3, 30], ids=["lower", "higher"])
def test_it_is_told_once_that_another_fishd_has_taken_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, seq: int
) -> None:
    ticks, lines = swum().recorder.ticks, list[str]()
    recorder = Recorder(None, partial(RunWriter, tmp_path / "run"), tell=lines.append)
    now = [description_of(ticks[0], pid=1)]
    monkeypatch.setattr(recorder, "_ask", lambda: now[-1])
    recorder._described = now[-1]
    recorder._open()
    for tick in ticks[:20]:
        hear(recorder, tick, pid=1)
    now.append(description_of(ticks[seq], pid=2))
    for tick in ticks[seq:]:
        hear(recorder, tick, pid=2)
    recorder.__exit__(None, None, None)
    assert [line for line in lines if "another fishd" in line] == [TAKEOVER_MESSAGE]
    run = open_run(tmp_path / "run.mcap")
    assert run.summary.restarts == 1
    assert [daemon["pid"] for daemon in run.daemons] == ["1", "2"]


def description_of(tick: Tick, pid: int) -> Description:
    return Description(status(tick, pid), msgspec.to_builtins(Config()), None)


def hear(recorder: Recorder, tick: Tick, pid: int) -> None:
    """A tick, and a status behind it."""
    recorder._take("tick", msgspec.json.encode(tick))
    recorder._take("status", msgspec.json.encode(status(tick, pid)))


@pytest.mark.parametrize(("pid", "complete"), [(1, True), (2, False)], ids=["same", "another"])
def test_ticks_that_arrive_after_the_last_status_are_no_sign_of_another_fishd(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, pid: int, complete: bool
) -> None:
    ticks = swum().recorder.ticks
    late = [("tick", msgspec.json.encode(tick)) for tick in ticks[1:5]]
    fishd, telemetry = MagicMock(), MagicMock()
    fishd.return_value.__enter__.return_value.status.return_value = status(ticks[2], pid)
    telemetry.messages.return_value = late
    monkeypatch.setattr(recorder_module, "Fish", fishd)
    recorder = Recorder(None, partial(RunWriter, tmp_path / "run"), tell=lambda line: None)
    recorder._described = description_of(ticks[0], pid=1)
    recorder._open()
    hear(recorder, ticks[0], pid=1)
    recorder._count_last_ticks(telemetry)
    recorder.__exit__(None, None, None)
    assert recorder.is_complete == complete
    assert len(open_run(tmp_path / "run.mcap").ticks) == 5


@pytest.mark.parametrize(
    ("make", "complaint"),
    [
        (lambda path: path.write_text("t,fx\n0,1\n" * 100), "is not an MCAP file"),
        (lambda path: path.mkdir(), "cannot be read: Is a directory"),
        (lambda path: None, "cannot be read: No such file"),
    ],
)
def test_what_is_no_recording_is_one_line(
    tmp_path: Path, make: Callable[[Path], None], complaint: str
) -> None:
    make(tmp_path / "run.mcap")
    with pytest.raises(RecordingError, match=complaint):
        open_run(tmp_path / "run.mcap")


def test_what_is_no_regular_file_is_no_recording_of_a_folder(tmp_path: Path) -> None:
    path = record_run(swum(0.2), tmp_path / "run")
    os.mkfifo(tmp_path / "pipe.mcap")  # opening it would block
    os.mkfifo(tmp_path / "pipe.mcap.part")
    (tmp_path / "folder.mcap").mkdir()
    (tmp_path / "link.mcap").symlink_to(path)
    assert {recording.name for recording in list_recordings(tmp_path)} == {"run.mcap", "link.mcap"}
    assert len(list(read_overviews(tmp_path))) == 2


def test_a_name_means_a_recording_of_the_folder(tmp_path: Path) -> None:
    path = record_run(swum(0.2), tmp_path / "morning")
    for name in ("morning", str(path), "latest"):
        assert find_recording(name, tmp_path) == path
    with pytest.raises(RecordingError, match="did you mean 'morning'"):
        find_recording("mornin", tmp_path)
    with pytest.raises(RecordingError, match="contains no recording"):
        find_recording("latest", tmp_path / "nowhere")


def test_ticks_that_only_a_status_reveals_count_as_lost(tmp_path: Path) -> None:
    ticks = swum().recorder.ticks
    with RunWriter(tmp_path / "run") as writer:
        writer.status(status(ticks[4], pid=1))  # the recorder hears nothing of the ticks after it
        for tick in ticks[7:20]:
            writer.tick(tick)
        writer.status(status(ticks[24], pid=1))
        writer.status(status(ticks[29], pid=1))
    run = open_run(tmp_path / "run.mcap")
    assert [gap.lost for gap in run.gaps] == [2, 5, 5]
    assert run.gaps[0].seq == ticks[5].seq
    assert run.summary.lost_ticks == 12
    assert run.summary == read_overview(run.path).summary


def test_ticks_that_are_lost_between_two_files_of_a_black_box_are_reported(tmp_path: Path) -> None:
    ticks, lines, paths = swum().recorder.ticks, list[str](), iter(["first", "second"])
    recorder = Recorder(None, lambda: RunWriter(tmp_path / next(paths)), tell=lines.append)
    recorder._described = description_of(ticks[0], pid=1)
    recorder._open()
    hear(recorder, ticks[0], pid=1)
    recorder._continue_in_next_file()
    hear(recorder, ticks[5], pid=1)
    recorder.__exit__(None, None, None)
    assert lines == [f"just before tick {ticks[5].seq}, ticks were lost: 4"]
    assert not recorder.is_complete


def test_counted_losses_are_told_from_those_that_are_not_known(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    ticks, doubt = swum().recorder.ticks, "perhaps more are lost"
    recorder = Recorder(None, lambda: RunWriter(tmp_path / "run"), tell=lambda line: None)
    recorder._described = description_of(ticks[0], pid=1)
    recorder._open()
    hear(recorder, ticks[5], pid=1)
    hear(recorder, ticks[9], pid=1)
    _print_summary(recorder, as_json=False)
    counted = capsys.readouterr().out
    assert "3 lost" in counted
    assert doubt not in counted
    hear(recorder, ticks[2], pid=1)  # of another fishd, which has taken over
    recorder.__exit__(None, None, None)
    _print_summary(recorder, as_json=False)
    assert doubt in capsys.readouterr().out
    assert not recorder.is_complete


def test_a_recording_that_an_error_ends_is_not_complete(tmp_path: Path) -> None:
    tick = swum().recorder.ticks[0]
    recorder = Recorder(None, lambda: RunWriter(tmp_path / "run"), tell=lambda line: None)
    recorder._described = description_of(tick, pid=1)
    recorder._open()
    hear(recorder, tick, pid=1)
    assert recorder.is_complete
    recorder.__exit__(None, RecordingError("the disk is full"), None)
    assert not recorder.is_complete
