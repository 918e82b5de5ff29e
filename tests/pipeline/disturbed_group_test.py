"""disturbed_group_test.py SOURCE BUILD full_disk|forged_packets: a group that is disturbed ends with the same samples and schema as
one that is not."""

import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

source, build = Path(sys.argv[1]), Path(sys.argv[2])
sys.path.insert(0, str(source))

from launcher.group import Group, until  # noqa: E402

LEARN = ("--rig", "arm2", "--ideal", "--seed", "3", "--samples", "30")
FULL_S = 15  # processes say how they are, loggers write, watches look: all of it often

# Two fragments of one message: the second lies 256 bytes before its begin, and LCM 1.x adds in 32 bits (upstream's PR 628).
FORGE = """\
import socket, struct
bus = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
def send(offset, number, data):
    header = struct.pack(">IIIIHH", 0x4C433033, 1, 1024, offset, number, 2)
    bus.sendto(header + data, ("239.255.76.67", 7667))
send(0, 0, b"PROCESS_INFO\\0" + b"x" * 512)
send(0xFFFFFF00, 1, b"x" * 512)
"""


class Failed(Exception):
    pass


class Run:
    """A ./run of LEARN, with logs in a folder of its own."""

    def __init__(self, logs):
        self.logs = logs
        self.samples = logs / "current" / "samples.lcmlog"
        with open(f"{logs}.out", "w") as out, open(f"{logs}.err", "w") as err:
            command = [source / "run", *LEARN]
            self.process = subprocess.Popen(command, env=self.environment(), stdin=subprocess.DEVNULL, stdout=out, stderr=err)

    def environment(self):
        return os.environ | {"BODYSCHEMA_BUILD": str(build), "BODYSCHEMA_LOGS": str(self.logs)}

    def words(self):
        return Path(f"{self.logs}.err").read_text()

    def has_ended(self):
        return self.process.poll() is not None

    def wait(self):
        if self.process.wait(250) != 0:
            raise Failed(f"the run failed: {self.words()}")

    def wait_for_samples(self):
        if not until(lambda: self.has_ended() or (self.samples.exists() and self.samples.stat().st_size > 0), 60):
            raise Failed(f"no sample came: {self.words()}")

    def payloads(self, file, channel):
        command = [build / "bin" / "log_payloads", self.logs / "current" / file, channel]
        return subprocess.run(command, stdout=subprocess.PIPE).stdout

    def compare(self, other):
        for file, channel in (("samples.lcmlog", "SAMPLE"), ("schema.lcmlog", "BODY_SCHEMA")):
            if not self.payloads(file, channel) or self.payloads(file, channel) != other.payloads(file, channel):
                raise Failed(f"{channel} differs from that of the undisturbed run")
        if not (self.logs / "current" / "result.json").exists():
            raise Failed("there is no result")


def processes(group):
    """Process id → program, without the loggers, which end on a full disk and wait for space, and what has just ended, which has no command."""

    def program_of(pid):
        try:
            return Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").decode()
        except FileNotFoundError:
            return ""

    programs = {pid: program_of(pid) for pid in group.pids()}
    return {pid: program for pid, program in programs.items() if program and "lcm-logger" not in program and not program.startswith("sleep")}


def fill(disk):
    """To the last byte."""
    with open(disk / "filler", "ab", buffering=0) as filler:
        for size in (1 << 20, 1 << 12, 1):
            try:
                while True:
                    filler.write(b"x" * size)
            except OSError:
                pass


def full_disk(work, undisturbed):
    disk = work / "disk"
    disk.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=64m", "tiny", disk]).returncode != 0:
        print("SKIP: cannot mount a tmpfs", file=sys.stderr)
        sys.exit(77)
    try:
        run = Run(disk)
        run.wait_for_samples()
        fill(disk)
        group = Group.find(disk)
        before = processes(group)
        if len(before) < 10:
            raise Failed(f"the search for processes finds {before}")
        end = time.monotonic() + FULL_S
        while time.monotonic() < end:
            fill(disk)  # also what somebody gave back
            time.sleep(0.2)
        if run.has_ended() or processes(group) != before:
            raise Failed(f"somebody died of a full disk: {before} became {processes(group)}; {run.words()}")
        written = run.payloads("samples.lcmlog", "SAMPLE")
        expected = undisturbed.payloads("samples.lcmlog", "SAMPLE")
        if not expected.startswith(written) or written == expected:
            raise Failed("the disk was not full in the middle of the run: the test tests nothing")
        (disk / "filler").unlink()
        run.wait()
        run.compare(undisturbed)
        empty = [log.name for log in disk.glob("current/*.lcmlog.*") if log.stat().st_size == 0]
        if empty:
            raise Failed(f"the loggers left {empty}")
    finally:
        subprocess.run(["umount", "--lazy", disk])


def forged_packets(work, undisturbed):
    run = Run(work / "forged")
    run.wait_for_samples()
    # While it runs, no log is damaged: it is being written.
    page = work / "live.html"
    subprocess.run([source / "run", "report", "--out", page], env=run.environment(), stdout=subprocess.DEVNULL, check=True)
    if "are lost" in page.read_text():
        raise Failed("the report of a run that goes on calls its logs damaged")
    subprocess.run([source / "run", "exec", sys.executable, "-c", FORGE], env=run.environment(), check=True)
    run.wait()
    run.compare(undisturbed)
    if "was ended by SIGSEGV; it is started again" not in run.words():
        raise Failed(f"the packets did no harm: the test tests nothing: {run.words()}")
    result = (run.logs / "current" / "result.json").read_text()
    if '"held_out_against": "noise-free simulator"' not in result:
        raise Failed("the truth of before the crash is not known")


def main(disturb):
    work = Path(tempfile.mkdtemp())
    try:
        undisturbed = Run(work / "undisturbed")
        undisturbed.wait()
        disturb(work, undisturbed)
    except Failed as failed:
        sys.exit(f"disturbed_group_test: {failed}")
    finally:
        shutil.rmtree(work, ignore_errors=True)


if "inside" in sys.argv:
    main({"full_disk": full_disk, "forged_packets": forged_packets}[sys.argv[3]])
else:
    namespaces = ["unshare", "--user", "--map-root-user", "--mount"]
    if subprocess.run([*namespaces, "true"], capture_output=True).returncode != 0:
        print("SKIP: this machine allows no mount namespaces", file=sys.stderr)
        sys.exit(77)
    os.execvp("unshare", [*namespaces, sys.executable, *sys.argv, "inside"])
