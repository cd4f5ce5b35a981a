"""Opens a policy for a robot: finds its file, and refuses one that does not fit."""

from fishd.controllers.base import Limits
from fishd.controllers.policy import file, library
from fishd.controllers.policy.file import PolicyFile
from fishd.core.errors import PolicyError


def read(text: str, limits: Limits) -> PolicyFile:
    """The policy of this name or path, if it can swim within these limits; raises `PolicyError`."""
    path = library.find(text)
    policy = file.read(path)
    try:
        policy.card.check_fit(limits.tick, limits.amplitude)
        if limits.scaled and any(seen.name == "fin_velocity" for seen in policy.card.observation):
            raise PolicyError(
                "it was trained to see fin_velocity as estimator.kind: lateral_force gives it, and "
                "fishd runs with another one"
            )
    except PolicyError as error:
        raise PolicyError(f"{path}: {error}") from None
    return policy
