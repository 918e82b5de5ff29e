"""A build whose programs are scripts, for groups that start in a moment and do as they are told."""

import os
import shutil
import subprocess
import sys
import tempfile
import unittest
from pathlib import Path

SOURCE = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(SOURCE))

from launcher.group import Group, until  # noqa: E402

# `watch` ends when there is a file `learned` in the run's folder; on SIGTERM it says so and fails.
CONSOLE = """\
import os, signal, sys, time
word, *rest = sys.argv[1:]
if word == "--help":
    print("A console\\n\\nSubcommands:\\n  learn  …\\n  halt  …\\n  target  …\\n  follow  …\\n  where  …\\n  hold  …\\n  release  …\\n  resume  …\\n  fault  …")
elif word == "--version":
    print("bodyschema 1.2.3")
elif "--help" in rest:
    print(word, *rest)
elif word == "rig":
    names = rest[rest.index("--group") + 1:] if "--group" in rest else []
    print(os.environ.get("FAKE_NETWORK", "private"), "udpm://239.255.76.67:7667?ttl=0", "udpm://239.255.76.67:7668?ttl=0",
          os.environ.get("FAKE_HOST", "all"), *names)
elif word == "watch":
    def end(*_):
        print("interrupted", flush=True)
        time.sleep(float(os.environ.get("FAKE_SUMMARY_S", "0")))
        sys.exit(1)
    signal.signal(signal.SIGTERM, end)
    print("watching", flush=True)
    out = rest[rest.index("--out") + 1]
    while not os.path.exists(out + "/learned"):
        time.sleep(0.02)
    print("learned", flush=True)
else:
    print(word, *rest, flush=True)
"""
PROCESS = """\
#!/bin/sh
n=0
while :; do echo "line $((n += 1))"; sleep 0.1; done
"""
# Hears SIGTERM and stays.
STUBBORN = """\
#!/bin/sh
trap '' TERM
echo stubborn
while :; do sleep 0.1; done
"""


class GroupTest(unittest.TestCase):
    """Real supervisord, real namespaces, real lcm-logger; the other processes are scripts."""

    logs_name = "logs"

    def setUp(self):
        if subprocess.run(["unshare", "--user", "--map-root-user", "--net", "true"], capture_output=True).returncode != 0:
            self.skipTest("no user namespaces")
        self.folder = Path(tempfile.mkdtemp(prefix="launcher test "))
        self.addCleanup(shutil.rmtree, self.folder, ignore_errors=True)
        self.logs = self.folder / self.logs_name
        self.bin = self.folder / "build" / "bin"
        self.bin.mkdir(parents=True)
        self.write_program("bodyschema", f"#!{sys.executable}\n{CONSOLE}")
        for name in ("robot_simulator", "camera", "marker_estimator", "observer", "motor_babbler", "controller"):
            self.write_program(name, PROCESS)
        for name in ("structure_learner", "model_monitor"):
            self.write_program(name, PROCESS)
        self.started = []
        self.addCleanup(self.end_all)

    def end_all(self):
        for process in self.started:
            if process.poll() is None:
                process.kill()
                process.wait()
        group = Group.find(self.logs)
        if group:
            group.stop()

    def write_program(self, name, text):
        (self.bin / name).write_text(text)
        (self.bin / name).chmod(0o755)

    def environment(self, **more):
        given = {"BODYSCHEMA_BUILD": str(self.bin.parent), "BODYSCHEMA_LOGS": str(self.logs)}
        return os.environ | given | more

    def run_to_end(self, *arguments, **environment):
        """stdout and stderr as one text, and the exit code."""
        done = subprocess.run(
            [SOURCE / "run", *arguments],
            env=self.environment(**environment),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=120,
        )
        return done.stdout, done.returncode

    def start(self, *arguments, **environment):
        """A ./run that goes on, once its group runs; its output goes to self.words()."""
        with open(self.folder / "words", "w") as output:
            process = subprocess.Popen(
                [SOURCE / "run", *arguments],
                env=self.environment(**environment),
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
            )
        self.started.append(process)
        self.wait_for(lambda: self.has_started() or process.poll() is not None, "a group")
        self.assertIsNone(process.poll(), self.words())
        # A program that prints something has replaced setpriv.
        speaking = [program.name for program in self.bin.iterdir() if "echo" in program.read_text()]
        self.wait_for(lambda: all(self.has_spoken(name) for name in speaking), f"a word of all of {speaking}")
        return process

    def has_spoken(self, name):
        log = Group.find(self.logs).run / f"{name}.log"
        return log.exists() and log.stat().st_size > 0

    def has_started(self):
        group = Group.find(self.logs)
        return group is not None and (group.run / "socket").exists()

    def delete(self, folder):
        """While others write into it."""
        self.wait_for(lambda: shutil.rmtree(folder, ignore_errors=True) or not folder.exists(), f"an end of {folder}")

    def words(self):
        return (self.folder / "words").read_text()

    @property
    def current(self):
        return self.logs / "current"

    def group(self):
        group = Group.find(self.logs)
        self.assertIsNotNone(group, "no group runs")
        return group

    def wait_for(self, condition, what, limit_s=60):
        self.assertTrue(until(condition, limit_s), f"there is not {what}")

    def wait_for_end(self, process, limit_s=60):
        try:
            return process.wait(limit_s)
        except subprocess.TimeoutExpired:
            self.fail(f"./run goes on: {self.words()}")

    def process_called(self, name):
        """Process id of the group's process `name`."""
        for pid in self.group().pids():
            words = Path(f"/proc/{pid}/cmdline").read_bytes().decode().split("\0")
            if any(Path(word).name == name for word in words[:2]):
                return pid
        self.fail(f"no {name} runs")

    def assert_nothing_is_left(self, group):
        self.assertEqual(group.pids(), [])
        self.assertFalse(group.folder.exists(), "the group's private folder")
