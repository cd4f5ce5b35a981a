"""Opening of a policy for a robot: finds its file, and refuses one that does not fit."""

from fishd.controllers.base import Limits
from fishd.controllers.policy import file, library
from fishd.controllers.policy.file import PolicyFile
from fishd.core.errors import PolicyError


def read(text: str, limits: Limits) -> PolicyFile:
    """Return the policy of a name or path if it fits these limits; else raise `PolicyError`."""
    path = library.find(text)
    policy = file.read(path)
    try:
        policy.card.check_fit(limits.tick, limits.amplitude, limits.readings)
        if limits.scaled and any(
            feature.name == "fin_velocity" for feature in policy.card.observation
        ):
            raise PolicyError(
                "it was trained with the fin_velocity of estimator.kind: lateral_force, but "
                "fishd uses another kind"
            )
    except PolicyError as error:
        raise PolicyError(f"{path}: {error}") from None
    return policy
