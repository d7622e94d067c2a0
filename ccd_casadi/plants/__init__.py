"""Plants as CasADi expressions of θ or finite elements, their modes, and scaled state space."""
