"""Forks the programs of fishd from a process that has loaded them.

Loading takes most of the processor time of a process that a test starts. Each test process has one
such server. A program whose environment Python reads while it starts is started as usual, and so is
every program where real time is judged.
"""

import atexit
import ctypes
import gc
import os
import pickle
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

BIN = Path(sys.executable).parent
UNHURRIED_COMMAND = (sys.executable, "-P", str(Path(__file__).with_name("unhurried.py")))
PROGRAMS = {
    (str(BIN / "fishd"),): ("fishd", False),
    (str(BIN / "fishctl"),): ("fishctl", False),
    (str(BIN / "fishd-camera"),): ("fishd_camera", False),
    (str(BIN / "fishd-window"),): ("fishd_window", False),
    (*UNHURRIED_COMMAND, "fishd"): ("fishd", True),
    (*UNHURRIED_COMMAND, "fishctl"): ("fishctl", True),
    (*UNHURRIED_COMMAND, "fishd-window"): ("fishd_window", True),
}
"""Function and patience of each program, by the beginning of its command."""
LOADED_LATER = {
    "fishd_camera": ["fishd.camera.main"],
    "fishd_window": ["fishd.window.main", "fishd.window.window_server"],
}
"""Modules that the server loads when a program is started for the first time."""
READ_AT_START = ("PYTHON", "LC_", "LANG", "MALLOC_", "OMP_", "OPENBLAS_")
"""Beginnings of the names of variables that take effect while a process starts.

The path of libraries is not one of them: cv2 changes it where it is loaded, and no test does.
"""
PR_SET_CHILD_SUBREAPER = 36


def start(command: Sequence[str], **options: Any) -> "subprocess.Popen[Any]":
    """Start a program; options: those of `subprocess.Popen`."""
    if _find_program(command) and _SERVER.can_start(options):
        return _Forked(command, **options)
    return subprocess.Popen(command, **options)


def _find_program(command: Sequence[str]) -> tuple[str, bool, list[str]] | None:
    for words, (name, unhurried) in PROGRAMS.items():
        if tuple(command[: len(words)]) == words:
            return name, unhurried, list(command[len(words) :])
    return None


def _variables() -> dict[str, str]:
    variables = {name: text for name, text in os.environ.items() if name.startswith(READ_AT_START)}
    variables.pop("PYTHONSAFEPATH", None)  # which the commands set in any case
    return variables


class _Server:
    """The server of this process. It ends with this process."""

    def __init__(self) -> None:
        self._variables = _variables()
        self._connection: socket.socket | None = None
        self._lock = threading.Lock()

    def can_start(self, options: dict[str, Any]) -> bool:
        """Return whether a fork of the server behaves as a new process would."""
        return (
            options.keys() <= {"stdin", "stdout", "stderr", "text"}
            and _variables() == self._variables
            and not os.environ.get("JUDGES_REAL_TIME")
        )

    def fork(self, command: Sequence[str], streams: Sequence[int]) -> int:
        """Make a child of this process that runs a program; return its process ID."""
        libc = ctypes.CDLL(None)
        request = pickle.dumps((_find_program(command), str(Path.cwd()), dict(os.environ)))
        with self._lock:
            if self._connection is None:
                self._connection = self._connect()
            libc.prctl(PR_SET_CHILD_SUBREAPER, 1)  # makes its orphans children of this process
            try:
                socket.send_fds(self._connection, [request], streams)
                pid = int(self._connection.recv(100))
                assert self._connection.recv(100) == b"done"
            finally:
                libc.prctl(PR_SET_CHILD_SUBREAPER, 0)
        return pid

    def _connect(self) -> socket.socket:
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            number = theirs.fileno()
            self._process = subprocess.Popen(
                [sys.executable, "-P", __file__, str(number)],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                pass_fds=[number],
            )
        atexit.register(self._close, ours)
        return ours

    def _close(self, connection: socket.socket) -> None:
        connection.close()
        self._process.wait()


_SERVER = _Server()


class _Forked(subprocess.Popen[Any]):
    """A program whose process is a fork of the server."""

    def _execute_child(self, args: Sequence[str], *rest: Any) -> None:
        sys.audit("subprocess.Popen", args[0], args, None, None)
        pipes = rest[9:15]  # for each stream, the end of the child and that of this process
        ends = (pipes[0], pipes[3], pipes[5])
        streams = [own if own >= 0 else usual for usual, own in enumerate(ends)]
        self.pid = _SERVER.fork(args, streams)
        self._child_created = True
        self._close_pipe_fds(*pipes)  # type: ignore[attr-defined]


def serve(connection: socket.socket) -> Callable[[], None]:
    """Fork at each request; return, in the fork, the function that it is to run."""
    while True:
        message, streams, _, _ = socket.recv_fds(connection, 200_000, 3)
        if not message:
            sys.exit()
        (name, unhurried, arguments), folder, variables = pickle.loads(message)
        for module in LOADED_LATER.get(name, ()):
            import_module(module)
        if child := os.fork():
            os.waitpid(child, 0)
            connection.send(b"done")
            for stream in streams:
                os.close(stream)
        elif child := os.fork():
            connection.send(b"%d" % child)
            os._exit(0)  # the test process then adopts the child
        else:
            break
    connection.close()
    os.chdir(folder)
    os.environ.clear()
    os.environ.update(variables)
    os.environ["PYTHONSAFEPATH"] = "1"  # as `fishd.__main__` does where it is loaded
    for number, stream in enumerate(streams):
        os.dup2(stream, number)
        os.close(stream)
    sys.stdout.reconfigure(line_buffering=sys.stdout.isatty())  # type: ignore[union-attr]
    sys.argv = [name.replace("_", "-"), *arguments]
    if unhurried:
        have_patience()
    return getattr(__main__, name)


if __name__ == "__main__":
    gc.disable()
    sys.path.insert(0, str(Path(__file__).parent))
    from unhurried import have_patience

    del sys.path[0]
    from fishd import __main__
    from fishd.controllers.policy.runtime import preload

    for module in ("fishd.daemon.main", "fishd.cli.main"):
        import_module(module)
    preload()
    gc.freeze()
    program = serve(socket.socket(fileno=int(sys.argv[1])))
    program()
