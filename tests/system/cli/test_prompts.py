"""What a signal does to a prompt, whenever it comes."""

import random
import select
import signal
import subprocess
import sys
import time

from rigs.processes import PATIENCE

PROMPTS = """
import signal, threading, time
from fishd.cli.prompts import input_interrupted

def interrupt(*_):
    raise KeyboardInterrupt

def compute():
    while True:
        time.sleep(0.0005)
        sum(range(2000))

signal.signal(signal.SIGTERM, interrupt)
threading.Thread(target=compute, daemon=True).start()
while True:
    try:
        with input_interrupted():
            input("?")
    except KeyboardInterrupt:
        print("interrupted", flush=True)
"""
"""Asks again and again, beside a thread that takes the interpreter's lock as the lease's does."""


def test_a_signal_at_any_instant_after_a_prompt_interrupts_it() -> None:
    instants = random.Random(11)
    asking = subprocess.Popen(
        [sys.executable, "-c", PROMPTS], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    assert asking.stdout
    try:
        for _ in range(100):
            assert asking.stdout.read(1) == b"?"
            instant = time.perf_counter() + instants.uniform(0.0, 1e-4)
            while time.perf_counter() < instant:
                pass  # a sleep is longer than the time between the prompt and the wait for input
            asking.send_signal(signal.SIGTERM)
            heard, _, _ = select.select([asking.stdout], [], [], PATIENCE)
            assert heard, "it waits for input"
            assert asking.stdout.readline() == b"interrupted\n"
    finally:
        asking.kill()
        asking.communicate()
