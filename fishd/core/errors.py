"""Exceptions that fishd raises on purpose.

Each message is one line that says what is wrong, where, and what would be right.
"""

from typing import Any, Self


class FishdError(Exception):
    """Base of all exceptions here except `Escaped`."""


class ConfigError(FishdError, ValueError):
    """The configuration is wrong; the message names file, line and key."""


class ParameterError(FishdError, ValueError):
    """A controller's parameter is unknown, of the wrong type or out of range.

    `path` leads to that parameter, if it is known.
    """

    def __init__(self, message: str, path: tuple[str, ...] = ()) -> None:
        super().__init__(message)
        self.path = path


class UnknownController(FishdError, LookupError):
    """No installed package offers a controller of that name."""


class UnknownDriver(FishdError, LookupError):
    """No installed package offers a driver of that name, or it does not load."""


class UnknownPlant(FishdError, LookupError):
    """No installed package offers a plant of that name, or it does not load."""


class UnknownRobot(FishdError, LookupError):
    """No installed package offers a robot of that name, or it does not load."""


class PolicyError(FishdError, ValueError):
    """A file does not contain a policy, or its policy does not fit this robot."""


class ControllerFault(FishdError, RuntimeError):
    """A controller cannot continue; raised from `update`, it latches a fault with this `code`.

    With a `successor`, a name and a controller instance, that controller takes over instead.
    """

    def __init__(self, code: str, message: str, successor: tuple[str, Any] | None = None) -> None:
        super().__init__(message)
        self.code = code
        self.successor = successor


class StartupError(FishdError, RuntimeError):
    """The daemon cannot start in the current state of this machine."""


class MissingPackage(StartupError):
    """A library of a driver or of an extra is not installed, or cannot be imported."""

    @classmethod
    def of_extra(cls, purpose: str, package: str, extra: str) -> Self:
        """Return the error for a purpose whose package comes with an extra of fishd."""
        return cls(
            f"{purpose} needs the package {package}; install it with: {install_command(extra)}"
        )


def install_command(extra: str = "") -> str:
    """Return the command that installs fishd with an extra, from where fishd was installed."""
    import json  # only needed for this message
    import shlex
    import sys
    from importlib.metadata import Distribution, PackageNotFoundError
    from urllib.parse import unquote, urlsplit

    pip = f"{shlex.quote(sys.executable)} -m pip install"
    try:
        distribution = Distribution.from_name("fishd")
        installer = distribution.read_text("INSTALLER") or ""
        if installer.strip() == "dpkg":  # the environment of a Debian package must not change
            pip = "python3 -m venv ~/fishd && ~/fishd/bin/pip install"
        origin = json.loads(distribution.read_text("direct_url.json") or "{}")
    except PackageNotFoundError:  # runs from its sources, without an installation
        origin = {"url": ".", "dir_info": {"editable": True}}
    suffix = f"[{extra}]" if extra else ""
    source = unquote(urlsplit(origin.get("url", "")).path)
    if not source:
        return f"{pip} {shlex.quote(f'fishd{suffix}')}"
    target = shlex.quote(f"{source}{suffix}")
    if not origin.get("dir_info", {}).get("editable"):
        return f"{pip} {target}"
    constraints = shlex.quote(f"{source}/tools/constraints.txt")
    return f"{pip} --constraint {constraints} --editable {target}"


class SensorError(FishdError, OSError):
    """The force sensor cannot be read."""


class FishLost(FishdError):
    """A simulated fish cannot continue; later reads will fail, too."""


class ServoError(FishdError, OSError):
    """The servo cannot be driven."""


class RecordingError(FishdError, OSError):
    """A recording cannot be written, or a file does not contain one."""


class FishError(FishdError):
    """A request to a daemon failed."""


class NoDaemon(FishError, ConnectionError):
    """Nothing answers at the endpoint."""

    def __init__(self, problem: str = "", remedy: str = "") -> None:
        """remedy: end of the message, which begins with a semicolon"""
        super().__init__(problem + remedy)
        self.problem = problem
        """The message without its remedy."""


class Untrusted(NoDaemon):
    """Another user's process listens where the fishd of this user would."""


class NoKey(FishError):
    """The endpoint needs a key that this client lacks, or refuses the client's key."""


class Refused(FishError, RuntimeError):
    """The daemon refused the request.

    `code` is the machine-readable reason, as listed in docs/reference/protocol.md.
    """

    def __init__(self, code: str, message: str) -> None:
        super().__init__(message)
        self.code = code


class LeaseLost(Refused):
    """The program no longer holds the lease of the fish; the message says why."""


class Escaped(Exception):
    """Code of another package raised an error that is not an `Exception`, such as SystemExit.

    `__cause__` is that error.
    """
