"""Synthesis back ends behind one narrow interface, each certified by the same certificate.

`riccati` is the package's own and serves stable plants in mixed sensitivity; `slicot` (SB10AD)
serves any standard plant and is optional. `benchmarks/lmi.py` is a third one.
"""
