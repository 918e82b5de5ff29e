"""A running process group, found by the environment of its processes, which cannot be deleted."""

import contextlib
import os
import shutil
import signal
import time
import xmlrpc.client
from pathlib import Path

from launcher import network
from launcher.supervisor import SOCKET, Supervisor
from launcher.words import Failure

# Set for the processes of the group alone: its private folder.
MARK = "BODYSCHEMA_GROUP"

# supervisord gives a process 10 s to end before it kills it.
ORDERLY_END_S = 15
# Time for processes to end that are asked directly, because supervisord does not answer.
HASTY_END_S = 5


def environment(pid):
    """Environment of one of our own processes at its start; empty for any other."""
    try:
        if os.stat(f"/proc/{pid}").st_uid != os.getuid():
            return {}
        with open(f"/proc/{pid}/environ", "rb") as file:
            entries = file.read().split(b"\0")
    except OSError:
        return {}
    pairs = (os.fsdecode(entry).partition("=") for entry in entries)
    return {name: value for name, _, value in pairs if value}


def processes():
    """Process id → environment of all processes of all our groups."""
    pids = (int(name) for name in os.listdir("/proc") if name.isdigit())
    environments = ((pid, environment(pid)) for pid in pids)
    return {pid: variables for pid, variables in environments if MARK in variables}


def until(condition, limit_s):
    """Asks every 50 ms; returns whether it became true."""
    end = time.monotonic() + limit_s
    while not condition():
        if time.monotonic() > end:
            return False
        time.sleep(0.05)
    return True


class Group:
    def __init__(self, pid, variables):
        self.pid = pid  # of the process that we started: it lives longer than the others
        self.variables = variables
        self.folder = Path(variables[MARK])
        self.run = Path(variables["BODYSCHEMA_RUN"])

    @classmethod
    def find(cls, logs):
        """The group that runs from this folder of logs, or None. Its folders may be gone."""
        found = None
        for pid, variables in processes().items():
            if Path(variables.get("BODYSCHEMA_RUN", "/")).parent != logs:
                continue
            # If supervisord was killed, any process that is left.
            with contextlib.suppress(ProcessLookupError):
                if found is None or os.getsid(pid) == pid:
                    found = cls(pid, variables)
        return found

    def pids(self):
        return [pid for pid, variables in processes().items() if variables[MARK] == self.variables[MARK]]

    def has_ended(self):
        return not self.pids()

    def entered(self, command):
        """The command that runs `command` on the group's network."""
        return network.entered(self.pid, command)

    def was_stopped(self):
        """True after stop(), which marks the folder and then removes it."""
        return (self.folder / "stopped").exists() or not self.folder.exists()

    def stop(self):
        """Ends the group, in order if possible, within some 25 s in any case."""
        # A ./run that follows the group in another shell reads the reason.
        with contextlib.suppress(OSError):
            (self.folder / "stopped").touch()
        try:
            with Supervisor(self.folder / SOCKET, self.pids()) as proxy:
                proxy.supervisor.shutdown()
            until(self.has_ended, ORDERLY_END_S)
        except (OSError, xmlrpc.client.Error):
            # supervisord is gone, frozen, or not ours: the other processes are asked directly.
            self._signal(signal.SIGTERM, *self._workers())
            until(lambda: not self._workers(), HASTY_END_S)
        self._signal(signal.SIGKILL, *self.pids())
        if not until(self.has_ended, HASTY_END_S):
            raise Failure(f"these processes cannot be ended: {' '.join(map(str, self.pids()))}")
        # Atomically, so that the folder is either marked or gone.
        with contextlib.suppress(OSError):
            shutil.rmtree(self.folder.rename(f"{self.folder}.stopped"))

    def _workers(self):
        """All processes except supervisord and the holder of its namespace, whose end would end all others at once."""
        workers = []
        for pid in self.pids():
            with contextlib.suppress(ProcessLookupError):
                # supervisord gives each process that it starts a process group.
                if os.getpgid(pid) != os.getsid(pid):
                    workers.append(pid)
        return workers

    @staticmethod
    def _signal(number, *pids):
        for pid in pids:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, number)
