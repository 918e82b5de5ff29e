"""Messages to the user, on stderr."""

import sys


class Failure(Exception):
    """Ends `./run` with this message and exit code 1."""


class UsageError(Failure):
    """The same with exit code 2: wrong usage."""


def say(*words):
    print(*words, file=sys.stderr, flush=True)
