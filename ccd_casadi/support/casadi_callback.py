"""A numeric function of one vector, with its Jacobian, as a casadi.Function for any nlpsol."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import casadi as ca
import numpy as np

from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import ctrl_c_pending

Map = Callable[[Array], Array]


class _Dense(ca.Callback):
    """The first of some inputs -> a dense output."""

    def __init__(
        self, name: str, inputs: Sequence[ca.Sparsity], output: ca.Sparsity,
        values: Map, options: Mapping[str, Any],
    ) -> None:  # fmt: skip
        ca.Callback.__init__(self)
        self._inputs, self._output, self._values = inputs, output, values
        self.construct(name, options)

    def get_n_in(self) -> int:
        return len(self._inputs)

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        return self._inputs[i]

    def get_sparsity_out(self, i: int) -> ca.Sparsity:
        return self._output

    def eval(self, arguments: Sequence[ca.DM]) -> list[Array]:
        return [self._values(np.array(arguments[0]).ravel())]


class VectorCallback(_Dense):
    """A numeric function x (n,) -> values (m,) with its Jacobian, as a casadi.Function.

    CasADi holds no reference to it: keep one while it is in use. NaN values make IPOPT shorten its
    step. Without `hessians` a quasi-Newton method is to be used.

    Parameters
    ----------
    name : str
    inputs, outputs : int
        n and m.
    values, jacobian : callable
        x (n,) -> (m,), and (m, n).
    hessians : bool
        Whether CasADi may take central differences of the Jacobian; x is then of the order of 1.
    """

    def __init__(
        self, name: str, inputs: int, outputs: int, values: Map, jacobian: Map,
        hessians: bool = False,
    ) -> None:  # fmt: skip
        column, out = (ca.Sparsity.dense(size, 1) for size in (inputs, outputs))
        super().__init__(name, [column], out, values, {})
        self._sizes, self._jacobian, self._hessians = (outputs, inputs), jacobian, hessians
        self._derivative: ca.Callback | None = None

    def eval(self, arguments: Sequence[ca.DM]) -> list[Array]:
        if ctrl_c_pending():  # NaN ends IPOPT quickly; the interrupt is raised when it has returned
            return [np.full(self._sizes[0], np.nan)]
        return super().eval(arguments)

    def has_jacobian(self) -> bool:
        return True

    def get_jacobian(
        self, name: str, inames: Sequence[str], onames: Sequence[str], options: Mapping[str, Any]
    ) -> ca.Function:
        more = {"enable_fd": True, "fd_method": "central"} if self._hessians else {}
        inputs = [*self._inputs, ca.Sparsity(self._sizes[0], 1)]  # of its own output none is used
        self._derivative = _Dense(
            name, inputs, ca.Sparsity.dense(*self._sizes), self._jacobian, {**options, **more}
        )
        return self._derivative
