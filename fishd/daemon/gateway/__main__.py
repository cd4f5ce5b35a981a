"""Fork server of the gateways: `python -m fishd.daemon.gateway LINK`.

It has loaded everything that gateways need, and forks one when fishd requests it: that takes
hundredths of a second, while the start of Python takes tenths. Only fishd starts it. It ends with
fishd, and the gateways end with it, even if they are stopped: the kernel sends them SIGKILL.

LINK: file descriptor of the link to fishd.
"""

import ctypes
import gc
import os
import signal
import socket
import sys
from contextlib import suppress
from types import ModuleType

from fishd.daemon.gateway import link

_LINGER_MS = 100
"""Longest time for the last messages to leave [ms]."""
_PR_SET_PDEATHSIG, _PR_SET_NAME = 1, 15


def main(number: str) -> int:
    """Fork gateways on request until fishd ends."""
    _end_with_parent()
    server_pid = os.getpid()
    _set_name("fishd-gateways")
    for ignored in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(ignored, signal.SIG_IGN)  # these processes end when fishd ends
    gc.disable()  # imports leave no garbage, and searching for it takes a tenth of the time
    from fishd.daemon.gateway import publisher, router

    gc.freeze()  # keeps memory pages shared with the gateways
    modules = {link.TELEMETRY: publisher, link.CONTROL: router}
    modules |= {link.KEYED_TELEMETRY: publisher, link.KEYED_CONTROL: router}
    connection = socket.socket(fileno=int(number))
    connection.setblocking(True)
    children: dict[str, int] = {}
    try:
        connection.send(link.READY)
        while True:
            message, descriptors, _, _ = socket.recv_fds(connection, link.MAX_MESSAGE_BYTES, 2)
            if message == link.PING:
                connection.send(link.PONG)
            elif message.startswith(link.START):
                kind, address = link.kind_and_address(message)
                former = children.pop(kind, None)
                if former is not None:  # an ended child keeps its pid until waitpid
                    os.kill(former, signal.SIGKILL)
                try:
                    pid = os.fork()
                except OSError as error:
                    pid = 0
                    outcome = f"it cannot be started: {error.strerror}"
                else:
                    if not pid:
                        _end_with_parent()
                        connection.close()
                        if os.getppid() != server_pid:
                            os._exit(1)
                        _serve(modules[kind], kind, address, *descriptors)
                    children[kind] = pid
                    outcome = ""
                for descriptor in descriptors:
                    os.close(descriptor)
                if former is not None:
                    status = os.waitstatus_to_exitcode(os.waitpid(former, 0)[1])
                    outcome = outcome or f"its process ended with status {status}"
                connection.send(link.started(kind, pid, outcome))
            else:
                return 0
    except ConnectionError:  # fishd was killed
        return 0


def _serve(module: ModuleType, kind: str, address: str, link_number: int, listener: int) -> None:
    """Run a gateway until fishd ends or a limit is exceeded; never return."""
    status = 1
    try:
        _set_name(f"fishd-{kind}")
        gc.enable()
        status = _run(module, address, socket.socket(fileno=link_number), listener)
    except BaseException:
        sys.excepthook(*sys.exc_info())
    finally:
        sys.stderr.flush()
        os._exit(status)  # without closing ZeroMQ, which would take long to free its memory


def _run(module: ModuleType, address: str, connection: socket.socket, listener: int) -> int:
    """Serve at the listener; return the exit status."""
    import zmq

    from fishd.daemon.gateway.limits import ResourceLimits

    connection.setblocking(False)
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    server = context.socket(module.SOCKET)
    module.configure(server)
    address, _, keys = address.partition(" ")
    known = None
    if keys:
        from fishd.daemon.gateway.keys import require_keys

        known = require_keys(server, *keys.split(" ", 1))
    server.set(zmq.USE_FD, listener)
    server.bind(address)
    limits = ResourceLimits(module.MAX_MEMORY_BYTES, module.MAX_CONNECTIONS)
    with suppress(OSError):  # see below
        connection.send(link.READY + (known.mistake.encode() if known else b""))
    why = module.run(connection, server, limits, known)
    if why:
        with suppress(OSError):  # fishd has ended, or the link is full
            connection.send(link.NOTICE + why.encode())
        return 1
    server.close(linger=_LINGER_MS)
    context.term()
    return 0


def _end_with_parent() -> None:
    """Let the kernel send SIGKILL to this process when its parent ends."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, int(signal.SIGKILL), 0, 0, 0)


def _set_name(name: str) -> None:
    """Set the name that ps and top show."""
    ctypes.CDLL(None).prctl(_PR_SET_NAME, name.encode(), 0, 0, 0)


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
