"""path_group_test.py SOURCE BUILD: a group that has learned arm4 brings its hand along 20 way points; in their middle, while the arm
is on its way, the forearm is bent by 30°, and four way points later the hand is within 3 mm of each again."""

import json
import math
import re
import subprocess

from group_run import Failed, environment, in_a_folder, run, source

HAND = 5
WAY_POINTS = 20
BENT_AFTER = 8
PASSED = re.compile(r"way point (\d+) of \d+: .*\((.*)\)")


def position(work, *action):
    """Of the hand by the schema, well inside of what it reaches."""
    parts = json.loads(run(work, "predict", work / "logs" / "current" / "schema.lcmlog", "--action", *action, "--json")[0])["parts"]
    return next(part["X_RB"]["position_m"] for part in parts if part["part"] == HAND)


def follow(work, path, on_way_point):
    """How far off the hand was seen at each way point [mm], None: not seen; and the number of probes."""
    file = work / "path.csv"
    file.write_text("\n".join(["x,y,z", *(",".join(map(str, point)) for point in path), ""]))
    errors_mm, num_probes, text = [], 0, ""
    words = [source / "run", "follow", str(file), "--part", str(HAND)]
    with subprocess.Popen(words, env=environment(work), stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as console:
        for line in console.stdout:
            text += line
            if not (passed := PASSED.match(line)):
                continue
            seen = re.search(r"as seen ([\d.]+) mm", passed[2])
            errors_mm.append(float(seen[1]) if seen else None)
            num_probes += sum(int(probes) for probes in re.findall(r"(\d+) probe", passed[2]))
            on_way_point(int(passed[1]))
    if len(errors_mm) != len(path):
        raise Failed(f"the path: {text}")
    return errors_mm, num_probes


def main(work):
    run(work, "--rig", "arm4", "--ideal", "--seed", 2, "--samples", 60, "--keep")
    path = []
    for n in range(WAY_POINTS):
        phase = 2 * math.pi * n / WAY_POINTS
        path.append(position(work, 0.4 * math.sin(phase), -25 + 4 * math.cos(phase), 0, 0.1 * math.sin(phase) - 0.6))

    def bend(way_point):
        if way_point == BENT_AFTER:
            run(work, "fault", "bend", "forearm", 30)

    errors_mm, num_probes = follow(work, path, bend)
    print("errors [mm]:", errors_mm, "probes:", num_probes)
    if any(error is None or error > 1.5 for error in errors_mm[:BENT_AFTER]):
        raise Failed(f"the whole arm: {errors_mm}")
    # By the time of the bend the next way point may have been passed.
    if any(error is None or error > 3 for error in errors_mm[BENT_AFTER + 5 :]):
        raise Failed(f"the bent arm: {errors_mm}")
    status = run(work, "status")[0]
    if "4→5 bent" not in status:
        raise Failed(f"the bend was not found: {errors_mm} {status}")
    run(work, "release")


in_a_folder(main)
