"""Importing this loads the kernels, if they are compiled: 0.4 s of a processor that processes which
are forked afterwards need not spend."""

from ccd_casadi.kernels.compilation import PARTS, compile_part, is_compiled

if is_compiled():
    for part in PARTS:
        compile_part(part)
