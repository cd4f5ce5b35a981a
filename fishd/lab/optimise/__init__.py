"""The best parameters of a controller on a rig, searched by Bayesian optimisation."""
