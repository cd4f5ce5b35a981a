"""Unix clock of the programs of a test, which can be set at any time; other programs keep theirs.

The programs are true ones: their Python replaces its functions of the unix clock at its start. The
monotonic clock and the times of files are those of the machine.
"""

import os
import struct
from pathlib import Path

_CODE = """
import ctypes, datetime, gc, mmap, os, struct, time

with open(os.environ["STEPPED_CLOCK"], "rb") as _file:
    _offset = mmap.mmap(_file.fileno(), 8, access=mmap.ACCESS_READ)
_time = time.time
time.time = lambda: _time() + struct.unpack("<d", _offset[:8])[0]
time.time_ns = lambda: round(time.time() * 1e9)

# A subclass of datetime would crash pandas: the method of the type itself is replaced.
_type = datetime.datetime
gc.get_referents(_type.__dict__)[0]["now"] = classmethod(
    lambda cls, tz=None: cls.fromtimestamp(time.time(), tz)
)
ctypes.pythonapi.PyType_Modified(ctypes.py_object(_type))
"""


class WallClock:
    """A unix clock that is ahead of that of the machine."""

    def __init__(self, folder: Path, ahead: float = 0.0) -> None:
        """folder: existing folder for its files; ahead: see `set`"""
        folder.mkdir(exist_ok=True)
        (folder / "sitecustomize.py").write_text(_CODE, encoding="utf-8")
        self._file = folder / "offset"
        self.set(ahead)
        path = os.pathsep.join(filter(None, (str(folder), os.environ.get("PYTHONPATH"))))
        self.environment = {"PYTHONPATH": path, "STEPPED_CLOCK": str(self._file)}
        """Variables with which a program uses this clock."""

    def set(self, ahead: float) -> None:
        """Set the clock to the time of the machine and some seconds more; less if negative [s]."""
        with self._file.open("r+b" if self._file.exists() else "wb") as file:
            file.write(struct.pack("<d", ahead))
