"""The laboratory: thrust with its interval, sweeps, optima, fits and figures (extra: lab)."""
