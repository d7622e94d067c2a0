"""Certified H∞ synthesis at one (θ, ω_S, ω_T), its figures and total derivatives."""
