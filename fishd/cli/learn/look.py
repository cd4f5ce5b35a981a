"""The verb that shows at which parts of pictures a policy looks."""

from pathlib import Path

import click

from fishd.cli.completion import complete_policy
from fishd.cli.config import fish_options
from fishd.cli.options import camera_config_option, for_option, json_option, plot_option
from fishd.cli.output import print_json
from fishd.config import load


@click.command()
@click.argument("policy", metavar="NAME|FILE", shell_complete=complete_policy)
@plot_option("the heat map over the mean picture")
@camera_config_option()
@for_option("Length of the swim [s]; the first 5 s are left out.", default=15.0, kind=click.FLOAT)
@json_option
@fish_options
def look(
    policy: str,
    picture: Path | None,
    camera_config: str | None,
    seconds: float,
    file: Path | None,
    overrides: tuple[str, ...],
    as_json: bool,
) -> None:
    """Show what a policy that sees pictures looks at.

    The policy swims a simulated fish; then a patch of the mean picture hides one part of the frames
    after another. The policy looks at those parts that change its action most.
    """
    from fishd.camera import settings as cameras
    from fishd.lab import drawing
    from fishd.learning import look as looking

    if picture:
        drawing.check(picture)
    config, camera_settings = load(file, overrides), cameras.load_simulated(camera_config)
    result = looking.look(policy, config, camera_settings, seconds)
    if as_json:
        print_json({"policy": policy, "share": result.share, "area": result.area})
    else:
        click.echo(
            f"{policy}: {result.share:.0%} of the sensitivity lies where the tail moves, on "
            f"{result.area:.0%} of the picture"
        )
    if picture:
        looking.draw(picture, result, f"what {Path(policy).name} looks at")
        click.echo(f"drawn: {picture}", err=as_json)
