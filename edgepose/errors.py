"""The one exception that the command line turns into a line on stderr and exit code 1."""


class EdgeposeError(Exception):
    """Bad input or a broken device.

    The message is for the user: what is wrong, where (file, row, sensor, byte), and what to do. It has no
    trailing full stop and no line break.
    """
