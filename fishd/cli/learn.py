"""The verbs about learning, loaded when they are called; they need the extra `learn`."""

from importlib import import_module

import click

from fishd.console import complain

# verb: (module in fishd.cli, command in it, one line of help)
VERBS = {
    "ppo": ("learn_ppo", "ppo", "Train a policy, in simulation or on the robot."),
    "export": ("learn_export", "export", "Write a trained policy to one .onnx file."),
    "evaluate": ("learn_evaluate", "evaluate", "Compare policies and controllers on one fish."),
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


class LearnVerbs(click.Group):
    """A group that imports a verb only when it is called, and names the extra that is missing."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """All verbs, in the order of the table."""
        return list(VERBS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import a verb."""
        if cmd_name not in VERBS:
            return None
        module, attribute, _ = VERBS[cmd_name]
        command: click.Command = getattr(import_module(f"fishd.cli.{module}"), attribute)
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """List the verbs without importing any."""
        with formatter.section("Verbs"):
            formatter.write_dl([(verb, about) for verb, (_, _, about) in VERBS.items()])

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
                "fishctl", f"{package} is not installed: install fishd[{extra}], with that extra", 1
            )


@click.group(cls=LearnVerbs)
def learn() -> None:
    """Learn to swim: train policies, write them to files, compare them."""
