"""The build tree."""

import contextlib
import fcntl
import os
import shutil
import subprocess
import sys

from launcher import packages
from launcher.words import Failure, say


def num_processors():
    return len(os.sched_getaffinity(0))


def build(place, *targets, preset="release"):
    """Sets up, configures and builds, unless the build is given."""
    if place.is_build_given:
        return
    with alone(place.source):
        configure(place, preset)
        if targets:
            cmake("--build", place.build, "--target", *targets, "-j", num_processors())


@contextlib.contextmanager
def alone(folder):
    """Waits until no other ./run builds in this tree: two Ninjas would spoil each other's record."""
    # NFS locks only a file that can be written.
    held = os.open(folder / ".build.lock", os.O_RDWR | os.O_CREAT, 0o644)
    try:
        try:
            fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            say("another ./run builds here: waiting for it")
            fcntl.flock(held, fcntl.LOCK_EX)
        yield
    finally:
        os.close(held)


def configure(place, preset="release"):
    cache = place.build / "CMakeCache.txt"
    # Once: a build that has looked for Ceres in vain goes on without.
    is_new = not cache.exists() or "Ceres_DIR" not in cache.read_text()
    packages.install(place.source / "config" / "packages.txt", with_optional=is_new)
    # A build folder that was configured elsewhere (a copied or moved checkout) is of no use.
    if cache.exists() and f"CMAKE_HOME_DIRECTORY:INTERNAL={place.source}" not in cache.read_text().splitlines():
        shutil.rmtree(place.build)
    if not (place.build / "build.ninja").exists():
        cmake("-S", place.source, "--preset", preset)


def cmake(*arguments):
    # stdout is for the result.
    if subprocess.run(["cmake", *map(str, arguments)], stdout=sys.stderr).returncode != 0:
        raise Failure("the build failed")
