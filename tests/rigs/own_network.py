"""A network for each test process: none finds the fishds, names and ports of another one.

Names in the kernel, by which clients find a fishd without a file, belong to a network.
"""

import ctypes
import fcntl
import os
import socket
import struct
from contextlib import suppress

_CLONE_NEWNET = 0x40000000
_SIOCSIFADDR, _SIOCSIFFLAGS = 0x8916, 0x8914
_UP = 0x1 | 0x8 | 0x40
"""Flags of an interface that is up, as that of the loopback is."""
ADDRESS = "198.51.100.1"
"""Address of this machine that is not a loopback address, for clients from the network."""


def isolate() -> None:
    """Move this process and those that it starts into a network of their own, if it may do that.

    Only root may; other users share the network of the machine.
    """
    if os.geteuid() or ctypes.CDLL(None).unshare(_CLONE_NEWNET):
        return
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as control:
        fcntl.ioctl(control, _SIOCSIFFLAGS, struct.pack("16sH14x", b"lo", _UP))
        with suppress(OSError):  # tests from the network then use a loopback address
            address = struct.pack("HH4s8x", socket.AF_INET, 0, socket.inet_aton(ADDRESS))
            fcntl.ioctl(control, _SIOCSIFADDR, struct.pack("16s16s", b"lo:1", address))
