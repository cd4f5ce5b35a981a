"""Process of a gateway: `python -m fishd.daemon.gateway LINK`, which only fishd starts.

It ends with fishd, even if it is stopped: the kernel sends it SIGKILL. A gateway that exceeds a
limit starts again in the same process, so that fishd, whose threads stand still while it starts a
process, is not disturbed.

LINK: file descriptor of the link to fishd.
"""

import ctypes
import gc
import os
import signal
import socket
import sys

_PR_SET_PDEATHSIG, _PR_SET_NAME = 1, 15


def main(number: str) -> None:
    """Serve until fishd ends; never return."""
    prctl = ctypes.CDLL(None).prctl
    prctl(_PR_SET_PDEATHSIG, int(signal.SIGKILL), 0, 0, 0)
    prctl(_PR_SET_NAME, b"fishd-gateway", 0, 0, 0)
    for ignored in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(ignored, signal.SIG_IGN)  # fishd ends this process
    status = 1
    try:
        gc.disable()  # imports leave no garbage, and searching for it takes a tenth of the time
        from fishd.core.process.safe_path import python_command
        from fishd.daemon.gateway.link import EXCEEDED
        from fishd.daemon.gateway.server import GatewayServer

        gc.freeze()
        gc.enable()
        link = socket.socket(fileno=int(number))
        link.setblocking(False)
        if why := GatewayServer(link).run():
            link.setblocking(True)
            link.send(EXCEEDED + why.encode())
            link.set_inheritable(True)
            command = python_command("-m", "fishd.daemon.gateway", number)
            os.execv(command[0], command)
        status = 0
    except ConnectionError:  # fishd was killed
        pass
    except BaseException:
        sys.excepthook(*sys.exc_info())
    finally:
        sys.stderr.flush()
        os._exit(status)  # without closing ZeroMQ, which would take long to free its memory


if __name__ == "__main__":
    main(*sys.argv[1:])
