"""The base of every error that a user can cause and mend."""


class UserError(ValueError):
    """One line that says what is wrong and what to change; commands print it and exit with 2."""
