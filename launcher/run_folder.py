"""A folder for a run, in the folder of all runs, from which one group runs at a time."""

import contextlib
import fcntl
import os
import shutil
import time

from launcher.group import Group
from launcher.words import Failure


def lock(logs):
    """Takes the lock of a folder of runs; None if it is taken. The group inherits it and holds it as long as it lives."""
    file = os.open(logs / ".lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(file)
        return None
    return file


def is_locked(logs):
    """True if a group runs from this folder, also another user's."""
    with contextlib.suppress(FileNotFoundError), open(logs / ".lock", "rb") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
    return False


def begin(place, rig):
    """A new run with a copy of the rig, and the lock; nothing else may run from there."""
    logs = place.logs
    try:
        logs.mkdir(parents=True, exist_ok=True)
        held = lock(logs)
    except OSError as error:
        raise Failure(f"cannot write into {logs}: {error.strerror}") from None
    # The lock may have been deleted with the folder.
    group = Group.find(logs)
    if held is None or group:
        if group:
            raise Failure(f"a group runs already, from {group.run}; stop it with ./run stop")
        raise Failure("a group runs here already: it just begins, sums up its run, or is another user's; try again in some seconds")
    while True:
        run = logs / time.strftime("%Y%m%d-%H%M%S")
        try:
            run.mkdir()
            break
        except FileExistsError:
            time.sleep(1)
    shutil.copytree(rig, run / "config")
    link = logs / ".current"
    with contextlib.suppress(FileNotFoundError):
        link.unlink()
    link.symlink_to(run)
    link.rename(place.current)
    return run, held


def tell_ideal_noise(run):
    """`./run --ideal`: tags and lens are exactly as the files say; tells the processes so."""
    ideal = run / "config" / "ideal_noise.yaml"
    if ideal.exists():
        ideal.replace(run / "config" / "noise.yaml")


def differences(recorded, rig):
    """Names of the YAML files in which the configuration of a recorded run differs from a rig's folder."""
    # A run with --ideal has noise.yaml from ideal_noise.yaml.
    names = {file.name for folder in (recorded, rig) for file in folder.glob("*.yaml")} - {"ideal_noise.yaml"}

    def text(folder, name):
        file = folder / name
        return file.read_bytes() if file.exists() else None

    return sorted(name for name in names if text(recorded, name) != text(rig, name))
