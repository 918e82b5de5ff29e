"""Debian packages."""

import os
import shutil
import subprocess
import sys

from launcher.words import Failure, say


def listed(file, optional=False):
    """Names in a packages*.txt: those that are needed, or those whose line says "# optional"."""
    lines = (line.partition("#") for line in file.read_text().splitlines())
    return [name.strip() for name, _, remark in lines if name.strip() and remark.strip().startswith("optional") == optional]


def is_installed(package):
    query = ["dpkg-query", "-W", "-f", "${db:Status-Status}", package]
    return subprocess.run(query, capture_output=True, text=True).stdout == "installed"


def install(file, with_optional=False):
    """Installs the missing packages of a packages*.txt. Without the optional ones it goes on."""
    install_missing(listed(file))
    if with_optional:
        try:
            install_missing(listed(file, optional=True))
        except Failure as failure:
            say(f"{failure}; going on without")


def install_missing(names):
    missing = [package for package in names if not is_installed(package)]
    if not missing:
        return
    say("installing from Debian:", *missing)
    sudo = []
    if os.getuid() != 0:
        if not shutil.which("sudo"):
            raise Failure("these packages are missing and there is no sudo; as root: apt-get install " + " ".join(missing))
        sudo = ["sudo"]
    if subprocess.run([*sudo, "apt-get", "update", "-qq"], stdout=sys.stderr).returncode != 0:
        say("apt-get update failed; trying with the old lists")
    command = ["env", "DEBIAN_FRONTEND=noninteractive", "apt-get", "install", "-y", "-qq", "--no-install-recommends"]
    if subprocess.run([*sudo, *command, *missing], stdout=sys.stderr).returncode != 0:
        raise Failure("apt-get could not install: " + " ".join(missing))
