"""For trainings on a Dask cluster: its scheduler, a way to stop them, folders sent as bytes."""

import io
import time
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from uuid import uuid4

from fishd.core.errors import FishdError

CONNECT = 10.0
"""How long to wait for a scheduler that does not answer [s]."""
_POLL = 1.0
"""How often a worker asks the scheduler whether to stop [s]."""


@contextmanager
def scheduler(address: str | None) -> Iterator[Any]:
    """A connection to the scheduler, and an event there that means stop; None without address."""
    if address is None:
        yield None
        return
    from distributed import Client, Event

    try:
        client = Client(address, timeout=CONNECT, name="fishctl learn")
    except (OSError, ValueError, TypeError, TimeoutError) as error:
        raise FishdError(f"no Dask scheduler answers at {address}: {error}") from None
    with client:
        if not client.scheduler_info()["workers"]:
            raise FishdError(f"the Dask scheduler at {address} has no workers")
        yield Event(f"fishd-stop-{uuid4().hex}", client=client)


def stop_requested(name: str) -> Callable[[], bool]:
    """A function, for use on a Dask worker, that tells whether an event of this name was set."""
    from distributed import Event, get_client

    event = Event(name, client=get_client())
    was_set, next_look = False, 0.0

    def stop() -> bool:
        nonlocal was_set, next_look
        if not was_set and time.monotonic() >= next_look:
            was_set = event.is_set()
            next_look = time.monotonic() + _POLL
        return was_set

    return stop


def pack(folder: Path) -> bytes:
    """All files of a folder as one zip archive."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for path in sorted(folder.rglob("*")):
            archive.write(path, path.relative_to(folder))
    return buffer.getvalue()


def unpack(files: bytes, folder: Path) -> None:
    """Write the files of such an archive into a folder."""
    with zipfile.ZipFile(io.BytesIO(files)) as archive:
        archive.extractall(folder)
