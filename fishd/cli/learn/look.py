"""The verb that shows what a policy looks at."""

from pathlib import Path

import click

from fishd.cli.completion import complete_policy
from fishd.cli.config import fish_options
from fishd.config import load


@click.command()
@click.argument("policy", metavar="NAME|FILE", shell_complete=complete_policy)
@click.option(
    "--png",
    "picture",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    help="Draw the heat map over the mean picture into this file (.png, .svg).",
)
@click.option(
    "--camera",
    metavar="FILE",
    help="YAML file of a simulated camera, such as config/camera-web.yaml. [default: a good one]",
)
@click.option(
    "--seconds",
    type=float,
    default=15.0,
    show_default=True,
    help="Length of the swim [s]; the first 5 are left out.",
)
@fish_options
def look(
    policy: str,
    picture: Path | None,
    camera: str | None,
    seconds: float,
    file: Path | None,
    overrides: tuple[str, ...],
) -> None:
    """Show what a policy that sees pictures looks at.

    It swims a simulated fish; then a patch of the mean picture hides one part of the frames after
    the other. Where that changes the action most, the policy looks.
    """
    from fishd.camera import settings as cameras
    from fishd.lab import drawing
    from fishd.learning import look as looking

    if picture:
        drawing.check(picture)
    config, seen = load(file, overrides), cameras.simulated(camera)
    found = looking.look(policy, config, seen, seconds)
    click.echo(
        f"{policy}: {found.share:.0%} of the sensitivity lies where the tail moves, on "
        f"{found.area:.0%} of the picture"
    )
    if picture:
        looking.draw(picture, found, f"what {Path(policy).name} looks at")
        click.echo(f"drawn: {picture}")
