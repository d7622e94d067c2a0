"""Controllers of fixed structure for sets of plants, continuous or sampled.

Its names are imported when they are first used: the bounds of a loop load no search.
"""

from surrogates.lazy_names import from_stub

__all__ = from_stub(__name__)
