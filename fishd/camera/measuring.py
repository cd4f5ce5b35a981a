"""Measurement of the fin angle in whole pictures, in a thread of its own.

The newest picture is measured; one that is replaced before its turn is counted as not measured.
Frames for learners therefore never wait for a measurement.
"""

import ctypes
import logging
import os
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from fishd.camera.messages import TailCondition, TailMessage
from fishd.camera.picture import turn_read_out
from fishd.camera.settings import CameraSettings
from fishd.camera.tail.learned import Learned
from fishd.camera.tail.learner import Learner
from fishd.camera.tail.lens import CannotUseLens, Lens
from fishd.camera.tail.meter import TailMeter
from fishd.core import files, text
from fishd.core.camera_frames import Pixels
from fishd.core.errors import FishdError, Refused

log = logging.getLogger(__name__)
LEARNING_TIMEOUT_S = 120.0
"""Longest time from a request to learn to its end; a client that is gone leaves no learning [s]."""


class _Picture(NamedTuple):
    session: str
    seq: int
    time: float
    """Middle of the exposure [s]."""
    pixels: Pixels
    """Whole turned picture."""


def learned_path(settings: CameraSettings, file: Path | None) -> Path:
    """Return the file of what a camera has learned; file: its settings, None without any."""
    if settings.tail.learned:
        return files.expand_user(settings.tail.learned)
    folder = os.environ.get("STATE_DIRECTORY", "").partition(":")[0]
    state = files.expand_user(os.environ.get("XDG_STATE_HOME") or "~/.local/state") / "fishd"
    name = file.stem if file else settings.source
    return (Path(folder) if folder else state) / f"tail-{name}.bin"


class Measuring:
    """Thread that measures, and learns; a context manager. Its methods do not block."""

    def __init__(
        self, settings: CameraSettings, path: Path, publish: Callable[[TailMessage], None]
    ) -> None:
        """
        path: file of what was learned, beside which that of the lens lies
        publish: called in the thread with each result
        """
        self._settings = settings.tail
        self._read_out = turn_read_out(settings.tail.read_out, settings.picture.rotate)
        self._path, self._lens_path = path, path.with_suffix(".lens.json")
        self._rotate = settings.picture.rotate
        self._publish = publish
        self._changed = threading.Condition()
        self._picture: _Picture | None = None
        self._session = ""
        self._learner: Learner | None = None
        self._learning_ends = 0.0
        self._is_finishing = self._is_stopping = False
        self.learned: Learned | None = None
        """Learned tail; None before a tail is learned."""
        self.lens: Lens | None = None
        """Calibration of the lens; None without one."""
        self._lens_problem = ""
        self._meter: TailMeter | None = None
        self.condition: TailCondition = "unlearned" if self._settings.measure else "off"
        self._measuring_problem = self._learning_problem = ""
        self.measured = self.dropped = 0
        self._thread = threading.Thread(target=self._run, name="measuring", daemon=True)

    def __enter__(self) -> "Measuring":
        """Load what was learned, and start the thread."""
        if self._settings.measure:
            try:
                if self._lens_path.exists():
                    lens = Lens.load(self._lens_path)
                    lens.check(lens.size, self._rotate)
                    self.lens = lens
                if self._path.exists():
                    learned = Learned.load(self._path)
                    learned.check_lens(self.lens)
                    self._use(learned)
            except FishdError as error:
                self.condition = "unusable"
                self._fail_to_measure(text.error_message(error))
                if isinstance(error, CannotUseLens):
                    self._lens_problem = self._measuring_problem
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        with self._changed:
            self._is_stopping = True
            self._changed.notify()

    @property
    def problem(self) -> str:
        """Reason why the latest learning failed, or no fin angle is known; empty without one."""
        return self._learning_problem or self._measuring_problem

    def offer(self, session: str, seq: int, moment: float, pixels: Pixels) -> None:
        """Take a whole picture of a frame; moment: middle of the exposure [s]."""
        if self.condition not in ("learning", "measuring"):
            return
        with self._changed:
            self.dropped += self._picture is not None and self.condition == "measuring"
            self._picture = _Picture(session, seq, moment, pixels)
            self._changed.notify()

    def set_lens(self, lens: Lens) -> None:
        """Save a calibration, with which the tail has to be learned; raises `CannotUseLens`."""
        lens.check(lens.size, self._rotate)
        with suppress(OSError):  # `save` says why
            self._lens_path.parent.mkdir(parents=True, exist_ok=True)
        lens.save(self._lens_path)
        with self._changed:
            self.lens, self._learner, self._lens_problem = lens, None, ""
            if self.condition == "off":
                return
            self.learned, self._meter, self.condition = None, None, "unlearned"
            self._learning_problem, self._measuring_problem = "", ""

    def begin_learning(self) -> None:
        """Collect pictures from now on; raises `Refused` where measuring is off."""
        if self.condition == "off":
            raise Refused("tail-off", "this camera does not measure: set tail.measure to true")
        if self._lens_problem:
            raise Refused("bad-lens", self._lens_problem)
        with self._changed:
            self._picture, self._learner = None, Learner(self.lens)
            self._is_finishing = False
            self._learning_ends = time.monotonic() + LEARNING_TIMEOUT_S
            self.condition, self._learning_problem = "learning", ""

    def finish_learning(self) -> None:
        """Learn from the collected pictures; the condition shows when that has been done."""
        with self._changed:
            self._is_finishing = self._learner is not None
            self._changed.notify()

    def cancel_learning(self) -> None:
        """Forget the collected pictures, and measure on with what was learned before."""
        with self._changed:
            self._learner, self._is_finishing = None, False
            if self.condition == "learning":
                self.condition = "measuring" if self.learned else "unlearned"

    # The rest runs in the thread.

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(self._has_work, timeout=1.0)
                if self._is_stopping:
                    return
                picture, self._picture = self._picture, None
                learner, is_finishing = self._learner, self._is_finishing
            try:
                if learner:
                    self._learn(learner, picture, is_finishing)
                    if not self._learner:  # its pictures are 20 MB
                        del learner
                        ctypes.CDLL(None).malloc_trim(0)
                elif picture:
                    self._measure(picture)
            except FishdError as error:
                self._fail_to_measure(text.error_message(error))
            except Exception as error:
                self._fail_to_measure(text.describe_error(error), with_place=True)

    def _fail_to_measure(self, problem: str, *, with_place: bool = False) -> None:
        """Store the reason, and log one that is new; with_place: with the place in the program."""
        if problem != self._measuring_problem:
            log.warning("the fin angle is not measured: %s", problem, exc_info=with_place)
        self._measuring_problem = problem

    def _has_work(self) -> bool:
        return self._is_stopping or self._is_finishing or self._picture is not None

    def _measure(self, picture: _Picture) -> None:
        learned = self.learned
        if learned and (self._meter is None or picture.session != self._session):
            self._meter, self._session = TailMeter(learned), picture.session
        if self._meter is None:
            return
        reading = self._meter.read(picture.time, picture.pixels, *self._read_out)
        self.measured += 1
        self._measuring_problem = ""
        fields = {name: getattr(reading, name) for name in reading.__struct_fields__}
        self._publish(TailMessage(session=picture.session, seq=picture.seq, **fields))

    def _learn(self, learner: Learner, picture: _Picture | None, is_finishing: bool) -> None:
        """Add a picture to those to learn from, or learn from them."""
        learned, problem = None, ""
        try:
            if is_finishing:
                learned = learner.finish()
                self._path.parent.mkdir(parents=True, exist_ok=True)
                learned.save(self._path)
            elif time.monotonic() > self._learning_ends:
                problem = "the learning was not finished in time"
            elif picture:
                learner.add(picture.time, picture.pixels)
        except OSError as error:
            problem = f"{self._path.parent} cannot be written: {error.strerror or error}"
        except FishdError as error:
            problem = text.error_message(error)
        except Exception as error:
            problem = text.describe_error(error)
            log.exception("the tail cannot be learned")
        if not (learned or problem):
            return
        with self._changed:
            if self._learner is not learner:  # learning was requested again meanwhile
                return
            self._learner, self._is_finishing = None, False
            if learned:
                self._use(learned)
            self.condition = "measuring" if self.learned else "unlearned"
            self._learning_problem = problem
        log.log(
            logging.WARNING if problem else logging.INFO,
            "%s",
            problem or f"the tail was learned: {self._path}",
        )

    def _use(self, learned: Learned) -> None:
        self.learned, self._meter, self._measuring_problem = learned, None, ""
        self.condition = "measuring"
