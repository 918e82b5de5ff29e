"""Network namespaces, and the way out of this machine."""

import os
import subprocess

from launcher.words import Failure, say

# Its arguments are a command. The shell stays process 1 of the namespace.
PREPARE = 'ip link set lo up multicast on && ip route add 224.0.0.0/4 dev lo && "$@"'


def in_private_namespace(command):
    """The command that runs `command` on a network of its own; its children end with it."""
    user = ["--user", "--map-root-user"]
    if subprocess.run(["unshare", *user, "--net", "true"], capture_output=True).returncode != 0:
        if os.getuid() != 0:
            raise Failure("this machine forbids user namespaces: run as root, or set 'network: host' in the rig's network.yaml")
        user = []
    namespaces = ["--net", "--pid", "--fork", "--kill-child", "--mount-proc"]
    return ["unshare", *user, *namespaces, "sh", "-c", PREPARE, "sh", *command]


def entered(pid, command):
    """The command that runs `command` on the network of process `pid`."""

    def is_shared(namespace):
        return os.readlink(f"/proc/{pid}/ns/{namespace}") == os.readlink(f"/proc/self/ns/{namespace}")

    if is_shared("net"):
        return list(command)
    if is_shared("user"):
        return ["nsenter", "-t", str(pid), "-n", *command]
    return ["nsenter", "-t", str(pid), "-U", "-n", "--preserve-credentials", *command]


def check_route():
    """Other hosts hear us only if multicast leaves by an interface."""
    route = subprocess.run(["ip", "-o", "route", "get", "239.255.76.67"], capture_output=True, text=True).stdout.split()
    device = route[route.index("dev") + 1] if "dev" in route else None
    if device in (None, "lo"):
        raise Failure(
            f"multicast does not leave this machine ({device or 'no route'}); type: ip route replace 224.0.0.0/4 dev INTERFACE"
        )
    say("the bus goes over", device)
