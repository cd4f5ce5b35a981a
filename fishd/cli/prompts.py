"""How verbs ask: a signal ends a prompt whenever it comes."""

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import click

from fishd.core.process.interruption import handled

_AGAIN = 0.1
"""Time after which a system call is interrupted again [s]."""


@contextmanager
def input_interrupted() -> Iterator[None]:
    """While this lasts, a signal that has a handler ends a wait for input, whenever it comes.

    For the main thread. Python runs a handler between two of its own instructions, or where the
    signal interrupts a system call. One that comes just before `read` begins would wait there for
    the next line of input. So from the first signal on, a thread interrupts the main one again.
    """
    main = threading.get_ident()
    reader, writer = os.pipe()
    os.set_blocking(writer, False)  # as `signal.set_wakeup_fd` wants it
    ended = threading.Event()

    def interrupt() -> None:
        if os.read(reader, 1):  # nothing where this ends without a signal
            while not ended.wait(_AGAIN):
                signal.pthread_kill(main, signal.SIGURG)

    thread = threading.Thread(target=interrupt, name="interrupt", daemon=True)
    with handled([signal.SIGURG], lambda *_: None):
        before = signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
        thread.start()
        try:
            yield
        finally:
            ended.set()
            signal.set_wakeup_fd(before)
            os.close(writer)
            thread.join()
            os.close(reader)


def choose(prompt: str, *words: str, suffix: str = ": ") -> str:
    """Ask until the answer is one of `words`, of which an empty one stands for Enter alone."""

    def chosen(answer: str) -> str:
        word = answer.strip().lower()
        if word in words:
            return word
        possible = " or ".join(each or "Enter" for each in words)
        raise click.UsageError(f"{possible} is needed, not '{answer}'; Ctrl-C ends without saving")

    answer: str = click.prompt(
        prompt, default="", show_default=False, prompt_suffix=suffix, value_proc=chosen
    )
    return answer
