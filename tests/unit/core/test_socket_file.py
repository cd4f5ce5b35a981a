"""File of a Unix socket, which is created again when it is gone or has another mode."""

import socket
from pathlib import Path

from fishd.core import addresses
from fishd.core.socket_file import SocketFile


class _Server:
    """Server whose socket's file loses its mode as soon as it is created again."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.address = f"ipc://{path}"
        self.listener = addresses.listen(self.address, "control.address", group=True)

    def listen_at(self, address: str, listener: socket.socket) -> None:
        self.listener.close()
        self.listener = listener.dup()
        self._path.chmod(0)


def test_a_mode_that_changes_while_the_file_is_created_again_is_restored(tmp_path: Path) -> None:
    path = tmp_path / "control"
    server = _Server(path)
    mode = path.stat().st_mode
    file = SocketFile(server, server.address, "control.address", group=True)
    path.unlink()
    assert "created again" in file.restore()
    assert "modes" in file.restore()
    assert path.stat().st_mode == mode
    server.listener.close()
