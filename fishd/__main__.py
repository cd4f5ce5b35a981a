"""`python -m fishd` is `fishd`."""

from fishd.daemon import main

main()
