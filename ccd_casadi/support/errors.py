"""The base of every error that a user can cause and mend, and its one line."""


class UserError(ValueError):
    """One line that says what is wrong and what to change; commands print it and exit with 2."""


class PlantError(UserError):
    """A model returned something that is no plant; the message says what and how to mend it."""


def described(error: BaseException) -> str:
    """The kind and the words of an exception of somebody else's code, which may have none."""
    try:
        return f"{type(error).__name__}: {error}"
    except Exception:
        return type(error).__name__
