"""A numeric function of one vector, with its Jacobian, as a casadi.Function for any nlpsol."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import casadi as ca
import numpy as np

from ccd_casadi.support.arrays import Array
from ccd_casadi.support.interrupts import pending


class VectorCallback(ca.Callback):
    """x (n,) -> values (m,) and ∂values (m, n); keep a reference to it while it is in use.

    NaN values make IPOPT shorten its step. Hessians are not available, and a quasi-Newton method is
    to be used, unless x is of the order of 1 and `hessians` asks for CasADi's central differences
    of the Jacobian.
    """

    def __init__(
        self,
        name: str,
        inputs: int,
        outputs: int,
        values: Callable[[Array], Array],
        jacobian: Callable[[Array], Array],
        hessians: bool = False,
    ) -> None:
        ca.Callback.__init__(self)
        self._sizes, self._hessians = (inputs, outputs), hessians
        self._values, self._jacobian = values, jacobian
        self._derivative: ca.Callback | None = None
        self.construct(name, {})

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
        return [self._values(np.array(arguments[0]).ravel())]

    def has_jacobian(self) -> bool:
        return True

    def get_jacobian(
        self, name: str, inames: Sequence[str], onames: Sequence[str], options: Mapping[str, Any]
    ) -> ca.Function:
        more = {"enable_fd": True, "fd_method": "central"} if self._hessians else {}
        self._derivative = _Jacobian(name, self._sizes, self._jacobian, {**options, **more})
        return self._derivative


class _Jacobian(ca.Callback):
    def __init__(
        self,
        name: str,
        sizes: tuple[int, int],
        values: Callable[[Array], Array],
        options: Mapping[str, Any],
    ) -> None:
        ca.Callback.__init__(self)
        self._sizes, self._values = sizes, values
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
        return [self._values(np.array(arguments[0]).ravel())]
