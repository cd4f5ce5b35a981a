"""Settings of the window: where it listens, which fish it shows, and where it keeps things."""

import os
import re
from pathlib import Path
from typing import Annotated, NamedTuple

from msgspec import Struct

from fishd.core import strict_yaml
from fishd.core.addresses import find_connect_problem, is_local
from fishd.core.errors import ConfigError
from fishd.core.files import expand_user
from fishd.core.schema import Problem, convert, note

DEFAULT_LISTEN = "127.0.0.1:8880"
UNNAMED_FISH = "fish"
"""Name in addresses of a fish that was given none."""
FISH_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,39}")
"""Names of fish, which are parts of the page's addresses."""
_LISTEN = re.compile(r"(?P<host>[A-Za-z0-9._-]+|\[[0-9A-Fa-f:.]+\]):(?P<port>[0-9]{1,5})")
_ORIGIN = re.compile(r"[a-z][a-z0-9+.-]*://[A-Za-z0-9.:\[\]-]*")


class Address(NamedTuple):
    """Address at which the page is served."""

    host: str
    port: int


class WindowSettings(Struct, frozen=True, forbid_unknown_fields=True):
    """Settings of `fishd-window`."""

    listen: Annotated[
        str, note("Address of the page: HOST:PORT. 0.0.0.0 is every address of this machine.")
    ] = DEFAULT_LISTEN
    fish: Annotated[
        dict[str, str], note("Control socket of each fish, by its name; empty for this machine's.")
    ] = {}
    cameras: Annotated[
        dict[str, str],
        note(
            "Address of the requests of the camera above each fish, by the name of the fish; "
            "empty: $FISHD_CAMERA, else that of this machine, above the first fish."
        ),
    ] = {}
    names: Annotated[
        tuple[str, ...],
        note("Further host names of this machine for browsers, such as that of a reverse proxy."),
    ] = ()
    origins: Annotated[
        tuple[str, ...], note("Origins whose Foxglove or Lichtblick may read the fish.")
    ] = ()
    pair_all: Annotated[
        bool, note("Whether browsers on this machine need pairing, too, as behind a reverse proxy.")
    ] = False
    runs: Annotated[str | None, note("Folder of recordings; null: $FISHD_RUNS, else runs.")] = None
    state: Annotated[str | None, note("Folder of the paired devices; null: one of this user.")] = (
        None
    )

    @property
    def address(self) -> Address:
        """Address at which the page is served."""
        match = _LISTEN.fullmatch(self.listen)
        assert match
        return Address(match["host"].strip("[]"), int(match["port"]))

    @property
    def is_local(self) -> bool:
        """Whether only this machine reaches the page."""
        host = self.address.host
        return is_local(f"tcp://{f'[{host}]' if ':' in host else host}:1") or host == "::1"

    @property
    def endpoints(self) -> dict[str, str | None]:
        """Control socket of each fish, by its name; None for the fishd of this machine."""
        return {**self.fish} or {UNNAMED_FISH: None}

    @property
    def camera_addresses(self) -> dict[str, str | None]:
        """Address of the camera above each fish with one; None for the camera of this machine."""
        return {**self.cameras} or {next(iter(self.endpoints)): None}

    @property
    def state_folder(self) -> Path:
        """Folder of the paired devices."""
        base = os.environ.get("STATE_DIRECTORY") or os.environ.get("XDG_STATE_HOME")
        if self.state:
            return expand_user(self.state)
        if os.environ.get("STATE_DIRECTORY"):
            return Path(os.environ["STATE_DIRECTORY"])
        return Path(base or expand_user("~/.local/state")) / "fishd-window"

    @property
    def runs_folder(self) -> Path:
        """Folder of recordings and experiments."""
        return expand_user(self.runs or os.environ.get("FISHD_RUNS") or "runs").absolute()


def load(path: Path | None, **overrides: object) -> WindowSettings:
    """Return the settings in a file, or the defaults, with those of the command line.

    Raises `ConfigError`, which names file, line and key.
    """
    data, places = (
        strict_yaml.read(path, "the window", "listen: 127.0.0.1:8880") if path else ({}, {})
    )
    for key, value in overrides.items():
        if value:
            data[key] = value
            places[(key,)] = f"--{key}"
    try:
        settings = convert(data, WindowSettings)
        _check(settings)
    except Problem as problem:
        raise ConfigError(problem.message_with_place(places)) from None
    return settings


def _check(settings: WindowSettings) -> None:
    match = _LISTEN.fullmatch(settings.listen)
    if not match or int(match["port"]) > 65535:
        raise Problem(
            ("listen",),
            f"'{settings.listen}' is not valid: HOST:PORT is needed, such as {DEFAULT_LISTEN}",
        )
    for name, endpoint in settings.fish.items():
        if not FISH_NAME.fullmatch(name):
            raise Problem(
                ("fish", name),
                "is not valid: up to 40 letters, digits, dots and dashes are needed",
            )
        if complaint := find_connect_problem(endpoint):
            raise Problem(("fish", name), f"'{endpoint}' is not valid: {complaint}")
    for name, address in settings.cameras.items():
        if name not in settings.endpoints:
            known = ", ".join(settings.endpoints)
            raise Problem(("cameras", name), f"is not the name of a fish; here: {known}")
        if complaint := find_connect_problem(address):
            raise Problem(("cameras", name), f"'{address}' is not valid: {complaint}")
    for origin in settings.origins:
        if not _ORIGIN.fullmatch(origin):
            raise Problem(
                ("origins",), f"'{origin}' is not an origin, such as https://app.foxglove.dev"
            )
