"""The verb that shows the picture of a camera on the page of the fish."""

from typing import Any

import click

from fishd.cli.window import open_page
from fishd.window.main import window_options


@click.command()
@window_options
@click.pass_context
def page(ctx: click.Context, /, **values: Any) -> int:
    """Show what the camera sees on the page of the fish; start the page unless it runs.

    The measured tail and, on request, the axis of motion are drawn in. The page shows the camera of
    this machine, that of $FISHD_CAMERA, or that of its settings.
    """
    return int(ctx.invoke(open_page, place="#camera", **values))
