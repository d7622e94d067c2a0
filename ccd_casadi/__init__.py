import sys

if sys.argv[:1] == ["-m"]:  # a command is starting, not a library: its first import is this
    import surrogates as _surrogates  # takes care of Ctrl-C while the rest is imported

    del _surrogates
