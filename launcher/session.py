"""One group from its start to its end, and the programs that follow it."""

import os
import shutil
import signal
import subprocess
import sys
import time

from launcher import network, supervisor
from launcher.group import MARK, Group, until
from launcher.words import Failure, say

START_S = 10
# Summing up takes a moment; a second interrupt ends it.
WATCH_END_S = 60
# Two forged packets end any program of LCM 1.x (lcmtypes/README.md): restarts are bounded, because an attacker may go on sending them.
MAX_WATCH_RESTARTS = 10
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class Interrupted(BaseException):
    """One of SIGNALS came."""


def _interrupt(number, frame):
    raise Interrupted


class Session:
    """`with Session(…)`: a group that this program starts and, unless it is kept, ends.

    `lock`: of run_folder.begin(). `commands`: name → command as in group.conf, where `variables` stand for $NAMEs.
    """

    def __init__(self, place, run, lock, is_private, bus, images, commands, keep=False, **variables):
        self._run, self._lock, self._inode = run, lock, os.stat(run).st_ino
        self._is_private, self._commands, self._keep = is_private, commands, keep
        self._variables = {"BIN": str(place.bin), "LAUNCHER": str(place.source / "launcher"), "RUN": str(run)}
        self._variables |= {"RIG": str(run / "config"), "BUS": bus, "IMAGES": images, **variables}
        self._folder = supervisor.private_folder()
        self._process = None
        self._words = os.memfd_create("stderr")  # on no disk
        self.group = None
        self.is_over = False  # the group ended, or is to end

    def __enter__(self):
        for number in SIGNALS:
            signal.signal(number, _interrupt)
        try:
            self._start()
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_):
        # The rest takes bounded time and must not be cut short.
        for number in SIGNALS:
            signal.signal(number, signal.SIG_IGN)
        if self.group and not self._keep:
            self.group.stop()
        if self._process is None or not self.is_running():
            shutil.rmtree(self._folder, ignore_errors=True)

    def _start(self):
        supervisor.remove_dead_folders()
        supervisor.write_files(self._folder, self._commands)
        command = ["supervisord", "-n", "-c", str(self._folder / "supervisord.conf")]
        if self._is_private:
            command = network.in_private_namespace(command)
        if not self._keep:
            # The group ends with this program, however that ends. (unshare ignores SIGTERM; killed, it ends its namespace.)
            command = ["setpriv", "--pdeathsig", "KILL" if self._is_private else "TERM", *command]
        variables = {name: value for name, value in os.environ.items() if not name.startswith("BODYSCHEMA_")}
        variables |= {f"BODYSCHEMA_{name}": value for name, value in self._variables.items()}
        variables |= {"LCM_DEFAULT_URL": self._variables["BUS"], MARK: str(self._folder)}
        with open(self._run / "supervisord.log", "ab") as log:
            self._process = subprocess.Popen(
                command,
                env=variables,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=self._words,
                start_new_session=True,
                pass_fds=[self._lock],
            )
        self.group = Group(self._process.pid, variables)
        until(lambda: self._listens() or not self.is_running(), START_S)
        if not self._listens():
            raise Failure(f"the process group did not start; see {self._run}{self._last_words()}")
        (self._run / "socket").write_text(f"{self.socket}\n")

    @property
    def socket(self):
        return self._folder / supervisor.SOCKET

    def is_running(self):
        return self._process.poll() is None

    def _has_folder(self):
        try:
            return os.stat(self._run).st_ino == self._inode
        except OSError:
            return False

    def _listens(self):
        try:
            supervisor.connect(self.socket).close()
            return True
        except OSError:
            return False

    def _last_words(self):
        text = os.pread(self._words, 1 << 16, 0).decode(errors="replace").strip()
        return f"\n{text}" if text else ""

    def watch(self, command, may_restart=True):
        """Runs `command` on the group's bus to its end; returns its exit code, 1 if the group ended before it."""
        for restarts in range(MAX_WATCH_RESTARTS + 1):
            watch = subprocess.Popen(
                self.group.entered(["setpriv", "--pdeathsig", "TERM", *command]),
                env=os.environ | {"BODYSCHEMA_RUN": str(self._run)},
            )
            try:
                self._wait(watch)
            except Interrupted:
                self.is_over = True
                return self._end(watch)
            if self.is_over:
                self._end(watch)
                return 1
            if watch.returncode >= 0:
                return watch.returncode
            if not may_restart or restarts == MAX_WATCH_RESTARTS:
                break
            _tell(f"what follows the group was ended by {_signal_name(-watch.returncode)}; it is started again")
            time.sleep(1)
        _tell(f"what follows the group was ended by {_signal_name(-watch.returncode)}")
        return 1

    def wait(self):
        """Waits until the group is ended; returns 1 if it died, else 0."""
        try:
            return self._wait()
        except Interrupted:
            self.is_over = True
            return 0

    def _wait(self, watch=None):
        """Waits until `watch` or the group ended; reports the latter, and returns 1 if the group was not stopped."""
        while True:
            if watch and watch.poll() is not None:
                return 0
            if not self.is_running():
                self.is_over = True
                return self._tell_of_the_end()
            if not self._has_folder():
                self.is_over = True
                self._keep = False
                _tell(f"the folder of this run was deleted: {self._run}; the group is stopped")
                return 1
            time.sleep(0.1)

    def _tell_of_the_end(self):
        if self.group.was_stopped():
            _tell("the group was stopped from elsewhere (./run stop)")
            return 0
        code = self._process.returncode
        if code == 0:
            _tell("the group ended")
            return 0
        # Exit code as a shell gives it for a killed child; unshare ends as its child did.
        number = -code if code < 0 else code - 128
        how = f"by {_signal_name(number)}" if number > 0 else f"with exit code {code}"
        _tell(f"the process group ended {how}; see {self._run}/supervisord.log{self._last_words()}")
        return 1

    def _end(self, watch):
        """Sums up the result so far, if the run's folder still exists."""
        watch.send_signal(signal.SIGTERM if self._run.exists() else signal.SIGKILL)
        try:
            return watch.wait(WATCH_END_S)
        except (subprocess.TimeoutExpired, Interrupted):
            watch.kill()
            return 1


def _tell(text):
    # The line of progress has no line end yet.
    say(("\n" if sys.stderr.isatty() else "") + "run: " + text)


def _signal_name(number):
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"
