"""Debian's `pigs`, a client in C, drives the emulated pigpiod in real time."""

import contextlib
import os
import shutil
import subprocess
import time
from collections.abc import Iterator

import pytest
from rigs.pigpiod_client import GPIO, PATIENCE, Bench, eventually, pigpiod_bench

from fishd.core.clock import SystemClock

PIGS = shutil.which("pigs")
pytestmark = pytest.mark.skipif(PIGS is None, reason="needs `pigs` of Debian's pigpio-tools")


@pytest.fixture
def bench() -> Iterator[Bench]:
    with pigpiod_bench(SystemClock()) as bench:
        yield bench


def pigs(bench: Bench, *arguments: str) -> subprocess.CompletedProcess[str]:
    assert PIGS is not None
    options = {"capture_output": True, "text": True, "timeout": PATIENCE}
    return subprocess.run([PIGS, *arguments], env=environment(bench), **options)


def environment(bench: Bench) -> dict[str, str]:
    """Return the environment in which pigs finds the daemon."""
    return os.environ | {"PIGPIO_ADDR": "127.0.0.1", "PIGPIO_PORT": str(bench.daemon.port)}


@contextlib.contextmanager
def pigs_under_way(bench: Bench, *arguments: str) -> Iterator[subprocess.Popen[bytes]]:
    assert PIGS is not None
    with subprocess.Popen([PIGS, *arguments], env=environment(bench)) as process:
        try:
            yield process
        finally:
            process.kill()


def run_pigs(bench: Bench, *arguments: str) -> str:
    """Run pigs, check that it succeeds, and return its output."""
    done = pigs(bench, *arguments)
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout.strip()


def test_the_last_resort_moves_the_servo_to_neutral_and_lets_go(bench: Bench) -> None:
    bench.pi.set_servo_pulsewidth(GPIO, 1700)
    assert eventually(lambda: bench.width == 1700)
    begun = time.monotonic()
    assert run_pigs(bench, "s", "18", "1500", "mils", "300", "s", "18", "0") == ""
    assert time.monotonic() - begun >= 0.3
    assert eventually(lambda: bench.width == 0)
    (neutral, off) = bench.daemon.history(GPIO)[-2:]
    assert (neutral[1], off[1]) == (1500, 0)
    assert off[0] - neutral[0] >= 0.3 - 0.02


def test_a_delay_of_one_client_holds_up_no_other(bench: Bench) -> None:
    with pigs_under_way(bench, "s", "18", "1500", "mils", "60000") as waiting:
        assert eventually(lambda: bench.width == 1500)
        assert bench.pi.set_servo_pulsewidth(GPIO, 1600) == 0
        assert run_pigs(bench, "gpw", "18") == "1600"
        assert waiting.poll() is None


def test_scripts_are_stored_run_watched_and_deleted(bench: Bench) -> None:
    number = run_pigs(bench, "proc", "tag 0 mils 10 lda p0 cmp 0 jz 0 dcr p0 jnz 0 s p1 p2 jmp 0")
    assert number == "0"
    run_pigs(bench, "procr", number, "5", "18", "1500")
    assert eventually(lambda: bench.width == 1500)
    assert run_pigs(bench, "procp", number) == "2 0 18 1500 0 0 0 0 0 0 0"
    run_pigs(bench, "procu", number, "0", "18", "1600")
    assert run_pigs(bench, "procp", number) == "2 0 18 1600 0 0 0 0 0 0 0"
    run_pigs(bench, "procs", number)
    assert eventually(lambda: run_pigs(bench, "procp", number).startswith("1 "))
    run_pigs(bench, "procd", number)
    assert pigs(bench, "procp", number).stdout.strip() == "-48"
