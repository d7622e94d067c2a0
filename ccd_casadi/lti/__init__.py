"""Linear time-invariant systems: state space, closed loop, hold and delay, grids, peaks, norms."""
