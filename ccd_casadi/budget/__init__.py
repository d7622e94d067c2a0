"""Error budgets: spectra of disturbances to the RMS position error and force of a closed loop."""
