"""supervisord (Debian's supervisor): its configuration, and calls to it.

It writes to no disk once it runs: what it says goes to stdout, and each process writes its own log. So a full disk costs
words, and no process.
"""

import http.client
import os
import re
import shlex
import shutil
import socket
import struct
import tempfile
import time
import xmlrpc.client
from pathlib import Path

FOLDER_PREFIX = "bodyschema-"
SOCKET = "supervisor.sock"

# A failed process is restarted, a stopped one is not. One that ended within a second of its start is restarted after
# 1, 2, 3 … s: a wrong configuration does not spin, and a process that is killed often and fast comes back
# (startretries: never give up).
CONFIGURATION = """\
[supervisord]
nodaemon=true
logfile=/dev/null
logfile_maxbytes=0
pidfile=%(here)s/supervisord.pid

[unix_http_server]
file=%(here)s/supervisor.sock

[rpcinterface:supervisor]
supervisor.rpcinterface_factory=supervisor.rpcinterface:make_main_rpcinterface

[supervisorctl]
serverurl=unix://%(here)s/supervisor.sock

[group:bodyschema]
programs={names}
"""
PROGRAM = """
[program:{name}]
command=sh %(here)s/{name}
redirect_stderr=true
stdout_logfile=NONE
autorestart=unexpected
startretries=100000
"""
# setpriv ends a process when supervisord dies.
SCRIPT = """\
exec >>"$BODYSCHEMA_RUN"/{log} 2>&1
exec setpriv --pdeathsig TERM {command}
"""


def private_folder():
    """A new folder of the user's own, for supervisord's files and socket.

    Its path needs no quotes and leaves room for the socket's name, which has at most 107 characters.
    """
    place = tempfile.gettempdir()
    if not re.fullmatch(r"[\w./-]{1,60}", place, re.ASCII):
        place = "/tmp"
    return Path(tempfile.mkdtemp(prefix=FOLDER_PREFIX, dir=place))


def write_files(folder, commands):
    """Writes the files of `supervisord -c folder/supervisord.conf`; `commands`: name → command as in group.conf."""
    text = CONFIGURATION.replace("{names}", ",".join(commands))
    for name, command in commands.items():
        text += PROGRAM.replace("{name}", name)
        (folder / name).write_text(script(name, command))
    (folder / "supervisord.conf").write_text(text)


def script(name, command):
    """The shell script that becomes a process of the group; its $NAMEs are in the environment as BODYSCHEMA_NAME."""
    command = re.sub(r"\$(\{?)([A-Z_]+)", r"$\1BODYSCHEMA_\2", command)
    return SCRIPT.format(log=shlex.quote(f"{name}.log"), command=command)


def remove_dead_folders():
    """Folders of groups that were killed: they are ours, and no supervisord answers.

    The youngest may be of a group that is just starting.
    """
    for folder in private_folder_candidates():
        try:
            status = folder.lstat()
            if status.st_uid == os.getuid() and time.time() - status.st_mtime > 60:
                connect(folder / SOCKET).close()
        except (ConnectionRefusedError, FileNotFoundError):
            shutil.rmtree(folder, ignore_errors=True)
        except OSError:
            pass


def private_folder_candidates():
    return [folder for place in {tempfile.gettempdir(), "/tmp"} for folder in Path(place).glob(FOLDER_PREFIX + "????????")]


def connect(path, timeout_s=3):
    connection = socket.socket(socket.AF_UNIX)
    try:
        connection.settimeout(timeout_s)
        connection.connect(str(path))
    except OSError:
        connection.close()
        raise
    return connection


class Stranger(OSError):
    """Another program than our supervisord listens there."""


class Supervisor(xmlrpc.client.ServerProxy):
    """supervisord's own interface (XML-RPC over its socket), after a check which program answers.

    `pids`: the processes of the group. A call takes at most 3 s, else it throws OSError.
    """

    def __init__(self, path, pids):
        super().__init__("http://localhost", transport=_UnixTransport(path, pids))


class _UnixTransport(xmlrpc.client.Transport):
    def __init__(self, path, pids):
        super().__init__()
        self._path, self._pids = path, pids

    def make_connection(self, host):
        self._connection = host, _UnixConnection(self._path, self._pids)
        return self._connection[1]


class _UnixConnection(http.client.HTTPConnection):
    def __init__(self, path, pids):
        super().__init__("localhost")
        self._path, self._pids = path, pids

    def connect(self):
        self.sock = connect(self._path)
        pid, uid, _ = struct.unpack("iII", self.sock.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12))
        if uid != os.getuid() or pid not in self._pids:
            self.close()
            raise Stranger(f"{self._path}: process {pid} of user {uid} listens there, not this group's supervisord")
