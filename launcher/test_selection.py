"""The targets that the tests selected by a ctest command line need."""

import json
import re
import subprocess
from pathlib import Path

from launcher.words import Failure

NOT_BUILT = "_NOT_BUILT"


def targets(place, arguments):
    """The targets, or None if all are needed: nothing is selected by name or label, or no known test is."""
    if name_pattern(arguments) is None and not has_label(arguments):
        return None
    sources = sources_of_targets(json.loads((place.build / "compile_commands.json").read_text()))
    discovered = {file.name.partition("[")[0] for file in (place.build / "tests").rglob("*_include.cmake")}
    return chosen(place, arguments, listed(place, arguments), sources, discovered)


def chosen(place, arguments, tests, sources, discovered):
    """`tests`: those that ctest knows; `sources`: target → files; `discovered`: targets whose tests it knows once they are built."""
    pattern = name_pattern(arguments)
    found = set()
    for test in tests:
        found |= targets_of(test, place, sources.keys())
    # Tests that are not built yet, or are new in a source, are found by their source.
    if pattern is not None:
        found |= {target for target in discovered if any(has_test(pattern, file) for file in sources.get(target, ()))}
    return sorted(found) if found or tests else None


def name_pattern(arguments):
    """The argument of -R."""
    for option, value in zip(arguments, [*arguments[1:], None]):
        if option in ("-R", "--tests-regex"):
            return value
    return None


def has_label(arguments):
    return any(option in ("-L", "--label-regex") for option in arguments)


def listed(place, arguments):
    """Tests as ctest lists them; those that are not built yet have the name of their program."""
    command = ["ctest", "--test-dir", str(place.build), "--show-only=json-v1", *arguments]
    asked = subprocess.run(command, stdout=subprocess.PIPE)
    if asked.returncode != 0:
        raise Failure("ctest does not know these arguments")
    tests = json.loads(asked.stdout)["tests"]
    # ctest lists no command of a program that is not built.
    written = commands_written(file.read_text() for file in place.build.rglob("CTestTestfile.cmake"))
    return [{"command": written.get(test["name"], []), **test} for test in tests]


def commands_written(texts):
    """Name → command of the tests in CTestTestfile.cmakes."""
    lines = (found for text in texts for found in re.findall(r"^add_test\(\[?=*\[?([^\s\]]+)\S* (.*)\)$", text, re.MULTILINE))
    return {name: re.findall(r'"([^"]*)"', words) for name, words in lines}


def sources_of_targets(compile_commands):
    """Target → its sources."""
    sources = {}
    for entry in compile_commands:
        found = re.search(r" -o \S*CMakeFiles/([^/ ]+)\.dir/", entry["command"])
        if found:
            sources.setdefault(found[1], []).append(Path(entry["file"]))
    return sources


def has_test(pattern, file):
    """True if a source has a GoogleTest of this name; the parameter's name of a parameterized one is not known."""
    if not file.exists():
        return False
    text = file.read_text(errors="replace")
    names = [f"{suite}.{name}" for suite, name in re.findall(r"^TEST(?:_F|_P)?\(\s*(\w+),\s*(\w+)\)", text, re.MULTILINE)]
    try:
        return any(re.search(pattern, name) for name in names)
    except re.error:
        return False


def targets_of(test, place, known):
    """The programs that a test runs: those of its command and those that its script names."""
    if test["name"].endswith(NOT_BUILT):
        return {test["name"].removesuffix(NOT_BUILT)}
    words = [Path(word) for word in test.get("command", [])]
    found = {word.name for word in words if word.parent == place.bin and word.name in known}
    if place.build in words:
        scripts = [word for word in words if word.suffix in (".sh", ".py") and word.is_file()]
        found |= {"programs"}.union(*(set(re.findall(r"\w+", script.read_text())) & known for script in scripts))
    return found
