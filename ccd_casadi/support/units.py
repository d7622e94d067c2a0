"""Units: SI inside, and the one factor that is everywhere."""

import math

HZ = 2.0 * math.pi  # rad/s in one hertz
