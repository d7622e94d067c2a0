"""Error budgets: spectra of disturbances to the RMS position error and force of a closed loop."""

from surrogates.lazy_names import from_stub

__all__ = from_stub(__name__)
