"""The base of every error that a user can cause and mend, and its one line."""

LONGEST = 1000  # characters of a line: somebody else's message in it may have millions


class UserError(ValueError):
    """One line that says what is wrong and what to change; commands print it and exit with 2."""


class PlantError(UserError):
    """A model returned something that is no plant; the message says what and how to mend it."""


def one_line(value: object) -> str:
    """Any text on one line: what a terminal would obey is escaped, a long middle left out."""
    words = " ".join(str(value).split())
    if len(words) > LONGEST:
        words = f"{words[: LONGEST - 200]} ... {words[-150:]}"
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in words)


def described(error: BaseException) -> str:
    """The kind and the words of an exception of somebody else's code, which may have none."""
    try:
        return f"{type(error).__name__}: {error}"
    except Exception:
        return type(error).__name__
