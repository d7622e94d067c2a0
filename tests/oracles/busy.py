"""How long a test waits for another process: until something happens, never how long it takes.

The machine may be busy. Where a process must end without waiting for its work, that work sleeps
for much longer than this.
"""

HANGS = 300.0  # seconds without what is waited for, after which the other process is taken to hang
