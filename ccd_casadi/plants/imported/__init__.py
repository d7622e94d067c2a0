"""Plants from finite-element programs: modal tables, matrices at samples, and results files.

Matrices and results become one modal table; the table, interpolated over θ, becomes the plant.
"""
