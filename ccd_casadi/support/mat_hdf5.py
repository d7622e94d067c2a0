"""MATLAB 7.3 files, which are HDF5, as `scipy.io.loadmat` would give them: by h5py."""

from pathlib import Path
from typing import Any

import numpy as np
from scipy.sparse import csc_array

from ccd_casadi.support.errors import UserError, described, require


def hdf5_variables(path: Path) -> dict[str, Any]:
    """Read the variables of a MATLAB 7.3 file.

    Parameters
    ----------
    path : Path

    Returns
    -------
    dict of str to array
        Structs as arrays of shape (1, 1) with named fields, texts as arrays of one text, cells as
        arrays of objects, sparse matrices as such.

    Raises
    ------
    UserError
        h5py is not installed, or the file cannot be read.
    """
    h5py = require("h5py", "hdf5")
    try:
        with h5py.File(path, "r") as file:
            return {name: _value(file, file[name]) for name in file if not name.startswith("#")}
    except Exception as error:  # a damaged file fails anywhere inside the reader
        words = " ".join(described(error).split())[:120]
        raise UserError(f"{path}: is not a readable MATLAB 7.3 file: {words}") from None


def _value(file: Any, item: Any) -> Any:
    if hasattr(item, "keys"):  # a group: a struct, or a sparse matrix
        if "MATLAB_sparse" in item.attrs:
            return _sparse(item)
        fields = {name: _value(file, item[name]) for name in item}
        made = np.empty((1, 1), [(name, object) for name in fields])
        for name, value in fields.items():
            made[name][0, 0] = value
        return made
    kind = item.attrs.get("MATLAB_class", b"")
    kind = kind.decode() if isinstance(kind, bytes) else str(kind)
    own = item[()]
    if item.attrs.get("MATLAB_empty", 0):
        return np.zeros(tuple(int(n) for n in np.ravel(own)))
    if kind == "char":
        return np.array(["".join(map(chr, np.ravel(own)))])
    if own.dtype == object:  # references: a cell, or an array of structs
        found = np.empty(own.shape, object)
        for place in np.ndindex(own.shape):
            found[place] = _value(file, file[own[place]])
        return found.T
    if own.dtype.names == ("real", "imag"):
        own = own["real"] + 1j * own["imag"]
    return np.asarray(own).T  # MATLAB's columns are HDF5's rows


def _sparse(item: Any) -> csc_array:
    starts = item["jc"][()]
    shape = int(item.attrs["MATLAB_sparse"]), len(starts) - 1
    if "data" not in item:
        return csc_array(shape)
    return csc_array((item["data"][()], item["ir"][()], starts), shape=shape)
