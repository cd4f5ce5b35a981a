"""Links to a fish that a program in this process swims, tick by tick: live or simulated."""
