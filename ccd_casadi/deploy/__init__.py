"""From a certified controller to one that can be built: reduced, sampled, verified, in C."""
