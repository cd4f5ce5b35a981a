"""Forks the test processes of pytest-xdist from a process that has loaded all tests and libraries.

Loading these takes nine tenths of the processor time until a test process runs its first test.
Without a server, a test process starts as usual.
"""

import contextlib
import gc
import os
import select
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path

LIBRARIES = (
    "aiohttp", "bluesky.plans", "gymnasium", "matplotlib.figure", "numba", "onnx", "pandas",
    "pyarrow.parquet", "scipy.optimize", "scipy.signal", "scipy.stats",
    "stable_baselines3", "torch.export",
)  # fmt: skip
"""Modules that take long to load and start no thread."""
SERVE = """
import sys

sys.path.insert(0, {folder!r})
from forked_workers import serve

del sys.path[0]
serve({number})
"""
"""Program of the server; it has no file, which processes of a test would load again."""


class Server:
    """The process that forks; it ends with the process that starts it, or with `close`."""

    def __init__(self) -> None:
        self._folder = tempfile.TemporaryDirectory()
        self._name = f"{self._folder.name}/workers"
        listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        listener.bind(self._name)
        listener.listen(100)
        code = SERVE.format(folder=str(Path(__file__).parent), number=listener.fileno())
        with listener:
            self._process = subprocess.Popen(
                [sys.executable, "-u", "-c", code],
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                pass_fds=[listener.fileno()],
            )

    @property
    def python(self) -> str:
        """Command that replaces Python for a test process."""
        return f"{sys.executable} -I -S {__file__} {self._name}"

    def close(self) -> None:
        with self._process:
            self._process.kill()
        self._folder.cleanup()


def serve(number: int) -> None:
    """Fork at each connection; in the fork, run the program in its first line of input."""
    gc.disable()
    for name in LIBRARIES:
        with contextlib.suppress(ImportError):  # of an extra that is not installed
            import_module(name)
    # Each test process collects again, but finds the modules loaded. The client, which runs without
    # the packages of the environment, cannot load pytest.
    import pytest

    pytest.main(["--collect-only", "-qq", "-p", "no:cacheprovider"])
    gc.collect()
    gc.freeze()
    names = [path.read_text().strip() for path in Path("/proc/self/task").glob("*/comm")]
    names.remove(Path("/proc/self/comm").read_text().strip())
    # A fork has no thread but this one; jemalloc starts its own again, others cannot be replaced.
    assert set(names) <= {"jemalloc_bg_thd"}, f"threads before a fork: {names}"
    listener = socket.socket(fileno=number)
    while listener in select.select([listener, 0], [], [])[0]:  # input ends with the tests
        connection = listener.accept()[0]
        _, streams, _, _ = socket.recv_fds(connection, 1, 3)
        if os.fork() == 0:
            break
        for stream in streams:
            os.close(stream)
        connection.close()
    else:
        sys.exit()
    listener.close()
    for target, stream in enumerate(streams):
        os.dup2(stream, target)
        os.close(stream)
    gc.enable()
    sys.argv[:] = ["-c"]
    main = sys.modules["__main__"].__dict__
    main["_connection"] = connection  # which closes, and ends the client, with this process
    exec(eval(sys.stdin.readline()), main)  # as execnet does


def start(name: str, arguments: Sequence[str]) -> None:
    """Run a test process with the streams of this one, and end with it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as client:
        try:
            client.connect(name)
        except OSError:
            signal.signal(signal.SIGINT, signal.default_int_handler)
            os.execv(sys.executable, [sys.executable, *arguments])
        socket.send_fds(client, [b"."], [0, 1, 2])
        client.recv(1)


if __name__ == "__main__":
    start(sys.argv[1], sys.argv[2:])
