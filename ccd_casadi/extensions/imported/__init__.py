"""Plants from finite-element programs: modal tables, matrices at samples, and results files.

Matrices and results become one modal table; the table, interpolated over θ, becomes the plant.
"""

from ccd_casadi.support.extensions import Extension

EXTENSION = Extension(
    commands={
        "imported": (
            "ccd_casadi.extensions.imported.imported_command",
            "make a modal table from result files; also: ccd import",
        )
    },
    plants={
        "modal_table": "ccd_casadi.extensions.imported.sampled_plant:MODAL_TABLE",
        "sampled_matrices": "ccd_casadi.extensions.imported.sampled_plant:SAMPLED_MATRICES",
    },
)
