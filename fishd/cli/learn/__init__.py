"""The verbs about learning, loaded when they are called; they need the extra `learn`."""

import click

from fishd.cli.verbs import Verb, Verbs

VERBS = {
    "Verbs": {
        "ppo": Verb("learn.ppo", "ppo", "Train a policy, in simulation or on the robot."),
        "export": Verb("learn.export", "export", "Write a trained policy to one .onnx file."),
        "evaluate": Verb(
            "learn.evaluate", "evaluate", "How a policy or controller swims many other fish."
        ),
        "look": Verb("learn.look", "look", "Show what a policy that sees pictures looks at."),
    }
}


@click.group(cls=Verbs, verbs=VERBS)
def learn() -> None:
    """Learn to swim: train policies, try them on other fish, and write them to files."""
