"""What is an address that a ZeroMQ socket of fishd can bind or connect to."""

import re

_ADDRESS = re.compile(r"tcp://[^/\s]+:(?P<port>[0-9]+)|ipc://[^@\s]\S*")


def is_address(text: str) -> bool:
    """Is it tcp://HOST:PORT or ipc://PATH?"""
    found = _ADDRESS.fullmatch(text)
    return found is not None and int(found["port"] or 0) < 65536
