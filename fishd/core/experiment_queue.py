"""The queue of experiments of a fish: a file that terminals, pages and its runner change.

It lies in the folder of runs. A lock orders the changes; another lock is held by the runner, of
which there is one at a time.
"""

import re
import time
import zlib
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Annotated, Literal

import msgspec
from msgspec import Meta, Struct
from msgspec.structs import asdict

from fishd.core import files, text
from fishd.core.addresses import find_control_address, is_default_address
from fishd.core.decoding import decoder
from fishd.core.errors import FishdError
from fishd.core.files import FileProblem, NoFile, sync_folder, write_atomically
from fishd.core.process.lockfile import LockHeld, find_lock_holder, locked

VERSION = 1
"""Version of the format of the file."""
MAX_ITEMS = 200
MAX_REPEAT = 1000
MAX_PAST = 12
"""Number of runs that have ended of which the file keeps the outcome."""
MAX_FILE_BYTES = 2**20
LOCK_TIMEOUT_S = 5.0
"""Longest wait for another process that changes the file [s]."""
RUNNER_TIMEOUT_S = 1.0
"""Longest wait for the lock of the runner, which a look at it holds for a moment [s]."""

Repeat = Annotated[int, Meta(ge=1, le=MAX_REPEAT)]
Time = Annotated[float, Meta(ge=0, le=2**33)]
"""Unix time [s]; a later one than that of the year 2242 cannot be shown."""
Outcome = Literal["done", "stopped", "failed"]


class QueueError(FishdError):
    """A queue cannot be read or changed."""


class Item(Struct, forbid_unknown_fields=True):
    """An experiment that waits or runs."""

    id: int
    words: Annotated[list[str], Meta(min_length=1)]
    """Verb and arguments."""
    cwd: str
    """Folder in which it was added, to which relative paths belong."""
    repeat: Repeat = 1
    """Number of runs that are left, the present one included."""
    seconds: float | None = None
    """Expected duration of a run [s]; None if it is not known."""
    run: Annotated[str, Meta(pattern=r"^[\w-]*$")] = ""
    """Name of the folder of the run that has begun, or was interrupted and is resumed."""


class Past(Struct, forbid_unknown_fields=True):
    """A run that has ended."""

    words: list[str]
    run: str
    ended: Time
    outcome: Outcome
    message: str = ""
    """Result, or the reason of a failure."""


class Queue(Struct, forbid_unknown_fields=True):
    """Content of the file."""

    version: int = VERSION
    next_id: int = 1
    items: list[Item] = []
    current: int | None = None
    """Identifier of the item that runs, or ran when its runner was killed."""
    began: Time = 0.0
    """Time at which that began."""
    pauses: bool = False
    """Whether it pauses after the run that goes on."""
    pause_at: Time | None = None
    """Time at which it interrupts what runs, and pauses."""
    reason: str = ""
    """Reason for which it has paused."""
    past: list[Past] = []
    """The latest runs, the oldest first."""

    def find(self, number: int) -> Item:
        """Return the item with this identifier; raise `QueueError` if there is none."""
        for item in self.items:
            if item.id == number:
                return item
        known = ", ".join(str(item.id) for item in self.items) or "it is empty"
        raise QueueError(f"the queue has no experiment {number}; in the queue: {known}")

    def add(self, words: list[str], repeat: int, seconds: float | None) -> Item:
        """Append an experiment that was checked; raise `QueueError` if the queue is full."""
        if len(self.items) >= MAX_ITEMS:
            raise QueueError(f"the queue is full: it has {MAX_ITEMS} experiments")
        item = Item(self.next_id, words, str(Path.cwd()), repeat, seconds)
        self.items.append(item)
        self.next_id += 1
        return item

    def move(self, number: int, position: int) -> None:
        """Move an item to a position, counted from 1; raise `QueueError`."""
        item = self.find(number)
        self.items.remove(item)
        self.items.insert(position - 1, item)

    def remove(self, number: int) -> None:
        """Remove an item that does not run; raise `QueueError`."""
        item = self.find(number)
        if number == self.current:
            raise QueueError(
                f"experiment {number} runs; stop it first, with 'fishctl queue pause --now'"
            )
        self.items.remove(item)

    def pause(self, at: float | None) -> None:
        """Pause at a unix time [s], or after the run that goes on."""
        if at is None:
            self.pauses = True
        else:
            self.pause_at = at

    def cancel_pause(self) -> None:
        """Pause neither after the run that goes on nor at a time."""
        self.pauses, self.pause_at = False, None

    def clear(self) -> None:
        """Remove all items but the one that runs, and what is known of the past."""
        self.items = [item for item in self.items if item.id == self.current]
        self.past, self.reason = [], ""


class View(Queue):
    """A queue for display; `current` is the item that runs."""

    state: Literal["running", "paused", "empty"] = "empty"
    elapsed: float = 0.0
    """Time since that item began [s]."""
    left: float = 0.0
    """Expected time until the end of all items whose duration is known [s]."""
    unknown: int = 0
    """Number of items whose duration is not known."""


class _Versioned(Struct):
    version: int


_decode: Callable[[bytes], Queue] = decoder(Queue)
_decode_version: Callable[[bytes], _Versioned] = decoder(_Versioned)


class QueueFile:
    """The file of the queue of one fish."""

    def __init__(self, runs: Path, endpoint: str | None) -> None:
        """
        runs: folder of recordings and experiments
        endpoint: control socket of the fish; None for that of this machine
        """
        self.runs, self.address = runs, endpoint or find_control_address()
        name = "queue"
        if not is_default_address(self.address):
            place = re.sub(r"[^A-Za-z0-9.]+", "-", self.address)[-80:]
            name = f"queue-{place}-{zlib.crc32(self.address.encode()):08x}"
        self.path = runs / f"{name}.json"
        self._runner = runs / f"{name}.runner"

    def read(self) -> Queue:
        """Return the queue; raise `QueueError` for a file that this fishd does not understand."""
        try:
            if self.path.is_symlink():
                raise FileProblem("is a symbolic link; a regular file is needed")
            content = files.read(self.path, MAX_FILE_BYTES, "a queue")
            if (version := _decode_version(content).version) > VERSION:
                raise QueueError(
                    f"{self.path} was written by a later fishd (version {version} of its format, "
                    f"here {VERSION}); use that fishd, or rename the file for an empty queue"
                )
            return _decode(content)
        except NoFile:
            return Queue()
        except FileProblem as problem:
            raise QueueError(f"{self.path} {problem}") from None
        except msgspec.DecodeError as error:
            raise QueueError(
                f"{self.path} is damaged: {text.error_message(error)}; mend it, or rename it for "
                "an empty queue"
            ) from None

    @contextmanager
    def changing(self) -> Iterator[Queue]:
        """Yield the newest queue, which is written at the end, while no other process changes it.

        Raise `QueueError`, without a change of the file.
        """
        problem = f"{self.path} cannot be written"
        try:
            with files.os_errors(QueueError, problem, "the queue is unchanged"):
                self.runs.mkdir(parents=True, exist_ok=True)
                with locked(self.path, timeout=LOCK_TIMEOUT_S):
                    queue = self.read()
                    if self.find_runner() is None:
                        _forget_killed_runner(queue)
                    yield queue
                    write_atomically(self.path, msgspec.json.format(msgspec.json.encode(queue)))
                    sync_folder(self.runs)
        except LockHeld as held:
            raise QueueError(f"{self.path} is being changed by process {held.pid}") from None

    @contextmanager
    def running(self) -> Iterator[None]:
        """Be the runner while this lasts; raise `QueueError` if there is one."""
        with ExitStack() as stack:
            try:
                with files.os_errors(QueueError, f"{self._runner}.lock cannot be written"):
                    self.runs.mkdir(parents=True, exist_ok=True)
                    stack.enter_context(locked(self._runner, timeout=RUNNER_TIMEOUT_S))
            except LockHeld as held:
                raise QueueError(f"process {held.pid} runs this queue already") from None
            yield

    def find_runner(self) -> str | None:
        """Return the process that runs the queue; None if none does."""
        return find_lock_holder(self._runner)

    def view(self) -> View:
        """Return the queue for display; raise `QueueError`."""
        is_running = self.find_runner() is not None  # first: a runner that ends has written before
        queue = self.read()
        if not is_running and queue.current is not None:
            is_running = self.find_runner() is not None  # it may have begun since
        if not is_running:
            _forget_killed_runner(queue)
        elapsed = max(0.0, time.time() - queue.began) if queue.current is not None else 0.0
        left = sum((item.seconds or 0.0) * item.repeat for item in queue.items)
        begun = next((item.seconds or 0.0 for item in queue.items if item.id == queue.current), 0.0)
        return View(
            **asdict(queue),
            state="running" if is_running else "paused" if queue.items else "empty",
            elapsed=elapsed,
            left=left - min(elapsed, begun),
            unknown=sum(item.seconds is None for item in queue.items),
        )


def _forget_killed_runner(queue: Queue) -> None:
    """Note which item ran when a runner was killed; nothing starts again by itself."""
    if queue.current is None:
        return
    began = time.strftime("%Y-%m-%d %H:%M", time.localtime(queue.began))
    queue.reason = (
        f"its runner, or this machine, went down while experiment {queue.current} ran, which began "
        f"at {began}"
    )
    queue.current = None
