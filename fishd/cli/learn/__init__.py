"""The verbs about learning, loaded when they are called; they need the extra `learn`."""

import click

from fishd.cli.verbs import Verb, Verbs
from fishd.console import complain

VERBS = {
    "ppo": Verb("learn_ppo", "ppo", "Train a policy, in simulation or on the robot."),
    "export": Verb("learn_export", "export", "Write a trained policy to one .onnx file."),
    "evaluate": Verb("learn_evaluate", "evaluate", "Compare policies and controllers on one fish."),
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
    """Names the extra that is missing."""

    def invoke(self, ctx: click.Context) -> object:
        """Run a verb; a package of an extra that is missing is one line."""
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
    """Learn to swim: train policies, write them to files, compare them."""
