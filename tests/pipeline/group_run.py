"""What tests of a whole group share: `TEST.py SOURCE BUILD` gives ./run a folder for logs of its own, and stops its group at the end."""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

source, build = Path(sys.argv[1]), Path(sys.argv[2])


class Failed(Exception):
    pass


def environment(work):
    """Of a ./run with logs in a folder."""
    return os.environ | {"BODYSCHEMA_BUILD": str(build), "BODYSCHEMA_LOGS": str(work / "logs")}


def run(work, *words, codes=(0,)):
    """What ./run says on stdout and stderr."""
    done = subprocess.run(
        [source / "run", *map(str, words)], env=environment(work), stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=250
    )
    if done.returncode not in codes:
        raise Failed(f"./run {' '.join(map(str, words))}: {done.stdout[-2000:]} {done.stderr[-2000:]}")
    return done.stdout, done.stderr


def in_a_folder(main):
    """main(folder), whose name has blanks, as a test that may be skipped; a group that it keeps is stopped."""
    if subprocess.run(["unshare", "--user", "--map-root-user", "--net", "true"], capture_output=True).returncode != 0:
        print("SKIP: this machine allows no network namespaces", file=sys.stderr)
        sys.exit(77)
    with tempfile.TemporaryDirectory(prefix=f"{Path(sys.argv[0]).stem} ".replace("_", " ")) as folder:
        try:
            main(Path(folder))
        except Failed as failure:
            sys.exit(str(failure))
        finally:
            run(Path(folder), "stop", codes=(0, 1, 2))
