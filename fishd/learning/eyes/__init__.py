"""Eyes: what turns pictures of the tail into the numbers that a policy's network is given."""
