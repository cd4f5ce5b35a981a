"""Learning to swim: environments, PPO training and export (extra: learn).

Importing it registers `fishd/Swim-v0` and `fishd/SwimOnDaemon-v0` with Gymnasium.
"""

from fishd.learning.env.registration import register

register()
