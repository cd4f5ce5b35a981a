"""The Gymnasium environments, on the simulated fish and on a running fishd."""
