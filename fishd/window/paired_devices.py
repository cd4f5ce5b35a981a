"""The paired devices of a window, in memory: a request waits for no disk, and for no other process.

One thread reads and writes their file. While that is damaged, or its disk does not answer, each
device keeps its access, so that its emergency stop works.
"""

import asyncio
import logging
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import TypeVar

from fishd.core import text
from fishd.window.devices import Device, DeviceError, Devices, DevicesBusy, hash_token

log = logging.getLogger(__name__)
T = TypeVar("T")

MAX_WAITING_CHANGES = 8
"""Number of changes above which a further one is refused."""
SEEN_PERIOD_S = 3600.0
"""Shortest time between two stored times at which a device was seen [s]."""
SEEN_RETRY_S = 60.0
"""Time between two attempts to store these times [s]."""


class PairedDevices:
    """The paired devices of a state folder; use it in one event loop."""

    def __init__(self, folder: Path) -> None:
        """Raises `DeviceError` if there is no such folder, and none can be created."""
        self._file = Devices(folder)
        """Used only by the thread `disk` from now on."""
        self._disk = ThreadPoolExecutor(1, thread_name_prefix="devices")
        self._reading: asyncio.Future[None] | None = None
        self._waiting = 0
        self._seen: dict[str, float] = {}
        """Time at which each device was seen [s, unix]."""
        self._next_note = 0.0
        self._problem = ""
        self._devices: tuple[Device, ...] = ()
        self._read()
        if self._problem:
            self._devices = self._file.read_copy()

    def all(self) -> tuple[Device, ...]:
        """Return all devices."""
        return self._devices

    def find(self, secret: str | None) -> Device | None:
        """Return the device with this token in its cookie, and note that it was seen."""
        if not secret or len(secret) > 200:
            return None
        digest = hash_token(secret)
        device = next((entry for entry in self.all() if entry.token == digest), None)
        if device:
            self._seen[device.id] = time.time()
        return device

    def get(self, identity: str) -> Device:
        """Return the device with this id; raise `DeviceError` if there is none."""
        for device in self.all():
            if device.id == identity:
                return device
        raise DeviceError("this device is no longer paired")

    async def pair(self, token: str, name: str) -> tuple[Device, str]:
        """Use up a token; return the new device, and the token for its cookie."""
        return await self._change(lambda: self._file.pair(token, name))

    async def revoke(self, name: str) -> Device:
        """Remove the device with this name or id; raise `DeviceError` if there is none."""
        return await self._change(lambda: self._file.revoke(name))

    def refresh(self) -> None:
        """Read the file soon if it has changed, unless the disk has not answered yet."""
        if self._reading is None or self._reading.done():
            self._reading = asyncio.get_running_loop().run_in_executor(self._disk, self._read)

    async def _change(self, change: Callable[[], T]) -> T:
        """Change the file in the thread of the disk; raise `DeviceError`."""

        def change_and_read() -> T:
            result = change()
            self._read()
            return result

        if self._waiting >= MAX_WAITING_CHANGES:
            raise DevicesBusy("too many devices are being paired; try again later")
        self._waiting += 1
        try:
            return await asyncio.get_running_loop().run_in_executor(self._disk, change_and_read)
        except OSError as error:
            raise DevicesBusy(f"it could not be stored: {text.describe_error(error)}") from None
        finally:
            self._waiting -= 1

    def _read(self) -> None:
        """Follow the file, and store there when devices were seen."""
        try:
            self._devices, problem = self._file.all(), ""
            self._note_seen()
        except (DeviceError, OSError) as error:
            problem = text.error_message(error)
        if problem and problem != self._problem:
            log.error("%s; until then, paired devices keep their access", problem)
        self._problem = problem

    def _note_seen(self) -> None:
        due = {
            device.id: self._seen[device.id]
            for device in self._devices
            if abs(self._seen.get(device.id, device.seen) - device.seen) > SEEN_PERIOD_S
        }
        if due and time.monotonic() >= self._next_note:
            self._next_note = time.monotonic() + SEEN_RETRY_S
            with suppress(DeviceError, OSError):
                self._file.note_seen(due)
