"""A numeric function of one vector, with its Jacobian, as a casadi.Function for any nlpsol."""

from collections.abc import Mapping, Sequence
from typing import Any

import casadi as ca
import numpy as np

from ccd_casadi.interrupts import pending
from ccd_casadi.plant import Array


class VectorCallback(ca.Callback):
    """x (n,) -> values (m,) and ∂values (m, n); keep a reference to it while it is in use.

    Subclasses give `values` and `jacobian_at`, and call `set_up` at the end of their __init__.
    Hessians are not available: use a quasi-Newton method.
    """

    def set_up(self, name: str, inputs: int, outputs: int) -> None:
        """Make it a casadi function of these sizes."""
        self._sizes = inputs, outputs
        self._jacobian: ca.Callback | None = None
        self.construct(name, {})

    def values(self, x: Array) -> Array:
        """(m,) values; NaN makes IPOPT shorten its step."""
        raise NotImplementedError

    def jacobian_at(self, x: Array) -> Array:
        """(m, n) derivatives."""
        raise NotImplementedError

    def get_n_in(self) -> int:
        return 1

    def get_n_out(self) -> int:
        return 1

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        return ca.Sparsity.dense(self._sizes[0], 1)

    def get_sparsity_out(self, i: int) -> ca.Sparsity:
        return ca.Sparsity.dense(self._sizes[1], 1)

    def eval(self, arguments: Sequence[ca.DM]) -> list[Array]:
        if pending():  # NaN ends IPOPT quickly; the interrupt is raised when it has returned
            return [np.full(self._sizes[1], np.nan)]
        return [self.values(np.array(arguments[0]).ravel())]

    def has_jacobian(self) -> bool:
        return True

    def get_jacobian(
        self, name: str, inames: Sequence[str], onames: Sequence[str], options: Mapping[str, Any]
    ) -> ca.Function:
        self._jacobian = _Jacobian(self, name, options)
        return self._jacobian


class _Jacobian(ca.Callback):
    def __init__(self, parent: VectorCallback, name: str, options: Mapping[str, Any]) -> None:
        ca.Callback.__init__(self)
        self._parent = parent
        self._sizes = parent._sizes
        self.construct(name, options)

    def get_n_in(self) -> int:
        return 2

    def get_n_out(self) -> int:
        return 1

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        inputs, outputs = self._sizes
        return ca.Sparsity.dense(inputs, 1) if i == 0 else ca.Sparsity(outputs, 1)

    def get_sparsity_out(self, i: int) -> ca.Sparsity:
        inputs, outputs = self._sizes
        return ca.Sparsity.dense(outputs, inputs)

    def eval(self, arguments: Sequence[ca.DM]) -> list[Array]:
        return [self._parent.jacobian_at(np.array(arguments[0]).ravel())]
