"""`python -m fishd` is `fishd`."""

from fishd.entry import fishd

fishd()
