"""Ctrl-C while a video is measured."""

from collections.abc import Iterator
from contextlib import contextmanager
from itertools import count
from typing import Any

import pytest

from fishd.camera.video_table import VideoTable


@contextmanager
def interrupt_after(rows: int, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Interrupt each command within the context after this number of rows."""
    add, calls = VideoTable.add, count(1)

    def interrupted(table: Any, row: Any) -> None:
        if next(calls) > rows:
            raise KeyboardInterrupt
        add(table, row)

    with monkeypatch.context() as patch:
        patch.setattr(VideoTable, "add", interrupted)
        yield
