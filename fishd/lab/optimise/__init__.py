"""Search of the best parameters of a controller on a rig, by Bayesian optimisation."""
