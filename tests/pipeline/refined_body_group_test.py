"""refined_body_group_test.py SOURCE BUILD: in a group that trusts its tags and its lens the refiner's schema becomes the body schema, for
it predicts the corners of TEST samples better than what was learned; a replay ends with the same bytes."""

import json
import re
import shutil
import subprocess
import sys

from group_run import Failed, build, in_a_folder, run, source


def edited(file, **values):
    text = file.read_text()
    for key, value in values.items():
        text, count = re.subn(rf"(?m)^( *{key}): \S+", rf"\1: {value}", text)
        if count != 1:
            raise Failed(f"{file}: {key} stands {count} times")
    file.write_text(text)


def last(log, channel):
    """The newest message of a channel."""
    return subprocess.run([build / "bin" / "log_payloads", log, channel, "--last"], capture_output=True, check=True).stdout


def shown(work, schema):
    return json.loads(run(work, "show", schema, "--json")[0])


def screws(shown):
    """All parameters but rotations, which a message and JSON round."""
    places = [edge["left"]["position_m"] + edge["right"]["position_m"] for edge in shown["edges"]]
    joints = [joint for edge in shown["edges"] for joint in edge["joints"]]
    return places, [[joint["slide_m"], joint["turn_rad"]] + joint["X_after"]["position_m"] for joint in joints]


def main(work):
    rig = work / "rig"
    shutil.copytree(source / "config" / "arm2", rig)
    # Its files are right, and noise.yaml does not know it.
    errors = "tag_position_mm tag_rotation_deg tag_size_percent focal_length_percent distortion_k1 backlash_deg droop_percent"
    edited(rig / "robot.yaml", **dict.fromkeys(errors.split(), 0))
    edited(rig / "motor_babbler.yaml", test_every=2)
    edited(
        rig / "refiner.yaml",
        enabled="true",
        refine_every=30,
        tag_position_m=0.000001,
        tag_rotation_deg=0.001,
        tag_size_share=0.000001,
        focal_length_share=0.000001,
        centre_px=0.001,
        distortion=0.000001,
    )
    current = work / "logs" / "current"
    run(work, "--rig", rig, "--seed", 1, "--samples", 40)
    first = current.resolve()
    schema = (first / "schema.lcmlog").read_bytes()
    body, refined = shown(work, first / "schema.lcmlog"), shown(work, first / "refined.lcmlog")
    if not body["refined"]:
        raise Failed("the refiner's schema did not become the body schema")
    if screws(body) != screws(refined):
        raise Failed("the body schema is refined, but is not the refiner's")
    if last(first / "run.lcmlog.00", "BODY_SCHEMA") not in schema:
        raise Failed("BODY_SCHEMA is not what was saved")

    run(work, "--replay", first / "run.lcmlog.00")
    if current.resolve() == first or (current / "schema.lcmlog").read_bytes() != schema:
        raise Failed("a replay ends with another body schema")


if not (build / "bin" / "refiner").exists():
    print("SKIP: built without Ceres", file=sys.stderr)
    sys.exit(77)
in_a_folder(main)
