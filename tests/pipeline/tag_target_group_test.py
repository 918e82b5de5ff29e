"""tag_target_group_test.py SOURCE BUILD: a group that has learned arm2 brings the end effector to a tag that floats before the camera, and after it
was put elsewhere to it there, within 3 mm by the truth. A tag that is not seen is waited for; one that is put elsewhere in the middle of the
way is held for, and served at its new place. A replay of the run makes the same schema, byte for byte."""

import json
import math
import shutil
import struct
import subprocess
import time

from group_run import Failed, build, environment, in_a_folder, run, source

TAG, END_EFFECTOR = 40, 5
LIMIT_M = 0.003
BESIDE_M = 0.1


def rig_with_tag(work, name="arm2", steps=()):
    """A copy of arm2 with a target tag, and with other values for some lines of controller.yaml."""
    rig = work / name
    shutil.copytree(source / "config" / "arm2", rig)
    for file, pose in ("markers.yaml", ""), ("robot.yaml", ", X_CM: {position_m: [0.6, -0.45, 1.9]}"):
        with open(rig / file, "a") as text:
            text.write(f"\ntarget_tags:\n  - {{id: {TAG}, size_m: 0.12{pose}}}\n")
    text = (rig / "controller.yaml").read_text()
    for old, new in steps:
        text = text.replace(old, new)
    (rig / "controller.yaml").write_text(text)
    return rig


class Payload:
    """A message as LCM writes it, from its first field on."""

    def __init__(self, data):
        self.data, self.at = data, 8

    def take(self, code, count=1):
        values = struct.unpack_from(f">{count}{code}", self.data, self.at)
        self.at += struct.calcsize(f">{count}{code}")
        return list(values)

    def text(self):
        length = self.take("i")[0]
        self.at += length

    def pose(self):
        return self.take("d", 3), self.take("d", 4)


def rotated(wxyz, v):
    w, *u = wxyz

    def cross(a, b):
        return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]

    t = [2 * c for c in cross(u, v)]
    return [a + w * b + c for a, b, c in zip(v, t, cross(u, t))]


def true_state(work):
    """(action_id, p_CB of the end effector) of the newest SIM_STATE: the fields of sim_state_t.lcm in their order."""
    log = work / "logs" / "current" / "run.lcmlog.00"
    state = Payload(subprocess.run([build / "bin/log_payloads", log, "SIM_STATE", "--last"], capture_output=True, check=True).stdout)
    _, action_id, _ = state.take("q", 3)
    state.take("b")
    state.take("q", 2)
    state.text()
    for _ in range(state.take("i")[0]):
        state.text()
    p_WC, q_WC = state.pose()
    num_geoms = state.take("i")[0]
    for _ in range(num_geoms):
        state.pose()
    state.take("f", num_geoms)
    parts = state.take("i", state.take("i")[0])
    poses = [state.pose() for _ in parts]
    p_WB = poses[parts.index(END_EFFECTOR)][0]
    q_CW = [q_WC[0], *(-c for c in q_WC[1:])]
    return action_id, rotated(q_CW, [b - c for b, c in zip(p_WB, p_WC)])


def error_m(work, p_CM):
    """From the end effector to the tag, by the truth of where the arm rests now."""
    arm = json.loads(run(work, "exec", "bodyschema", "status", "--json")[0])["arm"]
    action_id = arm["action_id"] - (arm["state"] == "holding")  # a HOLD moves nothing
    for _ in range(50):
        at, p_CB = true_state(work)
        if at == action_id:
            return math.dist(p_CB, p_CM)
        time.sleep(0.1)  # until the logger has written it
    raise Failed(f"SIM_STATE of action {action_id} is not in the log, its newest is of {at}: {arm}")


def position(work, *action):
    """Of the end effector in the root's and in the camera's frame, by the schema."""
    schema = work / "logs" / "current" / "schema.lcmlog"
    parts = json.loads(run(work, "predict", schema, "--action", *action, "--json")[0])["parts"]
    p_RB = next(part["X_RB"]["position_m"] for part in parts if part["part"] == END_EFFECTOR)
    X_CR = json.loads(run(work, "show", schema, "--json")[0])["X_CR"]
    return p_RB, [c + r for c, r in zip(X_CR["position_m"], rotated(X_CR["rotation_wxyz"], p_RB))]


def aim_while(work, name, act, *options):
    """What `target` says of a tag while act(heard) disturbs it; heard(text) waits for it to say so."""
    with open(work / name, "w+") as says:
        words = [source / "run", "target", "--part", str(END_EFFECTOR), "--tag", str(TAG), *map(str, options)]
        target = subprocess.Popen(words, env=environment(work), stdin=subprocess.DEVNULL, stdout=says, stderr=says)

        def heard(words):
            for _ in range(400):
                if words in (work / name).read_text():
                    return
                time.sleep(0.05)

        act(heard)
        try:
            code = target.wait(timeout=60)
        except subprocess.TimeoutExpired:
            target.terminate()
            code = target.wait(timeout=20)
    return code, (work / name).read_text()


def wait_for_tag(work, p_CM):
    """A target whose tag stands behind the camera is served once it is put to p_CM."""
    run(work, "fault", "target", TAG, 0, 0, -1)
    unseen = "is not seen: the arm holds until 2 frames"

    def show(heard):
        heard(unseen)
        run(work, "fault", "target", TAG, *(f"{c:.6f}" for c in p_CM))

    code, text = aim_while(work, "wait.txt", show)
    if code != 0 or unseen not in text:
        raise Failed(f"the tag was not waited for: {text}")


def jump_on_the_way(work):
    """The tag is put elsewhere between two of many steps. It floats beside what the hand reaches, so that the arm never hides it."""
    steps = ("max_step: 0.25", "max_step: 0.02"), ("slow_step: 0.05", "slow_step: 0.02"), ("search_step: 0.1", "search_step: 0.01")
    rig = rig_with_tag(work, "small_steps", steps)
    run(work, "rig", rig)
    run(work, "--rig", rig, "--ideal", "--seed", 4, "--samples", 30, "--keep")
    (p_RB, right), (_, left) = position(work, 0, 29), position(work, 0, -29)
    run(work, "target", "--part", END_EFFECTOR, "--position", *p_RB)
    left[0] -= BESIDE_M
    right[0] += BESIDE_M

    def jump(heard):
        heard("towards the target")
        run(work, "fault", "target", TAG, *(f"{c:.6f}" for c in right))

    run(work, "fault", "target", TAG, *(f"{c:.6f}" for c in left))
    code, text = aim_while(work, "jump.txt", jump, "--tolerance", 2 * BESIDE_M)
    if code != 0:
        raise Failed(f"the tag that jumped was not reached: {text}")
    if f"target tag {TAG} moved by" not in text:
        raise Failed(f"the arm did not hold when the tag jumped: {text}")
    error = error_m(work, right)
    run(work, "stop")
    if error > 2 * BESIDE_M + LIMIT_M:
        raise Failed(f"{error} m off after a jump")


def main(work):
    rig = rig_with_tag(work)
    run(work, "rig", rig)
    run(work, "--rig", rig, "--ideal", "--seed", 4, "--samples", 30, "--keep")
    p_RB, _ = position(work, 0, 0)
    run(work, "target", "--part", END_EFFECTOR, "--position", *p_RB)
    errors = []
    for action in (0, 29), (0, 0):  # from which the arm does not hide the tag
        _, p_CM = position(work, *action)
        moved = run(work, "fault", "target", TAG, *(f"{c:.6f}" for c in p_CM))[0]
        if f"target {TAG} at " not in moved:
            raise Failed(f"the tag was not put there: {moved}")
        out, err = run(work, "target", "--part", END_EFFECTOR, "--tag", TAG, "--json", codes=(0, 1))
        result = json.loads(out)
        errors.append(error_m(work, p_CM))
        if not result["reached"] or errors[-1] > LIMIT_M:
            raise Failed(f"{errors} m off: {result} {err}")
        if "give the target again" not in err:
            raise Failed(f"it does not say what to do next: {err}")
    _, p_CM = position(work, 0, 29)
    wait_for_tag(work, p_CM)
    errors.append(error_m(work, p_CM))
    if errors[-1] > LIMIT_M:
        raise Failed(f"{errors} m off")
    print("errors [mm]:", [round(error * 1e3, 2) for error in errors])
    _, err = run(work, "target", "--part", END_EFFECTOR, "--tag", 7, "--timeout", 20, codes=(1,))
    if f"tag 7 is not in target_tags of markers.yaml: {TAG}" not in _ + err:
        raise Failed(f"a part's tag is no target: {_} {err}")
    run(work, "release")
    run(work, "stop")
    current = work / "logs" / "current"
    first = current.resolve()
    run(work, "--replay", first / "run.lcmlog.00")
    if (current / "schema.lcmlog").read_bytes() != (first / "schema.lcmlog").read_bytes():
        raise Failed("a replay makes another schema")
    jump_on_the_way(work)


in_a_folder(main)
