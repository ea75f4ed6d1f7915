"""What a user got wrong, told in one line."""


class UserError(ValueError):
    """A mistake in what the user gave: a setting, a file, a name.

    The message is one line: what is wrong, where, and what would be right.
    The command line prints it without a traceback and exits with code 2.
    """


def require(condition: bool, message: str) -> None:
    """Raises UserError(message) unless the condition holds."""
    if not condition:
        raise UserError(message)
