"""How far the best of all controllers is away: bounds on ω_b from outside and from inside."""
