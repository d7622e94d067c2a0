"""`python -m ccd_casadi.kernels` compiles every kernel into the cache on disk."""

import time

from ccd_casadi.kernels.compilation import ensure_compiled

if __name__ == "__main__":
    start = time.perf_counter()
    ensure_compiled()
    print(f"kernels compiled, or on disk already: {time.perf_counter() - start:.1f} s")
