"""Prompts and waits that a signal ends, whenever it comes."""

import os
import select
import signal
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import click

from fishd.core.process.interruption import SIGNALS, handle_signals

_REPEAT_INTERVAL_S = 0.1
"""Time between two interruptions of a system call [s]."""


@contextmanager
def input_interrupted() -> Iterator[None]:
    """Let a signal that has a handler end a wait for input, whenever it comes.

    For the main thread. Python runs a handler between two of its instructions, or when the
    signal interrupts a system call. One that comes just before `read` begins would wait there for
    the next line of input. So after the first signal, a thread keeps interrupting the main thread.
    """
    main = threading.get_ident()
    reader, writer = os.pipe()
    os.set_blocking(writer, False)  # required by `signal.set_wakeup_fd`
    ended = threading.Event()

    def interrupt() -> None:
        if os.read(reader, 1):  # empty if this ends without a signal
            while not ended.wait(_REPEAT_INTERVAL_S):
                signal.pthread_kill(main, signal.SIGURG)

    thread = threading.Thread(target=interrupt, name="interrupt", daemon=True)
    with handle_signals([signal.SIGURG], lambda *_: None):
        previous_fd = signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
        thread.start()
        try:
            yield
        finally:
            ended.set()
            signal.set_wakeup_fd(previous_fd)
            os.close(writer)
            thread.join()
            os.close(reader)


@contextmanager
def caught_signals() -> Iterator[Callable[[float], bool]]:
    """Yield a function that waits for one of the three signals, up to some seconds.

    It returns True once one has come. Main thread only.
    """
    reader, writer = socket.socketpair()
    with reader, writer, handle_signals(SIGNALS, lambda *_: None):
        writer.setblocking(False)  # required by `signal.set_wakeup_fd`
        before = signal.set_wakeup_fd(writer.fileno(), warn_on_full_buffer=False)
        try:
            yield lambda seconds: bool(select.select([reader], [], [], seconds)[0])
        finally:
            signal.set_wakeup_fd(before)


def choose(prompt: str, *words: str, suffix: str = ": ") -> str:
    """Prompt until the answer is one of `words`; an empty word stands for Enter alone."""

    def parse(answer: str) -> str:
        word = answer.strip().lower()
        if word in words:
            return word
        possible = " or ".join(choice or "Enter" for choice in words)
        raise click.UsageError(f"{possible} is needed, not '{answer}'; Ctrl-C ends without saving")

    answer: str = click.prompt(
        prompt, default="", show_default=False, prompt_suffix=suffix, value_proc=parse
    )
    return answer
