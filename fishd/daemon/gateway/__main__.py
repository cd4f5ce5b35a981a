"""A gateway's process: `python -m fishd.gateway KIND LINK LISTENER ADDRESS`.

KIND: telemetry or control. LINK and LISTENER: file descriptors that fishd has opened, the link to
it and the socket that clients connect to, which outlives this process. Only fishd starts it.
"""

import os
import socket
import sys
import time
from contextlib import suppress

import zmq

from fishd.gateway import link
from fishd.gateway.limits import ResourceLimits

_PAUSE = 0.3
"""How long a crowd at the door waits before it is let in again [s]."""
_FAREWELL = 100
"""How long the last messages may take to leave [ms]."""


def main(kind: str, link_number: str, listener_number: str, address: str) -> int:
    """Serve until fishd ends; begin anew, with nothing, when a limit is exceeded."""
    connection = socket.socket(fileno=int(link_number))
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    if kind == link.TELEMETRY:
        from fishd.gateway import publisher

        server = context.socket(zmq.PUB)
        publisher.configure(server)
        _serve(server, int(listener_number), address)
        why = publisher.run(
            connection, server, ResourceLimits(publisher.MEMORY, publisher.CONNECTIONS)
        )
    else:
        from fishd.gateway import requests

        server = context.socket(zmq.ROUTER)
        requests.configure(server)
        _serve(server, int(listener_number), address)
        limits = ResourceLimits(requests.MEMORY, requests.CONNECTIONS)
        why = requests.Requests(connection, server, limits).run()
    if why:
        with suppress(OSError):  # fishd has ended, or takes nothing just now
            connection.send(link.NOTICE + why.encode())
        time.sleep(_PAUSE)
        # From here, as fishd must not wait for a process to be made; and at once, as ZeroMQ's own
        # end would take as long as there is to free.
        os.execv(sys.executable, [sys.executable, "-P", "-m", "fishd.gateway", *sys.argv[1:]])
    server.close(linger=_FAREWELL)
    context.term()
    return 0


def _serve(server: "zmq.Socket[bytes]", listener: int, address: str) -> None:
    server.set(zmq.USE_FD, os.dup(listener))  # which is closed when this begins anew
    server.bind(address)


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
