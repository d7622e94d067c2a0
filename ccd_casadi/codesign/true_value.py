"""The true value of the inner problem as a CasADi function of θ alone.

Every evaluation is a design that the judge confirms, with its envelope gradient, or NaN.
"""

import numpy as np

from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.sampling.samples import BandwidthSample
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.casadi_callback import VectorCallback


class TrueBandwidth(VectorCallback):
    """θ -> ω_b*(θ) in rad/s with its envelope gradient; NaN where no design is certified."""

    def __init__(self, sampler: Sampler, label: str) -> None:
        self.sampler, self.label = sampler, label
        self.known: dict[bytes, BandwidthSample] = {}
        count = len(sampler.problem.names)
        super().__init__("true_bandwidth", count, 1, self._value, self._slope)

    def at(self, theta: Array) -> BandwidthSample:
        """The sample at θ; repeated points cost nothing."""
        key = np.asarray(theta, float).tobytes()
        if key not in self.known:
            self.known[key] = self.sampler.bandwidths(theta, self.label)[0]
        return self.known[key]

    def _value(self, theta: Array) -> Array:
        sample = self.at(theta)
        stationary = np.isfinite(sample.gradient).all()
        return np.array([sample.value if stationary else np.nan])

    def _slope(self, theta: Array) -> Array:
        return np.array(self.at(theta).gradient)[None, :]
