"""The estimators: each turns measurements into the observation that controllers see."""
