"""Sampling on a Dask cluster."""

from ccd_casadi.support.extensions import Extension

EXTENSION = Extension(functions={"cluster": "ccd_casadi.extensions.cluster.dask_pool:Cluster"})
