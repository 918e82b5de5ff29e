"""./run, in Python."""

import os
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from launcher import commands  # noqa: E402
from launcher.place import Place  # noqa: E402
from launcher.session import Interrupted  # noqa: E402
from launcher.words import Failure, UsageError, say  # noqa: E402


def main():
    # The console's hints repeat the command that the user typed.
    os.environ["BODYSCHEMA_COMMAND"] = "./run"
    try:
        return commands.run(Place.from_environment(), sys.argv[1:])
    except Failure as failure:
        say(f"run: {failure}")
        return 2 if isinstance(failure, UsageError) else 1
    except OSError as error:
        say(f"run: {error}")
        return 1
    except (KeyboardInterrupt, Interrupted):
        return 130


sys.exit(main())
