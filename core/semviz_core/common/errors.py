"""SemvizError, the error whose message a user reads."""

from importlib.util import find_spec


class SemvizError(Exception):
    """Bad input: the message says in one line what is wrong, where, and what to do.

    The command line prints it and exits with status 2; the pages show it as it is.
    """


def file_error_text(error: OSError) -> str:
    """Return what the system says of a file, for example no permission, or a full disk."""
    where = "" if error.filename is None else f"{error.filename}: "
    return f"{where}{error.strerror or error}"


def require_extra(what: str, library: str, extra: str) -> None:
    """Raise SemvizError if ``library``, which ``what`` needs, is not installed.

    The message names the extra of semviz that installs it. Nothing is imported.
    """
    if find_spec(library) is None:
        raise SemvizError(f"{what} needs {library}: pip install 'semviz[{extra}]'")
