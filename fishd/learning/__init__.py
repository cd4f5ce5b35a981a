"""Learning to swim: Gymnasium environments, PPO training, export and comparison (extra: learn)."""
