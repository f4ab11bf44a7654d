"""The errors that are the user's to mend: the command line prints them as one sentence and exits with 2."""


class InputError(ValueError):
    """Input that cannot be used: the message says what came, what was expected and what to do."""
