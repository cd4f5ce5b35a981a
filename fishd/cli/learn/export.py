"""The verb that writes a policy file."""

import shlex
from pathlib import Path

import click


@click.command()
@click.argument("run", type=click.Path(path_type=Path), metavar="RUN")
@click.option(
    "--to",
    "target",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    help="The file to write. [default: the name of the run and .onnx, in this folder]",
)
@click.option("--newest", is_flag=True, help="The newest checkpoint rather than the best.")
@click.option("--force", is_flag=True, help="Even if the policy stalls.")
@click.option("--note", default="", help="A remark for people, kept in the file.")
def export(run: Path, target: Path | None, newest: bool, force: bool, note: str) -> None:
    """Write the policy of RUN, a run folder or one of its checkpoints, to one .onnx file."""
    from fishd.learning import checkpoints
    from fishd.learning.export import export as write
    from fishd.learning.progress import figures

    checkpoint = checkpoints.find(run, latest=newest)
    whole = run if checkpoint != run else run.resolve().parent
    found = write(
        checkpoint, target or Path(f"{whole.resolve().name}.onnx"), force=force, note=note
    )
    past = found.card.provenance
    click.echo(
        f"{found.path}: {found.size / 1024:.0f} kB from {found.checkpoint}, {past.steps} steps "
        f"in {past.on}"
    )
    if found.trial.stalled:
        click.echo("careful: it stalls without exploration")
    else:
        assert past.efficiency is not None
        click.echo(
            "it swims with " + figures(found.trial.thrust, past.efficiency, found.trial.frequency)
        )
    path = shlex.quote(str(found.path))
    click.echo(f"to let it swim: fishctl set-controller ppo --policy {path}")
