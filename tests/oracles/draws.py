"""How many examples a property test draws; in a study HYPOTHESIS_TIMES times as many."""

import os

from hypothesis import settings

TIMES = int(os.environ.get("HYPOTHESIS_TIMES", "1"))


def few(max_examples: int) -> settings:
    """What else holds is the profile's, see conftest.py."""
    return settings(max_examples=TIMES * max_examples)
