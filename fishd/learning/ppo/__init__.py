"""The PPO model of stable-baselines3 as fishd trains it, with left-right symmetry."""
