"""Commands that run a group: learning, a replay, the test of a driver."""

import os
import re
import shlex
import shutil
import subprocess
from pathlib import Path

from launcher import group_file, network, run_folder
from launcher.build import build
from launcher.session import Session
from launcher.words import Failure, say

PRIVATE_BUS = "udpm://239.255.76.67:7667?ttl=0"
PRIVATE_IMAGES = "udpm://239.255.76.67:7668?ttl=0"


def rig_folder(place, rig):
    """`rig`: a name in config/, or a folder."""
    folder = Path(rig)
    if "/" in rig and (folder / "signals.yaml").exists():
        return folder.resolve()
    if not (place.source / "config" / rig / "signals.yaml").exists():
        names = sorted(folder.name for folder in (place.source / "config").iterdir() if folder.is_dir())
        raise Failure(f"there is no rig '{rig}'; there are: {' '.join(names)}")
    return place.source / "config" / rig


def processes(place, folder):
    commands = group_file.processes(place.source / "config" / "group.conf", folder)
    if "refiner" in commands and not (place.bin / "refiner").exists():
        say("built without Ceres: the group runs without its refiner (apt-get install libceres-dev, then ./run clean)")
        del commands["refiner"]
    return commands


def refiner_file(commands, run):
    """What the monitor of a group with a refiner needs."""
    return {"REFINER": str(run / "config" / "refiner.yaml")} if "refiner" in commands else {}


def pick(commands, names):
    return {name: command for name, command in commands.items() if name in names}


def asked_of_console(place, *words):
    """The answer of a console command; if it fails, this program ends with its exit code."""
    asked = subprocess.run(list(map(str, [place.console, *words])), stdout=subprocess.PIPE, text=True)
    if asked.returncode != 0:
        raise SystemExit(asked.returncode)
    return asked.stdout.strip()


class Settings:
    """The result of `bodyschema rig` for the group."""

    def __init__(self, place, folder, *flags):
        answer = asked_of_console(place, "rig", folder, *flags)
        self.network, self.bus, self.images, self.host, *self.share = answer.splitlines()[0].split()


def watch_command(place, run, rig, images, names, *flags):
    """Progress and result, from the group's bus."""
    folder = run / "config"
    speakers = group_file.speakers(folder, names)
    command = [place.console, "watch", "--rig", rig, "--rig-folder", folder, "--out", run, "--images", images]
    return list(map(str, [*command, *flags, "--processes", *speakers]))


def learn(place, options):
    build(place, "programs")
    if options.build_only:
        return 0
    if options.replay:
        return replay(place, options.replay, options.rig, options.speed)
    folder = rig_folder(place, options.rig or "arm7")
    commands = processes(place, folder)
    hide = ["--hide", options.hide] if options.hide else []
    initial = ["--initial", options.initial] if options.initial else []
    ideal = ["--ideal"] if options.ideal else []
    host = ["--host", options.host] if options.host else []
    settings = Settings(place, folder, *hide, *initial, *host, "--group", *commands)
    # The share of a split group goes on after the result, because other hosts may need it.
    is_share = settings.host != "all"
    if is_share:
        network.check_route()
    run, lock = run_folder.begin(place, folder)
    if options.ideal:
        run_folder.tell_ideal_noise(run)
    samples = ["--samples", options.samples] if options.samples else []
    variables = {
        "SIMULATOR_FLAGS": shlex.join(["--seed", options.seed, *hide, *ideal]),
        "CAMERA_FLAGS": shlex.join(ideal),
        "BABBLER_FLAGS": shlex.join(["--seed", options.seed, *samples]),
        **refiner_file(commands, run),
    }
    if options.initial:
        variables["INITIAL"] = str(run / "initial.lcmlog")
        shutil.copyfile(options.initial, run / "initial.lcmlog")
    share = pick(commands, settings.share)
    is_private = settings.network == "private"
    with Session(place, run, lock, is_private, settings.bus, settings.images, share, options.keep, **variables) as session:
        status = 0
        if is_share:
            say(f"this is host {settings.host}: {' '.join(share)}")
        if not is_share or "motor_babbler" in share or options.watch:
            # The others may start whenever they like.
            patience = ["--patience-s", "1e9"] if is_share else []
            flags = ["--seed", options.seed, *samples, *patience]
            status = session.watch(watch_command(place, run, folder.name, settings.images, commands, *flags))
        if options.keep and not session.is_over and session.is_running():
            say("The group keeps running: ./run exec CMD… works on its bus, ./run stop ends it.")
        elif is_share and not session.is_over:
            say("Runs on until Ctrl-C or ./run stop.")
            status = max(status, session.wait())
    return status


def replay(place, log, rig, speed):
    """The learning half of the group on a recording, on a bus of its own: nothing that moves a robot runs, and no command is
    played."""
    log = Path(log).resolve()
    if not log.is_file():
        raise Failure(f"there is no recording {log}")
    if rig:
        folder = rig_folder(place, rig)
        rig = folder.name
        recorded = log.parent / "config"
        if (recorded / "signals.yaml").exists() and (names := run_folder.differences(recorded, folder)):
            say(f"--rig {rig} differs from {recorded} in {', '.join(names)}; without --rig the replay takes the latter.")
    else:
        # A run's folder has its rig; the rig of another recording is found by its messages.
        folder = log.parent / "config"
        if (folder / "signals.yaml").exists():
            rig = rig_of_result(log.parent / "result.json") or log.name
        else:
            rig = asked_of_console(place, "log", log, "--rig-of", place.source / "config")
            folder = rig_folder(place, rig)
    source = asked_of_console(place, "log", log, "--replay-from")
    run, lock = run_folder.begin(place, folder)
    names = ["structure_learner", "model_monitor", "refiner", "report", "log"]
    is_played = float(speed) > 0
    if is_played and source != "SAMPLE":
        names.insert(0, "observer")
    elif not is_played:
        make_samples(place, log, source, run)
    # Without an observer missing samples cannot be requested.
    flags = "" if "observer" in names else "--replayed"
    commands = pick(processes(place, folder), names)
    variables = {"SAMPLES_FLAGS": flags, **refiner_file(commands, run)}
    with Session(place, run, lock, True, PRIVATE_BUS, PRIVATE_IMAGES, commands, **variables) as session:
        words = ["--replay", log, "--replay-from", source, "--speed", speed]
        # The recording would be played again.
        return session.watch(watch_command(place, run, rig, PRIVATE_IMAGES, commands, *words), may_restart=not is_played)


def rig_of_result(file):
    found = re.search(r'^  "rig": "(.*)",$', file.read_text(), re.MULTILINE) if file.exists() else None
    return found and found[1]


def make_samples(place, log, source, run):
    samples = run / "samples.lcmlog"
    if source == "SAMPLE":
        # The readable part of a damaged file is used, and its reader reports the damage.
        subprocess.run([place.console, "log", log, "--copy", "SAMPLE", "--to", samples], capture_output=True)
        return
    words = run / "observer.log"
    command = [place.bin / "observer", "--config", run / "config" / "observer.yaml", "--in", f"file://{log}?speed=0"]
    with open(words, "wb") as file:
        if subprocess.run([*command, "--samples", samples], stderr=file).returncode != 0:
            raise Failure(words.read_text(errors="replace").splitlines()[-1])


def driver_test(place, rig, arguments):
    """Does the driver keep the contract? A simulated rig's is started for it."""
    build(place, "programs")
    folder = rig_folder(place, rig)
    settings = Settings(place, folder, "--host", "all")
    if (folder / "robot_simulator.yaml").exists():
        run, lock = run_folder.begin(place, folder)
        commands = pick(processes(place, folder), ["robot_simulator"])
        with Session(place, run, lock, True, settings.bus, settings.images, commands) as session:
            # Its process id is another namespace's: only its supervisor can kill it.
            restart = f"supervisorctl -s unix://{session.socket} signal KILL bodyschema:robot_simulator >&2"
            command = [place.console, "driver-test", "--rig-folder", run / "config", "--yes", "--restart", restart, *arguments]
            return session.watch(list(map(str, command)), may_restart=False)
    if settings.network != "host":
        raise Failure(f"the driver of '{rig}' is not simulated: its network.yaml must say 'network: host'")
    os.environ["LCM_DEFAULT_URL"] = settings.bus
    os.execv(place.console, [str(place.console), "driver-test", "--rig-folder", str(folder), *arguments])
