"""path_group_test.py SOURCE BUILD: a group that has learned arm4 brings its hand along 20 way points; in their middle the forearm is
bent by 30°, and four way points later the hand is within 3 mm of each again."""

import json
import math

from group_run import Failed, in_a_folder, run

HAND = 5
WAY_POINTS = 20
BENT_AFTER = 8


def position(work, *action):
    """Of the hand by the schema, well inside of what it reaches."""
    parts = json.loads(run(work, "predict", work / "logs" / "current" / "schema.lcmlog", "--action", *action, "--json")[0])["parts"]
    return next(part["X_RB"]["position_m"] for part in parts if part["part"] == HAND)


def follow(work, path):
    file = work / "path.csv"
    file.write_text("\n".join(["x,y,z", *(",".join(map(str, point)) for point in path), ""]))
    return json.loads(run(work, "follow", file, "--part", HAND, "--json", codes=(0, 1))[0])


def main(work):
    run(work, "--rig", "arm4", "--ideal", "--seed", 2, "--samples", 60, "--keep")
    path = []
    for n in range(WAY_POINTS):
        phase = 2 * math.pi * n / WAY_POINTS
        path.append(position(work, 0.4 * math.sin(phase), -25 + 4 * math.cos(phase), 0, 0.1 * math.sin(phase) - 0.6))

    before = follow(work, path[:BENT_AFTER])
    if not before["reached"] or max(point["observed_error_m"] for point in before["way_points"]) > 0.0015:
        raise Failed(f"the whole arm: {before}")
    run(work, "fault", "bend", "forearm", 30)
    after = follow(work, path[BENT_AFTER:])
    errors_m = [point["observed_error_m"] for point in after["way_points"]]
    if len(errors_m) != WAY_POINTS - BENT_AFTER or any(error is None or error > 0.003 for error in errors_m[4:]):
        raise Failed(f"the bent arm: {after}")
    if max(error or 0 for error in errors_m[:4]) < 0.003 and after["probes"] == 0 and after["moves"] <= len(errors_m):
        raise Failed(f"nothing was bent: {after}")
    print("errors [mm]:", [error if error is None else round(error * 1e3, 1) for error in errors_m], "probes:", after["probes"])
    run(work, "release")


in_a_folder(main)
