"""Optimisation that knows no plant."""
