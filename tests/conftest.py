"""One BLAS thread: the matrices are small, and figures then repeat to the last digit."""

import os
import signal

# A shell's background job, or a CI runner, may have Ctrl-C ignored, and children inherit that.
# The tests of interrupts are about how commands behave where it is not.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(name, "1")
