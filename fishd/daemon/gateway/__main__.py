"""A gateway's process: `python -m fishd.daemon.gateway KIND LINK LISTENER ADDRESS`.

KIND: telemetry or control. LINK and LISTENER: file descriptors that fishd has opened, the link to
it and the socket that clients connect to, which outlives this process. Only fishd starts it.
"""

import gc
import importlib
import os
import socket
import sys
import time
from contextlib import suppress

from fishd.daemon.gateway import link

_PAUSE = 0.3
"""Time until connections are accepted again [s]."""
_FAREWELL = 100
"""How long the last messages may take to leave [ms]."""


def main(kind: str, link_number: str, listener_number: str, address: str) -> int:
    """Serve until fishd ends; begin anew, with nothing, when a limit is exceeded."""
    gc.disable()  # nothing that is loaded is garbage: to look for it takes a tenth of the time
    import zmq

    from fishd.daemon.gateway.limits import ResourceLimits

    connection = socket.socket(fileno=int(link_number))
    name = {link.TELEMETRY: "publisher", link.CONTROL: "router"}[kind]
    gateway = importlib.import_module(f"fishd.daemon.gateway.{name}")  # and not the other one
    gc.freeze()
    gc.enable()
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    server = context.socket(gateway.SOCKET)
    gateway.configure(server)
    server.set(zmq.USE_FD, os.dup(int(listener_number)))  # which is closed when this begins anew
    server.bind(address)
    limits = ResourceLimits(gateway.MEMORY, gateway.CONNECTIONS)
    with suppress(OSError):  # as below
        connection.send(link.READY)
    why = gateway.run(connection, server, limits)
    if why:
        with suppress(OSError):  # fishd has ended, or takes nothing just now
            connection.send(link.NOTICE + why.encode())
        time.sleep(_PAUSE)
        # Not by fishd, which must not wait for a process to start; and without closing ZeroMQ,
        # which would take long to free what it holds.
        again = [sys.executable, "-P", "-m", "fishd.daemon.gateway", *sys.argv[1:]]
        os.execv(sys.executable, again)
    server.close(linger=_FAREWELL)
    context.term()
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
