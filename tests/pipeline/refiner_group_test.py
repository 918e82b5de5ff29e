"""refiner_group_test.py SOURCE BUILD: a group whose rig enables the refiner makes the actions that it wants, the same in every
run, also where it is killed, and proposes tags and lens; a replay makes the same schema of it, `adopt` writes them into the rig,
and the next run begins and ends with the refined schema."""

import json
import os
import shutil
import signal
import struct
import subprocess
import sys
import threading
from pathlib import Path

from group_run import Failed, build, environment, in_a_folder, source


def run(work, *words, beside=lambda ended: None):
    """./run with logs of its own; what it says. `beside` runs at the same time, until the event."""
    ended = threading.Event()
    thread = threading.Thread(target=beside, args=[ended])
    thread.start()
    try:
        command = [source / "run", *map(str, words)]
        done = subprocess.run(
            command, env=environment(work), stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=250
        )
    finally:
        ended.set()
        thread.join()
    if done.returncode != 0:
        raise Failed(f"./run {' '.join(map(str, words))}: {done.stderr[-2000:]}")
    return done.stdout


def kill_refiners(work, killed, ended):
    """Those of this test's groups, a few times: the monitor does not wait for ever."""
    while len(killed) < 5 and not ended.wait(2):
        for process in Path("/proc").glob("[0-9]*"):
            try:
                if (process / "comm").read_text() == "refiner\n" and str(work) in (process / "cmdline").read_text():
                    os.kill(int(process.name), signal.SIGKILL)
                    killed.append(process.name)
            except OSError:
                pass  # it has ended


def payloads(log, channel):
    return subprocess.run([build / "bin" / "log_payloads", log, channel], capture_output=True, check=True).stdout


def wanted_actions(refined):
    """Of a file with a schema of two signals: what stands before the two numbers at its end."""
    action = struct.Struct(">i4d")
    return [action.unpack(refined[n : n + action.size])[1:3] for n in range(len(refined) - 376, len(refined) - 16, action.size)]


def main(work):
    rig = work / "rig"
    shutil.copytree(source / "config" / "arm2", rig)
    settings = (rig / "refiner.yaml").read_text()
    settings = settings.replace("enabled: false", "enabled: true").replace("refine_every: 50", "refine_every: 30")
    (rig / "refiner.yaml").write_text(settings)
    babbler = (rig / "motor_babbler.yaml").read_text()
    (rig / "motor_babbler.yaml").write_text(babbler.replace("choice: random", "choice: active"))
    learn = ("--rig", rig, "--seed", 1, "--samples", 45)
    current = work / "logs" / "current"

    if "refined.lcmlog" not in run(work, *learn):
        raise Failed("the result does not name the refined schema")
    first = current.resolve()
    refined = (first / "refined.lcmlog").read_bytes()

    wanted = wanted_actions(refined)
    samples = payloads(first / "samples.lcmlog", "SAMPLE")
    missed = [action for action in wanted if samples.count(struct.pack(">i2d", 2, *action)) != 1]
    if len(set(wanted)) != 10 or missed:
        raise Failed(f"of the wanted actions {wanted} these were not made once each: {missed}")

    killed = []
    run(work, *learn, beside=lambda ended: kill_refiners(work, killed, ended))
    if not killed or payloads(current / "samples.lcmlog", "SAMPLE") != samples:
        raise Failed(f"another run of the same seed, its refiner killed {len(killed)} times, has other samples")

    run(work, "--replay", first / "run.lcmlog.00")
    if (current / "refined.lcmlog").read_bytes() != refined:
        raise Failed("a replay refines otherwise")

    if "Written" not in run(work, "adopt", first, "--rig", rig, "--yes"):
        raise Failed("nothing was adopted")
    for name in ("markers.yaml", "camera_info.yaml"):
        if (rig / name).read_bytes() != (first / "proposed" / name).read_bytes():
            raise Failed(f"{name} was not adopted")

    run(work, *learn, "--initial", first / "refined.lcmlog")
    if not json.loads(run(work, "show", current / "schema.lcmlog", "--json"))["refined"]:
        raise Failed("what the refiner had fitted did not stand against what was learned")


if not (build / "bin" / "refiner").exists():
    print("SKIP: built without Ceres", file=sys.stderr)
    sys.exit(77)
in_a_folder(main)
