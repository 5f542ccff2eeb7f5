"""The one exception that a user sees as a single line."""


class DataError(Exception):
    """Something that the user gave is wrong; the message names the file and the remedy in one line.

    ``cli.py`` prints it as ``mgavatar: <message>`` and exits with 1.
    """
