"""Running `fishd-camera` with separate addresses, and one with an emulated V4L2 camera."""

import contextlib
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from fishd.camera.client import CameraClient, CameraLost
from fishd.camera.messages import CameraState
from rigs import v4l2_kernel
from rigs.processes import PATIENCE, Process, sets, wait_until
from rigs.v4l2_kernel import DEVICE, Faults

P = TypeVar("P", bound="CameraProcess")
COMMAND = [str(Path(sys.executable).with_name("fishd-camera"))]


class CameraProcess(Process):
    """Running `fishd-camera`."""

    def __init__(self, folder: Path, *pairs: str, command: list[str] | None = None) -> None:
        """pairs: settings, KEY=VALUE"""
        self.endpoint = f"ipc://{folder}/camera-requests"
        self.frames = f"ipc://{folder}/camera-frames"
        own = (
            f"publish.requests={self.endpoint}",
            f"publish.frames={self.frames}",
            f"tail.learned={folder}/tail.bin",
        )
        super().__init__(*(command or COMMAND), *sets(*own, *pairs))

    def client(self, **options: Any) -> CameraClient:
        return CameraClient(self.endpoint, **({"timeout": PATIENCE} | options))

    def status(self) -> CameraState:
        with self.client() as client:
            return client.status()

    def until(self, true: Callable[[CameraState], bool]) -> CameraState:
        """Wait for a condition, and return the state."""
        states: list[CameraState] = []

        def is_so() -> bool:
            assert self.process.poll() is None, self.finish()
            with contextlib.suppress(CameraLost), self.client(timeout=1.0) as client:
                states.append(client.status())
                return true(states[-1])
            return False

        wait_until(is_so)
        return states[-1]

    def is_in(self, condition: str) -> CameraState:
        return self.until(lambda state: state.state == condition)


@contextlib.contextmanager
def running_camera(folder: Path, *pairs: str) -> Iterator[CameraProcess]:
    """Run a `fishd-camera` that always ends with the context."""
    with _ended(CameraProcess(folder, *pairs)) as process:
        yield process


class V4l2Rig(CameraProcess):
    """`fishd-camera` with an emulated camera that a test can disturb."""

    def __init__(self, folder: Path, *pairs: str, **faults: Any) -> None:
        self._file = folder / "faults.json"
        self.set(**faults)
        program = [sys.executable, v4l2_kernel.__file__, str(self._file)]
        super().__init__(folder, "source=v4l2", f"v4l2.device={DEVICE}", *pairs, command=program)

    def set(self, **faults: Any) -> None:
        """Set the faults of the camera."""
        part = self._file.with_suffix(".part")
        part.write_bytes(msgspec.json.encode(Faults(**faults)))
        part.replace(self._file)


@contextlib.contextmanager
def v4l2_rig(folder: Path, *pairs: str, **faults: Any) -> Iterator[V4l2Rig]:
    with _ended(V4l2Rig(folder, *pairs, **faults)) as rig:
        yield rig


@contextlib.contextmanager
def _ended(process: P) -> Iterator[P]:
    try:
        process.until(lambda state: True)
        yield process
    finally:
        print(f"fishd-camera said:\n{process.end()[2]}")  # pytest shows it where a test failed
