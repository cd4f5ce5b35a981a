"""The exceptions that fishd raises on purpose.

Each message is one line that says what is wrong, where, and what would be right.
"""

from typing import Any


class FishdError(Exception):
    """Base of all exceptions here except `Escaped`."""


class ConfigError(FishdError, ValueError):
    """The configuration is wrong; the message names file, line and key."""


class ParameterError(FishdError, ValueError):
    """A controller's parameter is unknown, of the wrong type or out of range.

    `path` names it where there is one to blame.
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


class PolicyError(FishdError, ValueError):
    """A file holds no policy, or one that does not fit this robot."""


class ControllerFault(FishdError, RuntimeError):
    """A controller cannot go on; raised from `update`, it latches a fault with this `code`.

    Where there is a `successor`, a name and a ready-made controller, that takes over instead.
    """

    def __init__(self, code: str, message: str, successor: tuple[str, Any] | None = None) -> None:
        super().__init__(message)
        self.code = code
        self.successor = successor


class StartupError(FishdError, RuntimeError):
    """The daemon cannot start on this machine as it is."""


class MissingPackage(StartupError):
    """A driver's library is not installed, or cannot be imported."""


class SensorError(FishdError, OSError):
    """The force sensor cannot be read."""


class FishLost(FishdError):
    """A simulated fish cannot go on, and no later read will find it again."""


class ServoError(FishdError, OSError):
    """The servo cannot be driven."""


class RecordingError(FishdError, OSError):
    """A recording cannot be written, or a file holds none."""


class FishError(FishdError):
    """A request to a daemon failed."""


class NoDaemon(FishError, ConnectionError):
    """Nothing answers at the endpoint."""


class Untrusted(NoDaemon):
    """Another user listens where the fishd of this one would be."""


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
    """Code that is not fishd's raised what is no Exception, such as SystemExit: its cause."""
