"""The verbs about learning, loaded when they are called (extra: learn)."""

import click

from fishd.cli.verbs import Verb, Verbs

VERBS = {
    "Verbs": {
        "ppo": Verb("learn.ppo", "ppo", "Train a policy, in simulation or on the robot."),
        "export": Verb("learn.export", "export", "Write a trained policy to one .onnx file."),
        "evaluate": Verb(
            "learn.evaluate", "evaluate", "Let a policy or controller swim many other fish."
        ),
    }
}


@click.group(cls=Verbs, verbs=VERBS)
def learn() -> None:
    """Train policies, test them on other fish, and write them to files."""
