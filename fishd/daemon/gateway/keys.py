"""Keys of a gateway: only clients with a known key connect, and each does what its role permits."""

import threading
import time
from contextlib import suppress
from pathlib import Path

import zmq
from zmq.utils import z85

from fishd.core import keys
from fishd.core.errors import ConfigError, Refused
from fishd.core.protocol import READ_OPERATIONS
from fishd.core.trusted_folder import find_folder_problem

WATCH_OPERATIONS = READ_OPERATIONS | {"estop"}
"""Operations for which the role `watch` is enough."""
SETTLE_TIME_S, EMPTY_SETTLE_TIME_S = 0.1, 1.0
"""Age of a change of the file from which on it is read, and of an empty file, which an editor may
still write [s]."""


class KnownKeys:
    """The keys in the file `known`, which is read again whenever it has changed.

    A line that is malformed lets no client in; nor does a file that cannot be read. May be used
    from several threads.
    """

    def __init__(self, folder: Path) -> None:
        self.path = folder / keys.KNOWN_FILE
        self._clients: dict[str, keys.KnownKey] = {}
        self._change = ""
        self._stamp: tuple[int, int, int, str | None] | None = None
        while self._stamp is None:
            self._update()
            time.sleep(SETTLE_TIME_S / 10)

    def find(self, key: str) -> keys.KnownKey | None:
        """Return the client of a public key; None if the key is not known."""
        self._update()
        return self._clients.get(key)

    def _update(self) -> None:
        """Read the file if it has changed; note what is wrong with it, or which key was removed."""
        now, stamp = time.time(), self._read_stamp()
        changed, size, *_ = stamp
        settle_time = SETTLE_TIME_S if size else EMPTY_SETTLE_TIME_S
        if stamp == self._stamp or abs(now - changed * 1e-9) < settle_time:
            return
        try:
            lines, mistakes = keys.read_known(self.path.parent)
        except ConfigError as error:
            lines, mistakes = [], [str(error)]
        if self._read_stamp() != stamp:  # changed since
            return
        clients = {line.key: line for line in lines if line.what in keys.ROLES}
        before = self._clients.items()
        if removed := [line.name or key for key, line in before if key not in clients]:
            mistakes.append(f"{self.path}: removed: {', '.join(removed)}")
        self._change = mistakes[0] if mistakes else self._change
        self._clients, self._stamp = clients, stamp

    def find_change(self) -> str:
        """Return why connections must end, once: a key was removed, or the file is wrong; or ""."""
        self._update()
        change, self._change = self._change, ""
        return change

    def check(self, key: str, operation: str) -> None:
        """Raise `Refused` if the client may not carry out an operation, or is no longer known."""
        client = self.find(key)
        if client is None:
            raise Refused("no-key", f"the key {key} is no longer known to fishd: see {self.path}")
        if client.what != "drive" and operation not in WATCH_OPERATIONS:
            raise Refused(
                "no-key",
                f"'{operation}' needs the role drive; the key of this client, {client.name or key},"
                f" has the role {client.what} in {self.path}",
            )

    def _read_stamp(self) -> tuple[int, int, int, str | None]:
        """Return time of the last change and size of the file, and what else shows another one."""
        problem = find_folder_problem(self.path.parent)
        try:
            status = self.path.stat()
        except OSError:
            return 0, 0, 0, problem
        return status.st_ctime_ns, status.st_size, status.st_ino, problem


def require_keys(server: "zmq.Socket[bytes]", secret: str) -> None:
    """Let only clients with a known key connect to a socket; call it before `bind`."""
    server.set(zmq.CURVE_SERVER, 1)
    server.set(zmq.CURVE_SECRETKEY, secret.encode())
    server.set(zmq.ZAP_DOMAIN, b"%d" % server.socket_type)


def judge_handshakes(context: "zmq.Context[zmq.Socket[bytes]]", known: KnownKeys) -> None:
    """Let a thread decide which clients may connect to the sockets of a context.

    A client that sends requests hears that its key is not known. A subscriber hears nothing, and
    its ZeroMQ tries again; after a refusal that it hears, it would not.
    """
    handshakes = context.socket(zmq.REP)
    handshakes.bind("inproc://zeromq.zap.01")
    arguments = handshakes, known
    threading.Thread(target=_judge_handshakes, args=arguments, name="keys", daemon=True).start()


def _judge_handshakes(handshakes: "zmq.Socket[bytes]", known: KnownKeys) -> None:
    """Answer requests of ZeroMQ's authentication protocol (ZAP) until the context ends."""
    with suppress(zmq.ContextTerminated):
        while True:
            version, number, domain, *_, raw_key = handshakes.recv_multipart()
            key = z85.encode(raw_key)
            refusal = b"400" if domain == b"%d" % zmq.ROUTER else b"300"
            status = b"200" if known.find(key.decode()) else refusal
            # A message of this client has its key as its User-Id.
            handshakes.send_multipart([version, number, status, b"", key, b""])
    handshakes.close()
