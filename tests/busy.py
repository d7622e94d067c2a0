"""What is prompt on a machine that others use too."""

import subprocess
import sys
import time


def prompt(seconds: float = 2.0) -> float:
    """`seconds` of an idle machine here and now, by the start of a Python: 0.05 s where idle.

    Measured after what is judged, under the same load; never less than `seconds`.
    """
    began = time.monotonic()
    subprocess.run([sys.executable, "-S", "-c", ""], check=True)
    return seconds * max(1.0, (time.monotonic() - began) / 0.05)
