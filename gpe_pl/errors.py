"""The base of all errors that a user can act on; entry points print them in one line, without a traceback."""


class GpeError(Exception):
    """The message names what is wrong and what to do."""
