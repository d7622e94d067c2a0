"""What a finished design survives: margins, perturbed plants, noise, a move."""
