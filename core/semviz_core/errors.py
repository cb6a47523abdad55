"""The one error that people are meant to read."""


class SemvizError(Exception):
    """Bad input: the message says in one line what is wrong, where, and what to do.

    The command line prints it and exits with status 2; the pages show it as it is.
    """
