"""Importing this loads the kernels of structured loops, if they are compiled, and what Numba needs
for any: 0.25 s of a processor that processes which are forked afterwards need not spend."""

from ccd_casadi.kernels.compilation import GROUPS, compile_part, is_compiled

if is_compiled("loops"):
    for part in GROUPS["loops"]:
        compile_part(part)
