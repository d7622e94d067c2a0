"""Synthesis back ends behind one narrow interface, each certified by the same certificate.

`riccati` is the package's own and serves stable plants in mixed sensitivity; `slicot` (SB10AD)
and `lmi` (cvxpy with Clarabel) serve any standard plant and are optional.
"""
