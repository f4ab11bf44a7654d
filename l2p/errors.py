"""The errors that the command line prints as one sentence: those that are the user's to mend, and lost processes."""


class InputError(ValueError):
    """Input that cannot be used: the message says what came, what was expected and what to do."""


class LostProcessError(RuntimeError):
    """Another process that shares the work has ended before it was done."""


def sentence(error: Exception) -> str:
    """What an error says, in one line; the system's own errors say a number and a name, so they are put into words."""
    said = str(error)
    if isinstance(error, OSError) and error.strerror is not None:
        reason = error.strerror.lower()
        said = reason if error.filename is None else f"{error.filename}: {reason}"
    return " ".join(said.split())
