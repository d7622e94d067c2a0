"""MATLAB's .mat files of version 5, read without trusting what is in them."""

from pathlib import Path
from typing import Any

import scipy

from ccd_casadi.support.errors import UserError


def mat_variables(path: Path) -> dict[str, Any]:
    """What a .mat file holds by name. Raises UserError where it cannot be read."""
    try:
        with path.open("rb") as stream:
            return dict(scipy.io.loadmat(stream))
    except FileNotFoundError:
        raise UserError(f"{path}: there is no such file") from None
    except OSError as error:
        raise UserError(f"{path}: cannot be read: {error.strerror or error}") from None
    except NotImplementedError:  # how SciPy refuses the HDF5 files of MATLAB 7.3
        raise UserError(f"{path}: is a MATLAB 7.3 file; write it with save(…, '-v7')") from None
    except Exception as error:  # a damaged file fails anywhere inside the reader
        words = " ".join(str(error).split())[:120]
        raise UserError(f"{path}: is not a readable .mat file: {words}") from None
