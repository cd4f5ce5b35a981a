"""The verbs about learning, loaded when they are called; they need the extra `learn`."""

import click

from fishd.cli.verbs import Verb, Verbs
from fishd.core.console import complain

VERBS = {
    "Verbs": {
        "ppo": Verb("learn.ppo", "ppo", "Train a policy, in simulation or on the robot."),
        "export": Verb("learn.export", "export", "Write a trained policy to one .onnx file."),
    }
}

_EXTRA = {
    "distributed": "cluster",
    "gymnasium": "learn",
    "joblib": "learn",
    "matplotlib": "lab",
    "onnx": "policy",
    "onnxruntime": "policy",
    "stable_baselines3": "learn",
    "tensorboard": "learn",
    "torch": "learn",
}


class LearnVerbs(Verbs):
    """A package of an extra that is missing is one line."""

    def invoke(self, ctx: click.Context) -> object:
        """Run a verb."""
        try:
            return super().invoke(ctx)
        except ModuleNotFoundError as error:
            package = (error.name or "").partition(".")[0]
            if package not in _EXTRA:
                raise
            extra = _EXTRA[package]
            complain(
                "fishctl",
                f"{package} is not installed; where the sources of fishd are: "
                f"pip install --constraint tools/constraints.txt --editable '.[{extra}]'",
                1,
            )


@click.group(cls=LearnVerbs, verbs=VERBS)
def learn() -> None:
    """Learn to swim: train policies, and write them to files."""
