"""Prompts of the calibration dialogues."""

import click


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
