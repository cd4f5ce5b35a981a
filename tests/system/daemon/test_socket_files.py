"""A fishd whose sockets, or their folder, are gone can be found, seen and stopped."""

import asyncio
import contextlib
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest
from rigs.doctor_process import Findings, doctor, free_telemetry, read_findings
from rigs.other_user import command_as_user, spare_user
from rigs.processes import (
    FISHCTL,
    FISHD,
    PATIENCE,
    Daemon,
    Process,
    Subscriber,
    call,
    fishctl,
    one_line,
    running,
    sets,
    wait_until,
)

from fishd.client import Fish, NoDaemon
from fishd.core import local_daemons
from fishd.core.process import kernel_names
from fishd.daemon import direct_sockets

SWIM = ("set-controller", "hold", "--angle", "0.2")


def break_folder(folder: Path) -> Path:
    """Put a file in the place of a folder, which then cannot be created; return the folder."""
    kept = folder.with_name("kept")
    folder.rename(kept)
    folder.touch()
    return kept


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Folder of the sockets of a fishd."""
    made = tmp_path / "sockets"
    made.mkdir()
    return made


def test_sockets_are_created_again_when_their_folder_was_removed(folder: Path) -> None:
    with running(folder, *sets(f"telemetry.address=ipc://{folder}/telemetry")) as daemon:
        with Fish(daemon.endpoint) as earlier, earlier.lease("experiment"):
            earlier.set_controller("hold", angle=0.2)
            shutil.rmtree(folder)
            wait_until((folder / "control.estop").exists)
            assert folder.stat().st_mode & 0o777 == 0o755  # as it was
            with Fish(daemon.endpoint) as fish:
                ticks = fish.ticks()
                assert next(ticks).mode == "running"
                status = fish.status()
            assert earlier.status().lease  # its connection has survived, and so has its lease
        assert status.recovered_errors["sockets_restored"] == 1
        assert status.limitations == ()
        assert status.control == daemon.endpoint
        (folder / "control.estop").unlink()  # one file alone
        wait_until((folder / "control.estop").exists)
        assert daemon.fishctl("status").returncode == 0
    assert list(folder.iterdir()) == []


def mode(path: Path) -> int:
    return path.stat().st_mode & 0o7777


def test_modes_of_sockets_and_of_their_folder_are_restored(folder: Path) -> None:
    with Daemon(folder) as daemon:
        events = Subscriber(daemon.wait_until_up().telemetry, b"event").connected()
        files = folder, folder / "control", folder / "control.estop"
        before = [mode(file) for file in files]
        assert before == [0o755, 0o660, 0o660]
        assert daemon.fishctl(*SWIM).returncode == 0
        for count, (file, other) in enumerate(((files[0], 0), (files[0], 0o777), (files[1], 0)), 1):
            file.chmod(other)
            event = events.until(kind="sockets")
            assert (
                "or their folder had other modes, and have those of the start" in event["message"]
            )
            assert [mode(file) for file in files] == before
            assert daemon.status().recovered_errors["sockets_restored"] == count
        files[2].chmod(0)
        wait_until(lambda: mode(files[2]) == 0o660)
        assert daemon.status().mode == "running"
        events.close()


def test_telemetry_in_a_folder_is_restored_or_reported(folder: Path) -> None:
    apart = folder.with_name("telemetry")
    apart.mkdir()
    with running(folder, *sets(f"telemetry.address=ipc://{apart}/telemetry")) as daemon:
        shutil.rmtree(apart)
        wait_until((apart / "telemetry").exists)
        wait_until(lambda: daemon.status().recovered_errors["sockets_restored"] == 1)
        with Fish(daemon.endpoint) as fish:
            next(fish.ticks())
        kept = break_folder(apart)
        why = "clients cannot reach telemetry, whose socket cannot be created again: "
        wait_until(lambda: why in str(daemon.status().limitations))
        assert daemon.status().control == daemon.endpoint
        apart.unlink()
        kept.rename(apart)
        wait_until(lambda: daemon.status().limitations == ())
        assert why in daemon.end()[2]


def test_the_loss_of_sockets_is_an_event_and_a_line_in_the_log(folder: Path) -> None:
    with Daemon(folder) as daemon:
        events = Subscriber(daemon.wait_until_up().telemetry, b"event").connected()
        (folder / "control").unlink()
        _, event = events.socket.recv_multipart()
        message = "the files of fishd's sockets were gone and have been created again; control "
        assert json.loads(event)["kind"] == "sockets"
        assert json.loads(event)["message"] == f"{message}{daemon.endpoint}"
        events.close()
        assert message in daemon.end()[2]


@pytest.mark.realtime
def test_a_gone_folder_is_noticed_within_a_second(folder: Path) -> None:
    with running(folder) as daemon, Fish(daemon.endpoint) as fish:
        missed = fish.status().missed_slots
        for number in range(5):
            folder.rename(folder.with_name(f"gone-{number}"))
            gone = time.monotonic()
            while not (folder / "control.estop").exists():
                time.sleep(0.01)
            assert time.monotonic() - gone < 1.0
        assert fish.status().missed_slots == missed


def test_a_fish_that_no_client_can_reach_rests_and_can_still_be_stopped(folder: Path) -> None:
    with running(folder) as daemon:
        assert daemon.fishctl(*SWIM).returncode == 0
        kept = break_folder(folder)
        wait_until(lambda: daemon.status().mode == "idle")  # by its name in the kernel
        status = daemon.fishctl("status")
        assert status.returncode == 0
        assert f"(process {daemon.pid}) answered at its name in the kernel" in status.stderr
        assert "rests, as   no client can connect to this fishd" in status.stdout
        assert "the control socket, which cannot be created again: " in status.stdout
        assert daemon.fishctl("stop").stdout.startswith("idle")
        refused = one_line(daemon.fishctl("set-controller", "swing"))
        assert f"no fishd at {daemon.endpoint}" in refused
        assert f"process {daemon.pid}" in refused
        _, findings = doctor(folder.parent, "--endpoint", daemon.endpoint, *free_telemetry())
        assert findings["daemon"][0] == "warning"
        assert f"(pid {daemon.pid})" in findings["daemon"][1]
        assert findings["control"][0] == "FAIL"
        ended = daemon.fishctl("estop")
        assert ended.stdout.startswith("estop")
        assert "stopped through: fishd's name in the kernel: " in ended.stdout
        folder.unlink()
        kept.rename(folder)
        wait_until((folder / "control").exists)
        wait_until(lambda: daemon.status().control == daemon.endpoint)
        assert daemon.status().mode == "estop"


def test_an_experiment_goes_on_while_no_other_client_can_connect(folder: Path) -> None:
    with running(folder) as daemon, Fish(daemon.endpoint) as fish:
        with fish.lease("experiment"):
            fish.set_controller("hold", angle=0.2)
            kept = break_folder(folder)
            wait_until(
                lambda: any("cannot be created" in line for line in fish.status().limitations)
            )
            assert fish.status().mode == "running"
        folder.unlink()
        kept.rename(folder)


def test_a_controller_that_is_to_start_later_does_not_start_unreachable(folder: Path) -> None:
    with running(folder, *sets("start.controller=swing", "start.rest=3600")) as daemon:
        kept = break_folder(folder)
        wait_until(lambda: daemon.status().lease_expiry is not None)
        folder.unlink()
        kept.rename(folder)


def test_stop_says_that_it_has_cancelled_the_controller_of_start(folder: Path) -> None:
    with running(folder, *sets("start.controller=swing", "start.rest=3600")) as daemon:
        stopped = daemon.fishctl("stop")
        assert stopped.stdout.startswith("idle")
        assert stopped.stderr == (
            "fishctl: swing, the controller of 'start', does not start any more\n"
        )
        assert daemon.fishctl("stop").stderr == ""


def test_a_file_of_another_program_is_not_replaced(folder: Path) -> None:
    with running(folder) as daemon:
        with socket.socket(socket.AF_UNIX) as other:
            (folder / "control").unlink()
            other.bind(f"{folder}/control")
            other.listen()
            (folder / "control.estop").unlink()
            found = (folder / "control").stat().st_ino
            complaint = "another program has put something else at "

            def is_reported() -> bool:
                own = local_daemons.find_own(daemon.endpoint)
                return complaint in str(local_daemons.ask(own, b'{"v": 2, "op": "status"}'))

            if (folder / "control").stat().st_ino == found:  # bound before fishd looked
                wait_until(is_reported)
                assert (folder / "control").stat().st_ino == found
                with Fish(daemon.endpoint, timeout=0.1) as fish:  # which the other does not answer
                    assert fish.stop().mode == "idle"
        (folder / "control").unlink()
        wait_until((folder / "control").exists)


class User(NamedTuple):
    """Another user with folders of its own, whose fishds only its programs meet."""

    number: int
    command: tuple[str, ...]
    home: Path

    def in_session(self, session: Path | None) -> list[str]:
        """Return the beginning of a command in a login session, or without one, as in cron."""
        login = f"XDG_RUNTIME_DIR={session}" if session else "--unset=XDG_RUNTIME_DIR"
        *become, env, path, python = self.command
        return [*become, env, login, f"HOME={self.home}", path, python]

    def fishd(self, session: Path | None, *settings: str) -> Process:
        """Start a fishd with its default control address."""
        where = sets("telemetry.address=tcp://127.0.0.1:0", *settings)
        return Process(*self.in_session(session), FISHD, *where)

    def fishctl(self, session: Path | None, *arguments: str) -> "subprocess.CompletedProcess[str]":
        return call(*self.in_session(session), FISHCTL, *arguments)

    def doctor(self, session: Path | None) -> tuple[int, Findings]:
        return read_findings(self.fishctl(session, "doctor", "--json", *free_telemetry()))

    def daemons(self) -> list[local_daemons.LocalDaemon]:
        return [daemon for daemon in local_daemons.find_all() if daemon.user == self.number]


@pytest.fixture
def user() -> Iterator[User]:
    number = spare_user()
    command = command_as_user(number)
    home = Path(tempfile.mkdtemp())
    home.chmod(0o755)
    os.chown(home, number, number)
    yield User(number, command, home)
    shutil.rmtree(home)
    shutil.rmtree(f"/tmp/fishd-{number}", ignore_errors=True)


def open_session(user: User, name: str = "session") -> Path:
    """Create the folder of a login session."""
    session = user.home / name
    session.mkdir()
    os.chown(session, user.number, user.number)
    return session


def test_after_a_logout_the_socket_is_elsewhere_until_the_next_login(user: User) -> None:
    session = open_session(user)
    os.chown(user.home, 0, 0)  # like /run/user, where only root makes folders
    with user.fishd(session) as process:
        wait_until((session / "fishd" / "control.estop").exists)
        shutil.rmtree(session)
        elsewhere = Path(f"/tmp/fishd-{user.number}/control")
        wait_until((elsewhere.parent / "control.estop").exists)
        for place in (session, None):
            status = user.fishctl(place, "status")
            assert "limitation  the folder of ipc://" not in status.stderr
            assert f"control     ipc://{elsewhere}" in status.stdout
        open_session(user)
        wait_until((session / "fishd" / "control.estop").exists)
        assert (
            f"control     ipc://{session}/fishd/control" in user.fishctl(session, "status").stdout
        )
        assert not elsewhere.exists()
        with user.fishd(None) as second:  # the address there is free again
            wait_until((elsewhere.parent / "control.estop").exists)
            assert second.end()[0] == 0
        shutil.rmtree(session)
        wait_until((elsewhere.parent / "control.estop").exists)
        assert process.end()[0] == 0
    assert not [path for path in elsewhere.parent.iterdir() if path.is_socket()]


def test_from_cron_a_fishd_is_stopped_and_other_verbs_say_where_it_is(user: User) -> None:
    session = open_session(user)
    with user.fishd(session) as fishd:
        wait_until((session / "fishd" / "control.estop").exists)
        for verb in ("status", "stop", "estop"):
            done = user.fishctl(None, verb)
            assert done.returncode == 0, done.stderr
            said = done.stderr + done.stdout
            assert f"nothing listens at ipc:///tmp/fishd-{user.number}/control; fish " in said
            assert f" at ipc://{session}/fishd/control answered at its name in the kern" in said
        refused = one_line(user.fishctl(None, *SWIM))
        assert f"runs: name it with --endpoint ipc://{session}/fishd/control" in refused
        (todo,) = (
            line for line in user.fishctl(None, "status").stdout.splitlines() if "to do" in line
        )
        remedy = todo.partition("then: fishctl ")[2].split()
        assert user.fishctl(None, *remedy).stdout.startswith("idle")
        assert user.fishctl(session, "status").stderr == ""
        _, findings = user.doctor(None)
        assert findings["daemon"][0] == "warning"
        assert "answered at its name in the kernel" in findings["daemon"][1]
        fishd.stop()
        status, findings = user.doctor(None)
        assert status == 1
        assert findings["daemon"][0] == "FAIL"
        assert f"process {fishd.pid}, a fishd, does not answer" in findings["daemon"][1]
        hung = one_line(fishctl("--endpoint", f"ipc://{session}/fishd/control", "status"))
        assert f"process {fishd.pid} of user {user.number}, which serves" in hung
        assert f"'sudo -u \\#{user.number} fishctl estop --endpoint ipc://" in hung  # here: root
        hung = one_line(user.fishctl(None, "status"))
        assert "hangs or is stopped: 'fishctl estop' ends its pulses" in hung
        ended = user.fishctl(None, "estop")
        assert ended.stderr == ""
        assert ended.stdout.startswith("no pulses: the fish is simulated")
        assert "start one" not in ended.stdout
        fishd.process.send_signal(signal.SIGCONT)


def test_a_mode_that_fishd_may_not_restore_is_a_limitation_with_its_remedy(user: User) -> None:
    shared = user.home / "shared"
    shared.mkdir()
    shared.chmod(0o777)  # root's
    with user.fishd(None, f"control.address=ipc://{shared}/control"):
        wait_until((shared / "control.estop").exists)

        def limitation() -> str:
            return user.fishctl(None, "status").stdout.partition("limitation")[2]

        for other in (0o755, 0o700):  # only the latter keeps clients out
            shared.chmod(other)
            wait_until(
                lambda other=other: (
                    f"from 777 to {other:o}: sudo chmod 777 {shared}" in limitation()
                )
            )
            assert ("cannot be created again" in limitation()) == (other == 0o700)
        refused = one_line(user.fishctl(None, "--endpoint", f"ipc://{shared}/control", *SWIM))
        assert "this user may not connect; fish " in refused
        assert f"sudo chmod 777 {shared}" in refused
        shared.chmod(0o777)
        wait_until(lambda: not limitation())
        for verb in ("stop", "estop"):
            assert user.fishctl(None, verb).returncode == 0


def test_estop_stops_every_fishd_that_may_be_meant_and_stop_asks_which(user: User) -> None:
    one, other = open_session(user, "one"), open_session(user, "other")
    with user.fishd(one) as first, user.fishd(other):
        for session in (one, other):
            wait_until((session / "fishd" / "control.estop").exists)
        refused = user.fishctl(None, "stop")
        assert refused.returncode == 1
        for session in (one, other):
            assert f"--endpoint ipc://{session}/fishd/control" in refused.stderr
        stopped = user.fishctl(None, "estop")
        assert stopped.returncode == 0
        for session in (one, other):
            assert f" at ipc://{session}/fishd/control" in stopped.stdout
        assert stopped.stdout.endswith(" answered at their names in the kernel\n")
        first.stop()
        for session in (one, None):  # a stop that reached only the other fish would deceive
            refused = user.fishctl(session, "stop")
            assert refused.returncode == 1
            assert f"process {first.pid}" in refused.stderr
            assert "'fishctl estop' ends " in refused.stderr
        stopped = user.fishctl(None, "estop")
        assert f"; of process {first.pid}, which does not answer: no pulses" in stopped.stdout
        first.process.send_signal(signal.SIGCONT)
        for session in (one, other):
            assert "mode        estop" in user.fishctl(session, "status").stdout


def test_a_fishd_answers_no_other_user_at_its_name_and_none_can_pretend_to_be_it(
    user: User,
) -> None:
    session = open_session(user)
    stranger = user.number + 10_000_000
    with user.fishd(session) as process:
        wait_until((session / "fishd" / "control.estop").exists)
        (own,) = user.daemons()
        request = b'{"v": 2, "op": "estop"}'
        ask = (
            "import os, sys\n"
            "from fishd.core.process.kernel_names import exchange_datagrams as ask\n"
            "os.setgid(int(sys.argv[1])); os.setuid(int(sys.argv[1]))\n"
            "print(ask([sys.argv[2]], sys.argv[3].encode(), 1.0))"
        )
        arguments = [sys.executable, "-c", ask, str(stranger), own.name, request.decode()]
        refused = subprocess.run(arguments, capture_output=True, text=True, check=True)
        assert refused.stdout == "{}\n"
        assert "mode        idle" in user.fishctl(session, "status").stdout
        assert local_daemons.ask([own], request)  # root may
        assert process.pid == own.pid
    forged = f"daemon/{user.number}/{os.getpid()}/00000000/forged"
    with kernel_names.bind_datagrams(forged):
        assert not [daemon for daemon in local_daemons.find_all() if daemon.name == forged]


def test_an_answer_of_another_process_is_not_believed(tmp_path: Path) -> None:
    endpoint = f"ipc://{tmp_path}/control"
    name = local_daemons.name_of_this(endpoint)
    answer = (
        "import sys\nfrom fishd.core.process.kernel_names import bind_datagrams\n"
        "server = bind_datagrams(sys.argv[1]); server.setblocking(True); print(flush=True)\n"
        'while True: server.sendto(b\'{"v":2,"id":1,"ok":true}\', server.recvfrom(9999)[1])'
    )
    with subprocess.Popen([sys.executable, "-c", answer, name], stdout=subprocess.PIPE) as process:
        assert process.stdout
        process.stdout.readline()
        with Fish(endpoint) as fish, pytest.raises(NoDaemon):
            fish.estop()
        process.kill()


def test_a_socket_whose_times_were_changed_is_still_there(folder: Path) -> None:
    with running(folder) as daemon:
        assert daemon.fishctl(*SWIM).returncode == 0
        os.utime(folder / "control")
        seq = daemon.status().seq + 40  # four checks
        wait_until(lambda: daemon.status().seq > seq)
        status = daemon.status()
        assert (status.mode, status.control) == ("running", daemon.endpoint)
        assert status.recovered_errors["sockets_restored"] == 0


def test_names_that_another_user_holds_neither_hide_a_fishd_nor_delay_its_stop(
    user: User,
) -> None:
    session = open_session(user)
    with user.fishd(session) as process, contextlib.ExitStack() as stack:
        wait_until((session / "fishd" / "control.estop").exists)
        for number in range(30):  # processes of this user, which is root
            name = f"daemon/{user.number}/{1_000_000_000 + number}/00000000/fake"
            stack.enter_context(kernel_names.bind_datagrams(name))
        for verb in ("status", "stop", "estop"):
            done = user.fishctl(None, verb)
            assert done.returncode == 0, done.stderr
            assert f"(process {process.pid}) at ipc://" in done.stderr + done.stdout


def test_a_stop_waits_once_for_all_names_that_do_not_answer() -> None:
    names = [f"daemon/0/1/00000000/{number}" for number in range(20)]
    with contextlib.ExitStack() as stack:
        for name in names:
            stack.enter_context(kernel_names.bind_datagrams(name))
        waits: list[float] = []
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("select.select", lambda *args: waits.append(args[3]) or ([], [], []))
            assert kernel_names.exchange_datagrams(names, b"", 0.4) == {}
    assert len(waits) == 1


def test_a_user_in_the_place_of_the_folder_takes_no_stop_away(user: User) -> None:
    session = open_session(user)
    os.chown(user.home, 0, 0)
    stranger = user.number + 10_000_000
    with user.fishd(session):
        wait_until((session / "fishd" / "control.estop").exists)
        shutil.rmtree(session)
        session.mkdir()
        (session / "fishd").mkdir()
        os.chown(session / "fishd", stranger, stranger)
        with socket.socket(socket.AF_UNIX) as planted:
            planted.bind(f"{session}/fishd/control")
            planted.listen()
            (session / "fishd" / "control").chmod(0o777)
            done = user.fishctl(session, "estop")
            assert done.returncode == 0, done.stderr
            assert done.stdout.startswith("estop")
            assert "answered at its name in the kernel" in done.stdout


def test_where_the_kernel_lists_no_names_there_are_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(kernel_names, "_TABLE", tmp_path / "net" / "unix")
    with Fish(f"ipc://{tmp_path}/control") as fish, pytest.raises(NoDaemon, match="start one"):
        fish.estop()


def test_a_user_who_joins_the_group_is_answered_without_a_restart(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(direct_sockets, "MEMBERS_PERIOD_S", 0.0)
    stranger = command_as_user(spare_user())
    name = f"daemon/0/{os.getpid()}/00000000/group"
    code = (
        "import sys\nfrom fishd.core.process.kernel_names import exchange_datagrams as ask\n"
        "print(len(ask([sys.argv[1]], b'', float(sys.argv[2]))))"
    )

    async def ask(seconds: float) -> str:
        child = await asyncio.create_subprocess_exec(
            *stranger, "-c", code, name, str(seconds), stdout=subprocess.PIPE
        )
        return (await child.communicate())[0].decode()

    async def perform(_: bytes) -> bytes:
        return b"answer"

    async def try_both() -> None:
        kernel = direct_sockets.KernelSocket(name, perform, 0.01)
        assert await ask(0.1) == "0\n"
        monkeypatch.setattr(direct_sockets, "_permitted_users", lambda: {spare_user()})
        assert await ask(PATIENCE) == "1\n"
        kernel.close()

    asyncio.run(try_both())
