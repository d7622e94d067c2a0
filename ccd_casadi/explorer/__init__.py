"""The explorer: what its sliders say, the certified designs there, their curves, and the page.

Everything but `page` and `server` is free of any server library.
"""
