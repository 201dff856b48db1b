"""The one exception that bad input raises."""


class InputError(ValueError):
    """Input that cannot be used; the message names file, field, value and what was wanted.

    The command line turns it into one line on standard error and exit code 2.
    """
