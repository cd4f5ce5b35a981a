"""The verb that writes a policy file."""

import shlex
from pathlib import Path

import click

from fishd.cli.options import json_option
from fishd.cli.output import print_json
from fishd.core.errors import PolicyError


@click.command()
@click.argument("run", type=click.Path(path_type=Path), metavar="RUN")
@click.option(
    "--to",
    "target",
    type=click.Path(path_type=Path),
    metavar="FILE|FOLDER",
    default=Path(),
    help="File to write (.onnx), or a folder for a file named after the run. [default: this "
    "folder]",
)
@click.option("--newest", is_flag=True, help="Export the newest checkpoint instead of the best.")
@click.option(
    "--force", is_flag=True, help="Overwrite the file; and export a policy that stalls, too."
)
@click.option("--note", default="", help="Remark that is stored in the file.")
@json_option
def export(run: Path, target: Path, newest: bool, force: bool, note: str, as_json: bool) -> None:
    """Write the policy of RUN, a run folder or one of its checkpoints, to one .onnx file."""
    from fishd.controllers.policy.library import SUFFIX
    from fishd.learning.export import export as write
    from fishd.learning.run_folder import checkpoints
    from fishd.learning.train.progress import format_summary

    if not target.is_dir() and target.suffix != SUFFIX:
        raise PolicyError(f"{target}: the name of a policy file must end in {SUFFIX}")
    checkpoint = checkpoints.find(run, latest=newest)
    run_folder = run if checkpoint != run else run.resolve().parent
    if target.is_dir():
        target /= f"{run_folder.resolve().name}{SUFFIX}"
    if target.is_file() and not force:
        raise PolicyError(f"{target}: exists already; --force overwrites it, --to names another")
    exported = write(checkpoint, target, force=force, note=note)
    provenance = exported.card.provenance
    if as_json:
        files = {"path": exported.path, "checkpoint": exported.checkpoint, "bytes": exported.size}
        print_json({**files, "evaluation": exported.evaluation})
        return
    click.echo(
        f"{exported.path}: {exported.size / 1024:.0f} kB from {exported.checkpoint}, "
        f"{provenance.steps} steps in {provenance.on}"
    )
    if exported.evaluation.is_stalled:
        click.echo("careful: it stalls without exploration")
    else:
        click.echo(f"it swims with {format_summary(exported.evaluation)}")
    path = shlex.quote(str(exported.path))
    if exported.card.pictures:
        click.echo(f"it sees {exported.card.sees}; to let it swim: fishctl agent {path}")
    else:
        click.echo(f"to let it swim: fishctl set-controller ppo --policy {path}")
