"""Trust of a client in sockets: only those of its user, of root, or of the service."""

import os
import shutil
import socket
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path

import pytest
from rigs.processes import PATIENCE, running, wait_until

from fishd.client import Fish, NoDaemon
from fishd.core import addresses
from fishd.core.errors import Untrusted
from fishd.core.process.unix_sockets import find_trust_problem

USER, OTHER_USER = 60101, 60102
as_root = pytest.mark.skipif(os.geteuid() != 0, reason="needs root, to be two other users")


@contextmanager
def user(number: int) -> Iterator[None]:
    """Let this process belong to another user."""
    os.setresuid(number, number, 0)
    try:
        yield
    finally:
        os.setresuid(0, 0, 0)


@pytest.fixture
def shared() -> Iterator[Path]:
    """A folder like /tmp."""
    folder = Path(tempfile.mkdtemp())
    folder.chmod(0o1777)
    yield folder
    shutil.rmtree(folder)


@pytest.fixture(autouse=True)
def no_endpoint(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("RUNTIME_DIRECTORY", "XDG_RUNTIME_DIR", addresses.ENDPOINT_VARIABLE):
        monkeypatch.delenv(name, raising=False)


class Listener:
    """Process of another user that listens at a socket and keeps what it receives."""

    def __init__(self, path: Path, number: int) -> None:
        with user(number):
            path.parent.mkdir(exist_ok=True)
            self.socket = socket.socket(socket.AF_UNIX)
            self.socket.bind(str(path))
            self.socket.listen()
        path.chmod(0o777)
        self.received: list[bytes] = []
        threading.Thread(target=self._serve, daemon=True).start()

    def _serve(self) -> None:
        while True:
            try:
                connection, _ = self.socket.accept()
            except OSError:  # closed
                return
            with connection:
                self.received.append(connection.recv(64))

    def __enter__(self) -> "Listener":
        return self

    def __exit__(self, *_: object) -> None:
        self.socket.shutdown(socket.SHUT_RDWR)
        self.socket.close()


@as_root
@pytest.mark.parametrize("victim", [USER, 0])
def test_an_estop_is_not_sent_to_a_folder_that_another_user_planted(
    shared: Path, monkeypatch: pytest.MonkeyPatch, victim: int
) -> None:
    with user(OTHER_USER):
        (shared / "session").mkdir()
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(shared / "session"))
    path = shared / "session" / "fishd" / "control"
    with Listener(path, OTHER_USER) as planted, user(victim):
        with Fish(timeout=0.5) as fish, pytest.raises(Untrusted) as caught:
            fish.estop()
        assert not any(planted.received)  # at most a connection without data
        with Fish(f"ipc://{path}", timeout=0.5) as fish, pytest.raises(NoDaemon, match="no answer"):
            fish.estop()  # the user has named this address
        wait_until(lambda: any(planted.received))
    assert str(caught.value) == (
        f"the process that listens at ipc://{path} is not trusted: {path.parent} belongs to "
        f"user {OTHER_USER}; if you trust it, name it with --endpoint or $FISHD_ENDPOINT"
    )


@as_root
def test_a_planted_folder_hides_no_service(shared: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run, session = shared / "run", shared / "session"
    (run / "fishd").mkdir(parents=True)
    run.chmod(0o755)
    os.chown(run / "fishd", USER, USER)
    monkeypatch.setattr(addresses, "SERVICE_SOCKET", run / "fishd" / "control")
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(session))
    with user(OTHER_USER):
        session.mkdir()
    sockets = [folder / "fishd" / "control" for folder in (run, session)]
    with Listener(sockets[0], USER), Listener(sockets[1], OTHER_USER):
        assert addresses.find_control_address() == f"ipc://{run}/fishd/control"
        with Fish(timeout=0.2) as fish, pytest.raises(NoDaemon, match="no answer within"):
            fish.status()  # the service was asked


@as_root
def test_a_stranger_is_told_by_folder_rights_and_by_who_listens(shared: Path) -> None:
    def find_problem(name: str, owner: int, listener: int, mode: int = 0o755) -> str | None:
        folder = shared / name
        folder.mkdir()
        os.chown(folder, owner, owner)
        folder.chmod(0o777)
        with Listener(folder / "control", listener) if listener else nullcontext():
            folder.chmod(mode)
            with user(USER):
                problem = find_trust_problem(folder / "control")
                return problem and problem.replace(str(folder), "FOLDER")

    assert find_problem("mine", USER, USER) is None
    assert find_problem("deserted", USER, 0) is None
    assert find_problem("roots", 0, USER) is None
    assert find_problem("his", OTHER_USER, OTHER_USER) == f"FOLDER belongs to user {OTHER_USER}"
    assert find_problem("his-with-me", OTHER_USER, USER) == f"FOLDER belongs to user {OTHER_USER}"
    assert find_problem("open", USER, USER, 0o777) == "other users may write to FOLDER"
    assert find_problem("group", USER, USER, 0o770) == "other users may write to FOLDER"
    problem = find_problem("slipped-in", USER, OTHER_USER)
    assert problem == f"a process of user {OTHER_USER} listens there"
    (shared / "link").symlink_to(shared / "mine")
    with user(USER):
        link = shared / "link"
        assert find_trust_problem(link / "control") == f"{link} is a symbolic link"
        assert find_trust_problem(shared / "nowhere" / "control") is None


def test_a_fishd_of_the_same_user_is_asked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "fishd").mkdir(mode=0o700)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    with running(tmp_path / "fishd"), Fish(timeout=PATIENCE) as fish:
        assert fish.status().mode == "idle"
