"""What a finished design survives: margins, noise, plants off the model, a real move."""
