"""The words of `./run`."""

import argparse
import difflib
import itertools
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

from launcher import group_file, packages, run_folder, test_selection
from launcher.build import alone, build, cmake, configure, num_processors
from launcher.group import Group, until
from launcher.learn import driver_test, learn, processes, rig_folder
from launcher.words import Failure, UsageError, say

# Time for a ./run in another shell to sum up, after its group was stopped.
SUMMARY_S = 30

LEARN_USAGES = (
    (
        "[--rig arm7] [--seed N] [--samples N] [--ideal] [--hide PART] [--initial SCHEMA] [--keep] [--build-only]",
        "set up, build, let the simulated arm learn its body, show the result;",
        "--ideal: tags, lens and joints of the simulation are exactly what the rig's files say;",
        "--initial begins with a body schema, of another run or from `engineer`;",
        "--keep leaves the process group running",
    ),
    (
        "--host NAME [--rig RIG] [--watch] [--keep] …",
        "the share of one host of the rig's network.yaml, until Ctrl-C or ./run stop;",
        "--watch shows progress and result also where there is no motor_babbler;",
        "--host all runs every share here",
    ),
    (
        "--replay LOG [--rig RIG] [--speed X]",
        "learn from a recording, without a robot; X times real time, or 0: at once",
    ),
)
# Words of the console that need the group's bus.
ON_THE_BUS = ("target", "follow", "where", "hold", "release", "halt", "resume", "fault")
# Words of `./run` with the console's options.
OPTIONS_OF_THE_CONSOLE = ("driver-test", "status", "report", "rig")
# Words whose arguments, --help included, belong to another program.
PASSED_ON = ("exec", "spy", "experiment", "experiments")


def usage(name, lines):
    indent = "\n" + " " * 22
    call, *text = lines
    head = " ".join(filter(None, ("./run", name, call)))
    return head + (" " * (22 - len(head)) if len(head) < 22 else indent) + indent.join(text)


def help_text():
    entries = [usage("", lines) for lines in LEARN_USAGES]
    entries += [usage(name, lines) for name, (_, *lines) in WORDS.items()]
    entries += [usage(name, lines) for name, lines in CONSOLE_WORDS.items()]
    return "\n".join(entries)


def run(place, arguments):
    """Carries out a command line; returns the exit code."""
    if arguments and (arguments[0] in ("", "-h", "--help", "help")):
        print(help_text())
        return 0
    if arguments == ["--version"]:
        return version(place)
    if not arguments or arguments[0].startswith("-"):
        return learn(place, learn_options(arguments))
    name, *rest = arguments
    if asks_for_help(rest if name not in PASSED_ON else rest[:1]):
        return show_help(place, name, rest)
    if name in WORDS:
        return WORDS[name][0](place, rest)
    return console(place, name, rest)


def version(place):
    if not place.console.exists():
        raise Failure("--version is known once there is a build: ./run --build-only")
    become([place.console, "--version"])


def asks_for_help(arguments):
    return "-h" in arguments or "--help" in arguments


def show_help(place, name, arguments):
    """Prints the help of a word; that of the console's words only if the console is built, because help builds nothing."""
    if (name not in WORDS or name in OPTIONS_OF_THE_CONSOLE) and place.console.exists():
        words = itertools.takewhile(lambda argument: not argument.startswith("-"), arguments)
        return console(place, name, [*words, "--help"])
    if name not in WORDS:
        raise Failure(f"{name} --help is known once there is a build: ./run --build-only")
    print(usage(name, WORDS[name][1:]))
    return 0


class Parser(argparse.ArgumentParser):
    """Reports errors in the words of `./run`; abbreviated options are errors."""

    def __init__(self):
        super().__init__(prog="./run", add_help=False, allow_abbrev=False)

    def error(self, message):
        raise UsageError(f"{message.removeprefix('argument ')}; ./run help tells what there is")


def matching(pattern, what):
    def check(value):
        if not re.fullmatch(pattern, value):
            raise argparse.ArgumentTypeError(f"wants {what}, not '{value}'")
        return value

    return check


def readable_file(value):
    if not os.access(value, os.R_OK) or not os.path.isfile(value):
        raise argparse.ArgumentTypeError(f"wants a schema file, not '{value}'")
    return value


def learn_options(arguments):
    if asks_for_help(arguments):
        print("\n".join(usage("", lines) for lines in LEARN_USAGES))
        raise SystemExit(0)
    parser = Parser()
    parser.add_argument("--rig")
    parser.add_argument("--seed", default="1", type=matching("[0-9]{1,18}", "a whole number of at most 18 digits"))
    parser.add_argument("--samples", type=matching("[1-9][0-9]{0,8}", "a whole number from 1 to 999999999"))
    parser.add_argument("--ideal", action="store_true")
    parser.add_argument("--hide", type=matching("[0-9]{1,9}", "the id of a part"))
    parser.add_argument("--initial", type=readable_file)
    parser.add_argument("--host")
    parser.add_argument("--replay")
    parser.add_argument("--speed", default="0", type=matching(r"[0-9]+(\.[0-9]+)?", "a number from 0"))
    parser.add_argument("--watch", action="store_true")
    parser.add_argument("--keep", action="store_true")
    parser.add_argument("--build-only", action="store_true")
    options = parser.parse_args(arguments)
    for name in ("seed", "samples", "ideal", "hide", "initial", "host", "watch", "keep"):
        if options.replay and getattr(options, name) != parser.get_default(name):
            parser.error(f"--{name} has no meaning with --replay")
    if not options.replay and options.speed != parser.get_default("speed"):
        parser.error("--speed is that of a --replay")
    return options


def no_arguments(name, arguments):
    if arguments:
        raise UsageError(f"{name} takes no arguments, not '{arguments[0]}'; ./run help tells what there is")


def running_group(place):
    group = Group.find(place.logs)
    if not group:
        raise Failure("no group runs; start one with ./run --keep")
    return group


def stop(place, arguments):
    no_arguments("stop", arguments)
    group = Group.find(place.logs)
    if group:
        group.stop()
        # A ./run that followed the group holds the lock until it has summed up.
        if not until(lambda: not run_folder.is_locked(place.logs), SUMMARY_S):
            say("stopped; its run is still being summed up: another can begin after that")
            return 0
        say("stopped")
        return 0
    if run_folder.is_locked(place.logs):
        raise Failure("a group runs here, but it just begins, sums up its run, or is another user's, who can stop it")
    say("no group runs")
    return 0


def execute(place, arguments):
    if not arguments:
        raise UsageError("exec wants a command")
    exec_in_group(place, running_group(place), arguments)


def exec_in_group(place, group, command):
    """Becomes a program of the user, with the group's bus as LCM's default."""
    os.environ["LCM_DEFAULT_URL"] = group.variables["LCM_DEFAULT_URL"]
    os.environ["PATH"] = f"{place.bin}:{os.environ['PATH']}"
    become(group.entered(command))


def become(command):
    sys.stdout.flush()
    # Python ignores them, and an executed program would inherit that.
    for number in (signal.SIGPIPE, signal.SIGXFSZ):
        signal.signal(number, signal.SIG_DFL)
    try:
        os.execvp(command[0], list(map(str, command)))
    except OSError as error:
        raise Failure(f"{command[0]}: {error.strerror}") from None


def spy(place, arguments):
    """LCM's spy, with our types in a jar of their own."""
    group = running_group(place)
    packages.install(place.source / "config" / "packages-spy.txt")
    folder = place.build / "spy"
    jar = folder / "bodyschema.jar"
    types = sorted((place.source / "lcmtypes").glob("*.lcm"))
    if not jar.exists() or any(file.stat().st_mtime > jar.stat().st_mtime for file in types):
        classes = folder / "classes"
        classes.mkdir(parents=True, exist_ok=True)
        subprocess.run(["lcm-gen", "--java", "--jpath", folder, *types], check=True)
        sources = sorted((folder / "bodyschema").glob("*.java"))
        subprocess.run(["javac", "-nowarn", "-cp", "/usr/share/java/lcm.jar", "-d", classes, *sources], check=True)
        subprocess.run(["jar", "cf", jar, "-C", classes, "."], check=True)
    # Debian's script passes an option that its own Java no longer knows.
    os.environ.update(CLASSPATH=str(jar), JDK_JAVA_OPTIONS="-XX:+IgnoreUnrecognizedVMOptions")
    exec_in_group(place, group, ["lcm-spy", *arguments])


def test_driver(place, arguments):
    parser = Parser()
    parser.add_argument("--rig", default="arm7")
    options, rest = parser.parse_known_args(arguments)
    return driver_test(place, options.rig, rest)


def test(place, arguments):
    """Builds what the selected tests need, and runs them."""
    os.chdir(place.source)
    # The tests expect the texts of a console that was not started by ./run.
    os.environ.pop("BODYSCHEMA_COMMAND", None)
    ctest = ["ctest", "--test-dir", place.build]
    if arguments[:1] == ["--sanitize"]:
        place = place.with_build(place.source / "build-asan-ubsan")
        preset = "asan-ubsan"
        ctest = ["ctest", "--preset", preset]
        arguments = ["-L", "sanitized", *arguments[1:]]
    else:
        preset = "release"
    if not place.is_build_given:
        with alone(place.source):
            configure(place, preset)
            # CMake runs again, if it must, before the tests are listed.
            cmake("--build", place.build, "--target", "build.ninja")
        targets = test_selection.targets(place, arguments)
        build(place, *(["all"] if targets is None else targets), preset=preset)
    become([*ctest, "--output-on-failure", "-j", num_processors() + 1, *arguments])


def experiment_names(place):
    folders = [place.source / "tests" / "experiments", place.source / "tests" / "benchmarks"]
    return {file.stem for folder in folders for file in folder.iterdir() if file.suffix in (".cpp", ".sh")}


def experiment(place, arguments):
    name = arguments[0] if arguments else ""
    script = place.source / "tests" / "experiments" / f"{name}.sh"
    if script.is_file():
        build(place, *re.search(r"^# Needs: (.*)$", script.read_text(), re.M)[1].split())
        os.environ["BODYSCHEMA_BUILD"] = str(place.build)
        become([script, *arguments[1:]])
    if name not in (names := experiment_names(place)):
        raise UsageError("experiment wants a name: " + " ".join(sorted(names)))
    build(place, name)
    os.chdir(place.source)
    become([place.bin / name, *arguments[1:]])


def experiments(place, arguments):
    if arguments and arguments[0] in experiment_names(place):
        return experiment(place, arguments)
    build(place, "experiments")
    if not any(argument.split("=")[0] == "--out" for argument in arguments):
        arguments = ["--out", place.logs / "experiments", *arguments]
    become([place.bin / "experiments", *arguments])


def check_rig(place, arguments):
    folders = [argument for argument in arguments[:1] if not argument.startswith("-")]
    for folder in folders:
        folder = Path(folder) if Path(folder).is_dir() else rig_folder(place, folder)
        arguments = [folder, *arguments[1:], "--group", *processes(place, folder)]
    return console(place, "rig", arguments)


def status(place, arguments):
    group = Group.find(place.logs)
    if not group and not place.console.exists() and not asks_for_help(arguments):
        raise Failure("no group runs, and nothing is built yet; ./run does both")
    if not group:
        return console(place, "status", arguments)
    rig = group.run / "config"
    names = group_file.speakers(rig, processes(place, rig))
    exec_in_group(place, group, ["bodyschema", "status", *arguments, "--processes", *names])


def report(place, arguments):
    os.environ.setdefault("BODYSCHEMA_RUN", str(place.current))
    parser = Parser()
    parser.add_argument("run", nargs="?", default=os.environ["BODYSCHEMA_RUN"])
    parser.add_argument("--out")
    options, _ = parser.parse_known_args(arguments)
    group = Group.find(place.logs)
    # A log that is being written ends in the middle of an event.
    if group and os.path.realpath(options.run) == str(group.run):
        arguments = [*arguments, "--growing"]
    return console(place, "report", arguments)


def console(place, word, arguments):
    """Runs a word of the console; suggests the nearest one for a misspelt word."""
    asks_group = word in ON_THE_BUS and not any(argument.split("=")[0] == "--schema" for argument in arguments)
    if asks_group and not asks_for_help(arguments):
        group = Group.find(place.logs)
        if group:
            rig = ["--rig", str(group.run / "config")] if word == "follow" and "--rig" not in arguments else []
            exec_in_group(place, group, ["bodyschema", word, *arguments, *rig])
        # The user names the bus of a lab's own group.
        if "LCM_DEFAULT_URL" not in os.environ and "--in" not in arguments:
            raise Failure(f"no group runs here; start one with ./run --keep, or name a bus: LCM_DEFAULT_URL=URL ./run {word} …")
    if not asks_for_help(arguments):
        build(place, "programs")
    words = [*WORDS, *console_words(place)]
    if word not in words:
        near = difflib.get_close_matches(word, words, 1)
        maybe = f"; did you mean '{near[0]}'?" if near else ""
        raise UsageError(f"unknown command '{word}'{maybe} ./run help lists the commands")
    become([place.console, word, *arguments])


def console_words(place):
    text = subprocess.run([place.console, "--help"], stdout=subprocess.PIPE, text=True).stdout
    return re.findall(r"^  ([a-z][a-z-]*)", text.partition("\nSubcommands:")[2], re.MULTILINE)


# Word → function, arguments, description.
WORDS = {
    "stop": (stop, "", "end a kept group; the arm's stop has a word of its own: halt"),
    "exec": (execute, "CMD…", "run a tool on the group's bus, e.g. ./run exec lcm-logger FILE"),
    "spy": (spy, "", "lcm-spy on the group's bus, with the types of bodyschema"),
    "driver-test": (
        test_driver,
        "[--rig RIG] [ARGS…]",
        "does the driver keep the contract? A simulated rig's is started for it",
    ),
    "test": (
        test,
        "[--sanitize] [ARGS…]",
        "set up, build, run the tests; --sanitize: those without images and groups, under address and",
        "undefined-behaviour sanitizers; ARGS go to ctest: -R NAME builds and runs what it names",
    ),
    "experiment": (
        experiment,
        "NAME [ARGS…]",
        "build and run a measurement of tests/experiments, e.g. rig_table config/arm2",
    ),
    "experiments": (
        experiments,
        "[NAME…] [--quick] [--out FOLDER] [--list]",
        "the chapter's figures measured again, into logs/experiments",
    ),
    "status": (status, "", "what the group does and waits for, on one screen"),
    "report": (report, "[RUN]", "what a run tells, on one page; the newest one's"),
    "rig": (check_rig, "RIG", "is the configuration of a rig sound?"),
}
# Words of the console, whose own help says more.
CONSOLE_WORDS = {
    "halt": ("", "stop the arm at once, until ./run resume"),
    "target|follow|where|hold|release|fault": ("…", "steer or break the group's arm"),
    "WORD…": ("", "bodyschema WORD…: learn, predict, show, reach, log, monitor, refine, adopt, engineer, urdf"),
}
