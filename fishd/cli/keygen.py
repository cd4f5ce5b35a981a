"""The verb that makes a key for access over the network."""

import getpass
import socket
from pathlib import Path

import click

from fishd.cli.options import json_option
from fishd.cli.output import echo, print_json
from fishd.core import keys


@click.command()
@click.option(
    "--to",
    "folder",
    type=click.Path(path_type=Path, file_okay=False),
    metavar="FOLDER",
    help="Folder of the key. [default: $FISHD_KEYS, else ~/.config/fishd/keys]",
)
@json_option
def keygen(folder: Path | None, as_json: bool) -> None:
    """Make a key for access over the network, for a client or for fishd.

    Writes the secret key and the public key into a folder, and prints the lines that let a client
    and a fishd know each other. A key that exists is never overwritten.
    """
    import zmq

    folder = (folder or keys.client_folder()).absolute()
    public, secret = (key.decode() for key in zmq.curve_keypair())
    keys.make_keys(folder, public, secret)
    if as_json:
        print_json({"folder": str(folder), "public_key": public})
        return
    known = folder / keys.KNOWN_FILE
    echo(f"""\
Wrote {folder / keys.SECRET_FILE}, which is secret, and {keys.PUBLIC_FILE} beside it:
{public}

For a client, add this line (or with watch instead of drive) to the file known of fishd:
drive {public} {_user_name()}
and a line for each fishd to {known}:
tcp://HOST:9877 PUBLIC-KEY-OF-FISHD

For fishd, add this to its configuration, and a line for each client to {known}:
network:
  keys: {folder}""")


def _user_name() -> str:
    try:
        user = getpass.getuser()
    except (KeyError, OSError):  # this user has no name
        user = "client"
    return f"{user}@{socket.gethostname()}"
