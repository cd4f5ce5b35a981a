"""A signal ends a prompt, whenever it comes."""

import random
import select
import signal
import subprocess
import sys
import time

from rigs.processes import PATIENCE

PROGRAM = """
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
"""Program that prompts repeatedly; like the lease, a thread takes the interpreter's lock."""


def test_a_signal_at_any_instant_after_a_prompt_interrupts_it() -> None:
    instants = random.Random(11)
    command = [sys.executable, "-c", PROGRAM]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    try:
        for _ in range(100):
            assert process.stdout.read(1) == b"?"
            instant = time.perf_counter() + instants.uniform(0.0, 1e-4)
            while time.perf_counter() < instant:
                pass  # a sleep is longer than the time between the prompt and the wait for input
            process.send_signal(signal.SIGTERM)
            readable, _, _ = select.select([process.stdout], [], [], PATIENCE)
            assert readable, "it waits for input"
            assert process.stdout.readline() == b"interrupted\n"
    finally:
        process.kill()
        process.communicate()
