"""The thread of fishd-camera that measures: the newest picture, and learning on request."""

import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from rigs.processes import wait_until

from fishd.camera import measuring
from fishd.camera.measuring import Measuring, learned_path
from fishd.camera.messages import TailMessage
from fishd.camera.settings import load
from fishd.camera.tail.learner import CannotLearn
from fishd.camera.tail.lens import CannotUseLens, Lens
from fishd.core.camera_frames import Pixels
from fishd.core.errors import FishdError, Refused
from fishd.core.tail_reading import TailReading

PICTURE = np.zeros((48, 64), np.uint8)


class FakeLearned:
    """What is learned here: nothing but a date."""

    date, zero_ci95 = "2026-11-29", 0.001

    def save(self, path: Path) -> None:
        path.write_text("learned")


class FakeLearner:
    """Learner whose result a test sets."""

    problem: Exception | None = None

    def __init__(self, lens: Lens | None) -> None:
        self.times: list[float] = []

    def add(self, time: float, picture: Pixels) -> None:
        self.times.append(time)

    def finish(self) -> FakeLearned:
        if self.problem:
            raise self.problem
        return FakeLearned()


class FakeMeter:
    """Meter that waits in each picture until a test lets it go on."""

    lets: threading.Semaphore
    error: Exception | None
    row_times: list[tuple[float, float]]

    def __init__(self, learned: FakeLearned) -> None:
        pass

    def read(
        self, time: float, picture: Pixels, row_time: float, column_time: float
    ) -> TailReading:
        self.row_times.append((row_time, column_time))
        self.lets.acquire(timeout=20.0)
        if self.error:
            raise self.error
        return TailReading(time=time, alpha=0.1, zero=0.0)


@pytest.fixture(autouse=True)
def _fakes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(FakeLearner, "problem", None)
    for name, value in (("lets", threading.Semaphore(0)), ("error", None), ("row_times", [])):
        monkeypatch.setattr(FakeMeter, name, value, raising=False)
    monkeypatch.setattr(measuring, "Learner", FakeLearner)
    monkeypatch.setattr(measuring, "TailMeter", FakeMeter)


Start = Callable[..., Measuring]


@pytest.fixture
def results() -> list[TailMessage]:
    return []


@pytest.fixture
def start(tmp_path: Path, results: list[TailMessage]) -> Iterator[Start]:
    started: list[Measuring] = []

    def run(*pairs: str, learn: bool = True) -> Measuring:
        thread = Measuring(load(None, pairs), tmp_path / "state" / "tail.bin", results.append)
        started.append(thread.__enter__())
        if learn:
            thread.begin_learning()
            thread.finish_learning()
            wait_until(lambda: thread.condition == "measuring")
        return thread

    yield run
    for _ in range(100):
        FakeMeter.lets.release()
    for thread in started:
        thread.__exit__()


def test_the_newest_picture_is_measured_and_those_before_it_are_counted(
    start: Start, results: list[TailMessage]
) -> None:
    thread = start()
    thread.offer("s", 1, 0.1, PICTURE)
    wait_until(lambda: len(FakeMeter.row_times) == 1)  # the first picture is in work
    for seq in (2, 3, 4):
        thread.offer("s", seq, 0.1 * seq, PICTURE)  # returns at once
    for _ in range(2):
        FakeMeter.lets.release()
    wait_until(lambda: len(results) == 2)
    assert [(tail.session, tail.seq) for tail in results] == [("s", 1), ("s", 4)]
    assert (thread.measured, thread.dropped) == (2, 2)


@pytest.mark.parametrize(
    ("rotate", "expected"),
    [(0, (0.02, 0.0)), (90, (0.0, -0.02)), (180, (-0.02, 0.0)), (270, (0.0, 0.02))],
)
def test_the_read_out_goes_along_the_rows_of_the_sensor(
    start: Start, rotate: int, expected: tuple[float, float]
) -> None:
    thread = start("tail.read_out=0.02", f"picture.rotate={rotate}")
    thread.offer("s", 1, 0.1, PICTURE)
    wait_until(lambda: FakeMeter.row_times == [expected])


def test_nothing_is_measured_before_the_tail_was_learned(start: Start) -> None:
    thread = start(learn=False)
    thread.offer("s", 1, 0.1, PICTURE)
    assert (thread.condition, thread.measured, thread.dropped) == ("unlearned", 0, 0)
    assert FakeMeter.row_times == []


def test_a_camera_that_shall_not_measure_does_not_learn(start: Start) -> None:
    thread = start("tail.measure=false", learn=False)
    assert thread.condition == "off"
    with pytest.raises(Refused, match=r"set tail\.measure to true"):
        thread.begin_learning()


@pytest.mark.parametrize(
    ("error", "problem"),
    [
        (CannotLearn("nothing swings: let the fish swim"), "nothing swings: let the fish swim"),
        (ZeroDivisionError("in a library"), "ZeroDivisionError: in a library"),
        (OSError(28, "No space left on device"), "cannot be written: No space left on device"),
    ],
)
def test_what_could_not_be_learned_changes_nothing_and_is_said(
    start: Start, error: Exception, problem: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    thread = start()
    monkeypatch.setattr(FakeLearner, "problem", error)
    thread.begin_learning()
    assert thread.condition == "learning"
    thread.finish_learning()
    wait_until(lambda: thread.condition == "measuring")
    assert thread.problem.endswith(problem)
    FakeMeter.lets.release()
    thread.offer("s", 1, 0.1, PICTURE)
    wait_until(lambda: thread.measured == 1)
    assert thread.problem.endswith(problem)  # until the tail is learned


@pytest.mark.parametrize(("learn", "condition"), [(True, "measuring"), (False, "unlearned")])
def test_learning_that_is_cancelled_leaves_what_was_learned_before(
    start: Start, learn: bool, condition: str
) -> None:
    thread = start(learn=learn)
    before = thread.learned
    thread.begin_learning()
    thread.offer("s", 1, 0.1, PICTURE)
    thread.cancel_learning()
    assert (thread.condition, thread.learned, thread.problem) == (condition, before, "")
    thread.finish_learning()
    thread.cancel_learning()
    assert (thread.condition, thread.learned) == (condition, before)


def test_learning_that_nobody_finishes_ends_by_itself(
    start: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    thread = start(learn=False)
    monkeypatch.setattr(measuring, "LEARNING_TIMEOUT_S", 0.0)
    thread.begin_learning()
    thread.offer("s", 1, 0.1, PICTURE)
    wait_until(lambda: thread.condition == "unlearned")
    assert thread.problem == "the learning was not finished in time"


@pytest.mark.parametrize("error", [FishdError("another size"), ZeroDivisionError("in a library")])
def test_a_picture_that_cannot_be_measured_stops_nothing(
    start: Start, results: list[TailMessage], error: Exception, monkeypatch: pytest.MonkeyPatch
) -> None:
    thread = start()
    monkeypatch.setattr(FakeMeter, "error", error)
    FakeMeter.lets.release()
    thread.offer("s", 1, 0.1, PICTURE)
    wait_until(lambda: str(error) in thread.problem)
    monkeypatch.setattr(FakeMeter, "error", None)
    FakeMeter.lets.release()
    thread.offer("s", 2, 0.2, PICTURE)
    wait_until(lambda: len(results) == 1)
    assert thread.problem == ""


def test_a_damaged_file_is_said_and_the_tail_can_be_learned_again(
    start: Start, tmp_path: Path
) -> None:
    (tmp_path / "state").mkdir()
    (tmp_path / "state" / "tail.bin").write_text("nonsense")
    thread = start(learn=False)
    assert thread.condition == "unusable"
    assert thread.problem.endswith("contains no learned tail")
    thread.begin_learning()
    thread.finish_learning()
    wait_until(lambda: thread.condition == "measuring")
    assert thread.problem == ""


LENS = Lens(
    date="2026-11-29",
    size=(64, 48),
    rotate=0,
    views=10,
    error=0.1,
    focal=(64.0, 64.0),
    centre=(32.0, 24.0),
    distortion=(-0.1, 0.0),
)


def test_a_tail_is_learned_again_after_the_lens_was_calibrated(
    start: Start, tmp_path: Path
) -> None:
    thread = start()
    thread.set_lens(LENS)
    assert (thread.condition, thread.learned, thread.problem) == ("unlearned", None, "")
    assert Lens.load(tmp_path / "state" / "tail.lens.json") == LENS
    assert start(learn=False).lens == LENS


def test_a_lens_of_pictures_that_are_turned_otherwise_is_refused(
    start: Start, tmp_path: Path
) -> None:
    start().set_lens(LENS)
    turned = start("picture.rotate=180", learn=False)
    assert turned.condition == "unusable"
    assert "turned by 180°, but the lens was calibrated with pictures" in turned.problem
    with pytest.raises(CannotUseLens, match="turned by 180°"):
        turned.set_lens(LENS)


def test_no_tail_is_learned_beside_a_damaged_calibration(start: Start, tmp_path: Path) -> None:
    start()
    (tmp_path / "state" / "tail.lens.json").write_text("nonsense")
    thread = start(learn=False)
    assert thread.condition == "unusable"
    with pytest.raises(Refused, match=r"tail.lens.json contains no calibration of a lens"):
        thread.begin_learning()
    thread.set_lens(LENS)
    thread.begin_learning()
    assert thread.condition == "learning"


def test_each_camera_keeps_what_it_learned_in_a_file_of_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    monkeypatch.delenv("STATE_DIRECTORY", raising=False)
    folder = tmp_path / "fishd"
    assert learned_path(load(), None) == folder / "tail-simulated.bin"
    assert learned_path(load(), Path("/etc/fishd/camera.yaml")) == folder / "tail-camera.bin"
    assert learned_path(load(None, ["tail.learned=/x/y.bin"]), None) == Path("/x/y.bin")
    monkeypatch.setenv("STATE_DIRECTORY", "/var/lib/fishd-camera")
    assert learned_path(load(), None) == Path("/var/lib/fishd-camera/tail-simulated.bin")
