"""path_group_test.py SOURCE BUILD RIG: a group that has learned RIG brings its hand along 20 way points; in their middle the forearm
is bent by 30°, and four way points later the hand is within 3 mm of each again, as it is seen and by the truth."""

import json
import math
import re
import signal
import subprocess
import sys

from group_run import Failed, build, environment, in_a_folder, run, source

RIG = sys.argv[3]
WAY_POINTS = 20
BENT_AFTER = 8
MAY_BE_OFF = 4  # way points of the bent arm
WHOLE_MM, MENDED_MM = 1.5, 3
PASSED = re.compile(r"way point (\d+) of \d+: .*\((.*)\)")

# Of the rig: samples, hand, what the status says of the bend, the centre of the actions on the path, and how far they swing.
SAMPLES, HAND, FOUND, CENTRE, SWING = {
    "arm4": (60, 5, "4→5 bent", (0, -25, 0, -0.6), (0.4, 4, 0, 0.1)),
    "arm7": (100, 8, "5→6 bent", (0, -10, 0, -0.6, 0, 0, 40), (0.3, 4, 0, 0.1, 0, 0, 0)),
}[RIG]


def position(work, action):
    """Of the hand by the schema, well inside of what it reaches."""
    parts = json.loads(run(work, "predict", work / "logs" / "current" / "schema.lcmlog", "--action", *action, "--json")[0])["parts"]
    return next(part["X_RB"]["position_m"] for part in parts if part["part"] == HAND)


def closed_path(work):
    path = []
    for n in range(WAY_POINTS):
        phase = 2 * math.pi * n / WAY_POINTS
        swings = [math.sin(phase), math.cos(phase), 0, math.sin(phase)] + [0] * (len(CENTRE) - 4)
        path.append(position(work, [c + s * swing for c, s, swing in zip(CENTRE, SWING, swings)]))
    return path


def follow(work, path, on_way_point):
    """How far off the hand was seen at each way point [mm], None: not seen; and the number of probes."""
    file = work / "path.csv"
    file.write_text("\n".join(["x,y,z", *(",".join(map(str, point)) for point in path), ""]))
    errors_mm, num_probes, text = [], 0, ""
    words = [source / "run", "follow", str(file), "--part", str(HAND)]
    with subprocess.Popen(words, env=environment(work), stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as console:
        for line in console.stdout:
            text += line
            if not (passed := PASSED.match(line)):
                continue
            seen = re.search(r"as seen ([\d.]+) mm", passed[2])
            errors_mm.append(float(seen[1]) if seen else None)
            num_probes += sum(int(probes) for probes in re.findall(r"(\d+) probe", passed[2]))
            on_way_point(int(passed[1]), console)
    # 1: a way point where the hand was not seen near.
    is_missed = any(error is None or error > 20 for error in errors_mm)
    if len(errors_mm) != len(path) or console.returncode != is_missed:
        raise Failed(f"the path ended with {console.returncode}: {text}")
    return errors_mm, num_probes


def main(work):
    run(work, "--rig", RIG, "--ideal", "--seed", 2, "--samples", SAMPLES, "--keep")
    path = closed_path(work)

    def bend(way_point, console):
        if way_point == BENT_AFTER:
            console.send_signal(signal.SIGSTOP)  # else the arm goes on while the command starts
            try:
                run(work, "fault", "bend", "forearm", 30)
            finally:
                console.send_signal(signal.SIGCONT)

    seen_mm, num_probes = follow(work, path, bend)
    status = run(work, "status")[0]
    run(work, "release")
    run(work, "stop")
    log = work / "logs" / "current" / "run.lcmlog.00"
    truth = subprocess.run([build / "bin" / "path_truth", log, str(HAND)], capture_output=True, check=True, text=True).stdout
    arrivals = [line.split() for line in truth.splitlines()]
    true_mm = [float(mm) for mm, _ in arrivals]
    bent_from = [int(num_faults) for _, num_faults in arrivals].index(1)
    if not BENT_AFTER <= bent_from <= BENT_AFTER + 1:
        raise Failed(f"it was bent on the way to way point {bent_from + 1}")
    print(f"errors [mm], as seen: {seen_mm}; by the truth: {true_mm}; probes: {num_probes}")
    for name, errors_mm in ("as seen", seen_mm), ("by the truth", true_mm):
        if len(errors_mm) != WAY_POINTS or any(error is None or error > WHOLE_MM for error in errors_mm[:bent_from]):
            raise Failed(f"the whole arm, {name}: {errors_mm}")
        if any(error is None or error > MENDED_MM for error in errors_mm[bent_from + MAY_BE_OFF :]):
            raise Failed(f"the bent arm, {name}: {errors_mm}")
    if FOUND not in status:
        raise Failed(f"the bend was not found: {status}")


in_a_folder(main)
