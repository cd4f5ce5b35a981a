"""Learning to swim: Gymnasium environments, PPO training, export and comparison (extra: learn).

To import it registers `fishd/Swim-v0` and `fishd/SwimOnDaemon-v0` with Gymnasium.
"""

from fishd.learning.registration import register

register()
