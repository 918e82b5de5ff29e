"""The robots of foreign_robots.py: FAMILIES of generators, each of random numbers and a seed -> a recording (record()).

Nothing is shared with the project. Units: m, rad, s; `X_AB` is the pose of B in A; arrays of poses have one 4x4 matrix an instant.
"""
from types import SimpleNamespace

import numpy as np

DEG = np.pi / 180
X, Y, Z = np.eye(3)

# --- Geometry

def exp_so3(w):
    """Rotation matrices of rotation vectors, (..., 3)."""
    w = np.asarray(w, float)
    angle = np.linalg.norm(w, axis=-1)[..., None, None]
    k = np.zeros(w.shape + (3,))
    k[..., 0, 1], k[..., 0, 2], k[..., 1, 2] = -w[..., 2], w[..., 1], -w[..., 0]
    k -= np.swapaxes(k, -1, -2)
    return np.eye(3) + np.sinc(angle / np.pi) * k + 0.5 * np.sinc(angle / (2 * np.pi)) ** 2 * (k @ k)

def pose(p=(0, 0, 0), w=(0, 0, 0)):
    """Poses of positions and rotation vectors, (..., 3)."""
    p, w = np.broadcast_arrays(np.asarray(p, float), np.asarray(w, float))
    T = np.zeros(p.shape[:-1] + (4, 4))
    T[..., :3, :3], T[..., :3, 3], T[..., 3, 3] = exp_so3(w), p, 1
    return T

def angle_of(R):
    return 2 * np.arcsin(np.clip(np.linalg.norm(R - np.eye(3), axis=(-2, -1)) / np.sqrt(8), 0, 1))

def quaternions_wxyz(R):
    d = np.diagonal(R, axis1=-2, axis2=-1)
    q = 0.5 * np.sqrt(np.maximum(1 + d @ np.array([(1, 1, -1, -1), (1, -1, 1, -1), (1, -1, -1, 1)]), 0))
    for i, (a, b) in enumerate([(2, 1), (0, 2), (1, 0)], 1):
        q[..., i] = np.copysign(q[..., i], R[..., a, b] - R[..., b, a])
    return q / np.linalg.norm(q, axis=-1, keepdims=True)

def unit(rng):
    return (v := rng.normal(0, 1, 3)) / np.linalg.norm(v)

def placed(rng, size=0.05):
    """Pose of a marker on its link."""
    return pose(rng.uniform(-size, size, 3), rng.normal(0, 1, 3))

def frames_of(joints, q):
    """Joints are (parent frame, constant transform before, axis, slides, input); frame 0 is the base, joint i moves frame i + 1."""
    frames = [np.broadcast_to(np.eye(4), (len(q), 4, 4))]
    for parent, before, axis, slides, signal in joints:
        step = q[:, signal, None] * axis
        frames.append(frames[parent] @ before @ (pose(step) if slides else pose(w=step)))
    return frames

def tree(joints, markers):
    """Body: inputs of joints (n, m) -> {part: poses in the world}; `markers`: {part: (frame, pose of the marker in it)}."""
    def body(q):
        frames = frames_of(joints, q)
        return {part: frames[frame] @ X_FM for part, (frame, X_FM) in markers.items()}
    return body

def marked(rng, joints, size=0.05, frames=None):
    """One marker on every frame, or on those named; part 1 is on the base."""
    return tree(joints, {frame + 1: (frame, placed(rng, size)) for frame in frames or range(len(joints) + 1)})

def serial_joints(rng, n):
    axes = np.cumsum(np.r_[2, rng.choice([1, 2, 3], n, p=[.4, .4, .2])]) % 3
    before = lambda: pose([rng.uniform(-.05, .05), rng.uniform(-.05, .05), rng.uniform(.12, .3)])
    return [(i, before(), np.eye(3)[axes[i]], False, i) for i in range(n)]

def dh_joints(rng):
    """Joints of a six-axis industrial arm, about 0.9 m long, and the transform from the last to the flange."""
    d = np.array([.089, 0, 0, .109, .095, .082]) * rng.uniform(.8, 1.2, 6)
    a = np.array([0, -.425, -.392, 0, 0, 0]) * rng.uniform(.8, 1.2, 6)
    alpha = np.array([90, 0, 0, 90, -90, 0]) * DEG
    after = [pose([a[i], 0, d[i]], [alpha[i], 0, 0]) for i in range(6)]
    return [(i, after[i - 1] if i else np.eye(4), Z, False, i) for i in range(6)], after[5]

# --- Recordings

def noisy(rng, T, position_sd, rotation_sd, memory=0.0):
    """Readings with Gaussian noise; `memory` is its correlation from one instant to the next."""
    e = rng.normal(0, 1, (len(T), 6))
    for i in range(1, len(T) if memory else 0):
        e[i] = memory * e[i - 1] + np.sqrt(1 - memory ** 2) * e[i]
    return pose(position_sd * e[:, :3]) @ T @ pose(w=rotation_sd * e[:, 3:])

def record(rng, seed, body, low, high, n=None, drive=None, camera=None, noise=(1e-3, .4 * DEG), inputs=None, distance=1.8):
    """Poses at rest in random order; `drive` changes inputs by their history, `camera` poses in its frame. A recording has the inputs that
    perfect drives would follow, the same as commands, what the camera would read without random noise (`seen`), what it reads (`read`), the
    mask of instants to learn from (`train`), the parts of which positions alone are seen, and masks of where parts are seen, if not always."""
    low, high = np.broadcast_arrays(np.asarray(low, float), np.asarray(high, float))
    inputs = rng.uniform(low, high, (2 * (n or int(rng.integers(60, 201))), len(low))) if inputs is None else inputs
    X_CW = pose([.05, .1, distance], rng.normal(0, 1.5, 3))
    seen = {part: X_CW @ T for part, T in body(drive(inputs) if drive else inputs).items()}
    seen = camera(seen) if camera else seen
    position_sd, rotation_sd = np.array(noise) * rng.uniform(.5, 1.5)
    return SimpleNamespace(
        body=body, inputs=inputs, commands=(inputs - rng.uniform(-.3, .3, len(low))) / rng.choice([1, DEG]), times=2.0 * np.arange(len(inputs)),
        seen=seen, read={part: noisy(rng, T, position_sd, rotation_sd) for part, T in seen.items()}, positions_only=set(), visible={},
        position_sd=position_sd, rotation_sd=rotation_sd, train=rng.permutation(len(inputs)) < len(inputs) // 2, told=seed % 2 == 1)

def backlash(rng, half):
    """Drives that stop short by `half` on the side that they come from."""
    return lambda u: u - half * np.sign(np.diff(u, axis=0, prepend=u[:1] + rng.choice([-1, 1], u.shape[1])))

def play(rng, half):
    """Play operator: the output is pushed by the input, at a distance of up to `half`."""
    def drive(u):
        out = u + half * rng.uniform(-1, 1, u.shape[1])
        for i in range(1, len(u)):
            out[i] = np.clip(out[i - 1], u[i] - half, u[i] + half)
        return out
    return drive

def record_stream(rng, seed, delay, memory, slip=None, seconds=60, num_rests=200):
    """Smooth motion of four joints at 30 Hz to learn from; poses at rest are held out. `slip`: the transform by which the tool's marker moves
    half way through the stream; so it has at every second pose at rest."""
    t = np.arange(30 * seconds) / 30
    f, phase = rng.uniform(.05, .35, (3, 4)), rng.uniform(0, 2 * np.pi, (3, 4))
    at = lambda t: .5 * np.sin(2 * np.pi * f * t[:, None, None] + phase).sum(1)
    rests = rng.uniform(.9 * at(t).min(0), .9 * at(t).max(0), (num_rests, 4))
    body = marked(rng, serial_joints(rng, 4))
    rec = record(rng, seed, body, [0] * 4, 1, inputs=np.vstack([at(t), rests]), drive=lambda u: np.vstack([at(t - delay), rests]))
    rec.times = np.concatenate([t, t[-1] + 10 + 2.0 * np.arange(num_rests)])
    rec.train = np.arange(len(rec.times)) < len(t)
    if slip is not None:
        slipped = np.where(rec.train, rec.times > seconds / 2, np.arange(len(rec.times)) % 2 == 0)
        rec.seen[5] = np.where(slipped[:, None, None], rec.seen[5] @ slip, rec.seen[5])
    rec.read = {part: noisy(rng, T, rec.position_sd, rec.rotation_sd, memory) for part, T in rec.seen.items()}
    return rec

# --- Families: generators of random numbers, seed -> Recording

FAMILIES = {}
def family(name): return lambda generate: FAMILIES.setdefault(name, generate)
def industrial(rng, seed, parts, n=None):
    joints, tool = dh_joints(rng)
    markers = {1: (0, placed(rng)), 2: (6, tool @ placed(rng))}
    return record(rng, seed, marked(rng, joints, frames=range(parts)) if parts > 2 else tree(joints, markers), [-2] * 6, 2, n=n, drive=backlash(rng, .5 * DEG))
family("01 industrial, hysteresis")(lambda rng, seed: industrial(rng, seed, 7))
family("02 industrial, hysteresis, ends only")(lambda rng, seed: industrial(rng, seed, 2, 200))
@family("03 industrial, droop, ends only")
def _(rng, seed):
    """Equal masses at the joints and at the tool turn each joint by up to 1 degree; the first joint's axis is vertical."""
    joints, tool = dh_joints(rng)
    stiff = tree(joints, {1: (0, placed(rng)), 2: (6, tool @ placed(rng))})
    def torques(q):
        axes = [T @ joint[1] for T, joint in zip(frames_of(joints, q), joints)]
        arms = [sum(mass[:, :3, 3] - axes[i][:, :3, 3] for mass in axes[i + 1:] + [stiff(q)[2]]) for i in range(6)]
        return np.stack([np.sum(T[:, :3, 2] * np.cross(arm, -Z), 1) for T, arm in zip(axes, arms)], 1)
    softness = DEG / np.abs(torques(rng.uniform(-2, 2, (2000, 6)))).max()
    return record(rng, seed, lambda q: stiff(q + softness * torques(q)), [-2] * 6, 2, n=200)
@family("04 remote centre, tendons")
def _(rng, seed):
    joints = [(0, pose([.3, 0, .4]), Z, False, 0), (1, np.eye(4), Y, False, 1), (2, np.eye(4), X, True, 2), (3, np.eye(4), X, False, 3)]
    drive = play(rng, np.array([1 * DEG, 1 * DEG, 1e-3, 3 * DEG]))
    return record(rng, seed, marked(rng, joints, .12), [-1, -.7, 0, -2.5], [1, .7, .2, 2.5], drive=drive, distance=1)
def soft_arm(rng, seed, hysteresis):
    """Two or three sections of constant curvature. Inputs are lengths: of two tendons, which bend, or three chambers, which also stretch."""
    sections, tendons, length, radius = *rng.integers(2, 4, 2), rng.uniform(.1, .16), rng.uniform(.012, .02)
    around = rng.uniform(0, 2 * np.pi) + 2 * np.pi / 3 * np.arange(3)
    tags = [placed(rng, .03) for _ in range(sections + 1)]
    def section(u):
        bend = u / radius if tendons == 2 else 2 / 3 / radius * u @ np.stack([np.cos(around), np.sin(around)], 1)
        arc = length + (0 if tendons == 2 else u.mean(1))
        theta = np.maximum(np.linalg.norm(bend, axis=1), 1e-9)
        aside, along = arc * (1 - np.cos(theta)) / theta ** 2, arc * np.sin(theta) / theta
        return pose(np.column_stack([bend * aside[:, None], along]), np.column_stack([-bend[:, 1], bend[:, 0], 0 * theta]))
    def body(u):
        T, out = np.broadcast_to(np.eye(4), (len(u), 4, 4)), {}
        for i, tag in enumerate(tags):
            T = T @ section(u[:, tendons * (i - 1):tendons * i]) if i else T
            out[i + 1] = T @ tag
        return out
    reach = radius * (.7 if tendons == 2 else .9)
    drive = play(rng, hysteresis * reach)
    return record(rng, seed, body, [-reach] * (sections * tendons), reach, n=200, noise=(3e-4, .3 * DEG), distance=.7, drive=drive)
family("05 soft arm")(lambda rng, seed: soft_arm(rng, seed, 0))
family("06 soft arm, hysteresis")(lambda rng, seed: soft_arm(rng, seed, .1))
def moving_camera(rng, seed, share_of):
    """The camera moves by 10 mm and 2 degrees while part 1, its fixed reference, is given as constant; `share_of` instants in 0 ... 1."""
    by, turn = 1e-2 * unit(rng), 2 * DEG * unit(rng)
    def camera(seen):
        share = share_of(np.linspace(0, 1, len(seen[1])))[:, None]
        return {part: T if part == 1 else pose(share * by, share * turn) @ T for part, T in seen.items()}
    rec = record(rng, seed, marked(rng, serial_joints(rng, 5)), [-1.3] * 5, 1.3, camera=camera)
    rec.read[1] = rec.seen[1].copy()
    return rec
family("07 camera drifts, root constant")(lambda rng, seed: moving_camera(rng, seed, lambda s: s))
family("08 camera bumped, root constant")(lambda rng, seed: moving_camera(rng, seed, lambda s: 1.0 * (s > .5)))
@family("09 four-bar, parallelogram")
def _(rng, seed):
    """Even seeds: a parallelogram; odd ones: crank and rocker. Ground 1, crank 2, rocker 3, coupler 4, a tool that turns on it 5."""
    crank_rocker = np.array([.09, .2, .16, .21]) * rng.uniform(.95, 1.05, 4)
    a, b, c, g = rng.uniform(.8, 1.6) * (crank_rocker if seed % 2 else np.array([.15, .25, .15, .25]))
    tags = [placed(rng, .03) for _ in range(5)]
    def body(q):
        B = a * np.exp(1j * q[:, 0])
        to_D = g - B
        elbow = np.arccos((b ** 2 + np.abs(to_D) ** 2 - c ** 2) / (2 * b * np.abs(to_D)))
        C = B + b * to_D / np.abs(to_D) * np.exp(1j * elbow) if seed % 2 else B + b
        link = lambda at, to: pose(np.column_stack([at.real, at.imag, 0 * at.real]), np.outer(np.angle(to - at), Z))
        frames = [link(0 * B, 0 * B + g), link(0 * B, B), link(0 * B + g, C), link(B, C)]
        frames.append(frames[3] @ pose([b, 0, .03]) @ pose(w=np.outer(q[:, 1], Y)))
        return {part: T @ tag for part, (T, tag) in enumerate(zip(frames, tags), 1)}
    return record(rng, seed, body, [.4, -1.5], [2.7, 1.5], distance=1.2)
@family("10 wheels")
def _(rng, seed):
    """Wheels 4 to 7 turn 3 to 10 times; one signal steers the front ones. The chassis drives about in odd seeds."""
    at = lambda x, y: pose([.2 * x, .15 * y, -.05])
    joints = [(0, at(1, 1), Z, False, 4), (0, at(1, -1), Z, False, 4), (1, pose(), Y, False, 0), (2, pose(), Y, False, 1),
              (0, at(-1, 1), Y, False, 2), (0, at(-1, -1), Y, False, 3)]
    high = np.r_[[rng.uniform(3, 10) * np.pi] * 4, .5]
    def drive_about(seen):
        X = pose(rng.uniform(-.3, .3, (len(seen[1]), 3)), np.outer(rng.uniform(-1, 1, len(seen[1])), Z))
        return {part: X @ T for part, T in seen.items()}
    return record(rng, seed, marked(rng, joints, .06, [0, 3, 4, 5, 6]), -high, high, camera=drive_about if seed % 2 else None)
def tracked(rng, seed, joints, markers, high):
    """All parts but 1 by positions alone."""
    rec = record(rng, seed, tree(joints, markers), -np.array(high), high, noise=(5e-4, .2 * DEG))
    rec.positions_only = set(markers) - {1}
    return rec
@family("11 motion capture, positions only")
def _(rng, seed):
    """Three markers a link of an arm of two or three joints, spatial or planar; the base is a body with orientation in even seeds."""
    num, first = 2 + seed // 2 % 2, 1 - seed % 2
    planar = [(i, pose([.25 if i else 0, 0, .02]), Z, False, i) for i in range(num)]
    markers = {10 * frame + 10 + k: (frame, pose(rng.uniform(-.1, .1, 3))) for frame in range(first, num + 1) for k in (1, 2, 3)}
    markers |= {1: (0, placed(rng))} if first else {}
    return tracked(rng, seed, planar if rng.random() < .5 else serial_joints(rng, num), markers, [1.5] * num)
@family("12 pan-tilt, positions only")
def _(rng, seed):
    joints = [(0, pose([0, 0, .1]), Z, False, 0), (1, pose([.01, 0, .06]), Y, False, 1)]
    markers = {part: (1 if part == 2 else 2, pose(rng.uniform(-.08, .1, 3))) for part in (2, 3, 4, 5)}
    return tracked(rng, seed, joints, {1: (0, placed(rng))} | markers, [1.5, .8])
@family("13 humanoid, 40 % visible")
def _(rng, seed):
    """Pelvis, waist 2, neck 2 or 3, arms of 6 or 7, two fingers a hand: 20 to 23 joints."""
    joints, dof = [], int(rng.integers(6, 8))
    def add(parent, axes, first, step=lambda: [0, 0, .05]):
        for i, axis in enumerate(axes):
            joints.append((len(joints) if i else parent, pose(step() if i else first), axis, False, len(joints)))
        return len(joints)
    chest = add(0, [Z, Y], [0, 0, .1])
    add(chest, [Z, Y, X][:int(rng.integers(2, 4))], [0, 0, .45])
    for side in (1, -1):
        link = lambda: [rng.uniform(-.02, .02), rng.uniform(-.02, .02), -rng.uniform(.05, .15)]
        hand = add(chest, [Y, X, Z, Y, Z, Y, X][:dof], [0, .2 * side, .35], link)
        add(hand, [Y], [-.03, 0, -.08]), add(hand, [Y], [.03, 0, -.08])
    rec = record(rng, seed, marked(rng, joints), [-1.1] * len(joints), 1.1, n=200)
    rec.visible = {part: rng.random(len(rec.times)) < .4 for part in rec.seen}
    return rec
@family("14 coupled finger")
def _(rng, seed):
    """The input is the tendon's length; the last phalanx begins to bend late."""
    lengths, most = np.array([.08, .045, .028]) * rng.uniform(.9, 1.2), rng.uniform(.8, 1.2, 3)
    links = marked(rng, [(i, pose([lengths[i], 0, 0]), Y, False, i) for i in range(3)], .01)
    def body(u):
        s = u[:, 0] / .03
        return links(most * np.stack([1.5 * (1 - np.exp(-2.5 * s)), 1.7 * s ** 2, .15 * np.log1p(np.exp(12 * (s - .5)))], 1))
    return record(rng, seed, body, [0], .03, noise=(3e-4, .5 * DEG), distance=.4)
family("15 stream, delay, correlated noise")(lambda rng, seed: record_stream(rng, seed, .08, np.exp(-1 / 30 / .3)))
family("16 stream, tool marker slips")(lambda rng, seed: record_stream(rng, seed, 0, 0, slip=pose(8e-3 * unit(rng))))
@family("17 differential wrist")
def _(rng, seed):
    """Forearm by q1, wrist by half sum and half difference of q2 and q3; the pitching part is not seen in every second pair of seeds."""
    joints = [(0, pose([0, 0, .3]), Y, False, 0), (1, pose([0, 0, .25]), X, False, 1), (2, pose([0, 0, .05]), Z, False, 2)]
    wrist = marked(rng, joints, .04, [0, 1, 3] if seed % 4 >= 2 else None)
    body = lambda q: wrist(np.stack([q[:, 0], (q[:, 1] + q[:, 2]) / 2, (q[:, 1] - q[:, 2]) / 2], 1))
    return record(rng, seed, body, [-1.2, -1.5, -1.5], [1.2, 1.5, 1.5])
@family("18 planar five-bar, ends only")
def _(rng, seed):
    """The marker at the tip sits on the left distal link."""
    near, far, half = .15 * rng.uniform(.9, 1.1), .26 * rng.uniform(.95, 1.1), rng.uniform(.03, .06)
    base, tip_tag = placed(rng, .03), placed(rng, .03)
    def body(q):
        left, right = near * np.exp(1j * q[:, 0]) - half, near * np.exp(1j * q[:, 1]) + half
        across = right - left
        tip = (left + right) / 2 + 1j * across / np.abs(across) * np.sqrt(far ** 2 - np.abs(across) ** 2 / 4)
        X_BT = pose(np.stack([tip.real, tip.imag, 0 * tip.real], 1), np.outer(np.angle(tip - left), Z))
        return {1: np.broadcast_to(base, X_BT.shape), 2: X_BT @ tip_tag}
    return record(rng, seed, body, [1.5, .2], [2.9, 1.6], n=200, noise=(5e-4, .3 * DEG), distance=1)
@family("19 quantised, saturating")
def _(rng, seed):
    """Even seeds: joints move in steps of 2, 3 or 4 degrees; odd ones: they stop 20 % before the ends of the commands."""
    step, arm = DEG * rng.choice([2, 3, 4]), marked(rng, serial_joints(rng, 5))
    return record(rng, seed, lambda q: arm(np.clip(q, -1.2, 1.2) if seed % 2 else step * np.round(q / step)), [-1.5] * 5, 1.5)
def five_joints(rng, seed, camera=None):
    return record(rng, seed, marked(rng, serial_joints(rng, 5)), [-1.4] * 5, 1.4, camera=camera)
@family("20 tags 1-3 % wrong")
def _(rng, seed):
    def scale(T):
        factor = 1 + rng.choice([-1, 1]) * rng.uniform(.01, .03)
        return np.concatenate([T[:, :, :3], T[:, :, 3:] * np.array([factor] * 3 + [1])[:, None]], axis=2)
    return five_joints(rng, seed, lambda seen: {part: scale(T) for part, T in seen.items()})
@family("21 lens, 5 mm at the rim")
def _(rng, seed):
    sign = rng.choice([-1, 1])
    def camera(seen):
        rays = {part: T[:, :2, 3] / T[:, 2:3, 3] for part, T in seen.items()}
        rim = max(np.linalg.norm(r, axis=1).max() for r in rays.values())
        radius = lambda ray: np.linalg.norm(ray, axis=1, keepdims=True) / rim
        return {part: pose(sign * 5e-3 * np.pad(ray / rim * radius(ray) ** 2, ((0, 0), (0, 1)))) @ seen[part] for part, ray in rays.items()}
    return five_joints(rng, seed, camera)
@family("22 gross outliers 10 %")
def _(rng, seed):
    rec = five_joints(rng, seed)
    for T in rec.read.values():
        bad = np.flatnonzero(rng.random(len(T)) < .1)
        T[bad] = pose(rng.uniform(-.4, .4, (len(bad), 3))) @ T[bad] @ pose(w=rng.normal(0, 1, (len(bad), 3)))
    return rec
@family("23 flips 15 %")
def _(rng, seed):
    """Of the six tags of a cube the camera takes the one that faces it best; a flip mirrors its normal at the line of sight."""
    rec = five_joints(rng, seed)
    faces = [pose(w=w * np.pi / 2) @ pose([0, 0, -.03]) for w in (0 * X, 2 * X, X, -X, Y, -Y)]
    for T in rec.read.values():
        for i in np.flatnonzero(rng.random(len(T)) < .15):
            face = max(faces, key=lambda face: (T[i] @ face)[:3, 2] @ (T[i] @ face)[:3, 3])
            X_CM = T[i] @ face
            sight = X_CM[:3, 3] / np.linalg.norm(X_CM[:3, 3])
            axis = np.cross(X_CM[:3, 2], sight)
            angle = 2 * np.arctan2(np.linalg.norm(axis), X_CM[:3, 2] @ sight)
            X_CM[:3, :3] = exp_so3(angle * axis / np.linalg.norm(axis)) @ X_CM[:3, :3]
            T[i] = X_CM @ np.linalg.inv(face)
    return rec
@family("24 heavy tails, distance, oblique")
def _(rng, seed):
    """Student's t of 3 degrees of freedom; grows with the square of the distance and as a tag turns away, and is thrice as large in depth."""
    rec, squares = five_joints(rng, seed), []
    for part, T in rec.seen.items():
        depth = np.linalg.norm(T[:, :3, 3], axis=1, keepdims=True)
        sight = T[:, :3, 3] / depth
        size = (depth / 1.8) ** 2 / np.abs(np.einsum("nij,ni->nj", T[:, :3, :3], sight)).max(1, keepdims=True)
        e = size * rng.standard_t(3, (len(T), 6)) / np.sqrt(3)
        deeper = e[:, :3] + 2 * sight * np.sum(e[:, :3] * sight, 1, keepdims=True)
        rec.read[part] = pose(rec.position_sd * deeper) @ T @ pose(w=rec.rotation_sd * e[:, 3:])
        squares.append(np.mean(size ** 2))
    rec.position_sd, rec.rotation_sd = np.array([rec.position_sd * np.sqrt(11 / 3), rec.rotation_sd]) * np.sqrt(np.mean(squares))
    return rec
family("25 industrial, hysteresis, wrist not seen")(lambda rng, seed: industrial(rng, seed, 5))
@family("26 eyes, version and vergence")
def _(rng, seed):
    """A neck of two joints; both eyes tilt by q3 and turn by q4 and half of q5 to either side."""
    tags = [placed(rng, .02) for _ in range(4)]
    def body(q):
        head = pose([0, 0, .1]) @ pose(w=np.outer(q[:, 0], Y)) @ pose(w=np.outer(q[:, 1], Z))
        eye = lambda side: head @ pose([.05, .035 * side, .06]) @ pose(w=np.outer(q[:, 2], Y)) @ pose(w=np.outer(q[:, 3] + side * q[:, 4] / 2, Z))
        return {part: T @ tag for part, (T, tag) in enumerate(zip([np.broadcast_to(np.eye(4), head.shape), head, eye(1), eye(-1)], tags), 1)}
    return record(rng, seed, body, [-.5, -1, -.4, -.5, 0], [.5, 1, .4, .5, .4], noise=(5e-4, .4 * DEG), distance=.8)
@family("27 part that hangs")
def _(rng, seed):
    """From a hook of the last of four links; odd seeds: it turns about the vertical with the hook."""
    joints, tag = serial_joints(rng, 4), placed(rng, .03)
    arm = marked(rng, joints)
    def body(q):
        hook = frames_of(joints, q)[4] @ pose([.02, 0, .1])
        yaw = np.arctan2(hook[:, 1, 0], hook[:, 0, 0]) if seed % 2 else 0 * q[:, 0]
        return arm(q) | {6: pose(hook[:, :3, 3], np.outer(yaw, Z)) @ pose([0, 0, -.12]) @ tag}
    return record(rng, seed, body, [-1.1] * 4, 1.1)
def moved_by_hand(rng, seed, parts):
    """In the last 3 to 15 % of the recording: the base under these parts, or the marker of the only one."""
    rec = record(rng, seed, marked(rng, serial_joints(rng, 4)), [-1.2] * 4, 1.2)
    late = np.arange(len(rec.times)) > len(rec.times) * (1 - rng.uniform(.03, .15))
    X_CB, moved = rec.seen[1][0], pose(rng.choice([8e-3, 15e-3, 30e-3]) * unit(rng), rng.uniform(2, 6) * DEG * unit(rng))
    for part in parts:
        T = rec.seen[part]
        rec.seen[part] = np.where(late[:, None, None], T @ moved if len(parts) == 1 else X_CB @ moved @ np.linalg.inv(X_CB) @ T, T)
        rec.read[part] = noisy(rng, rec.seen[part], rec.position_sd, rec.rotation_sd)
    return rec
family("28 base moved late")(lambda rng, seed: moved_by_hand(rng, seed, [2, 3, 4, 5]))
family("29 marker moved late")(lambda rng, seed: moved_by_hand(rng, seed, [3]))

METROLOGY = (1e-4, .02 * DEG)
@family("30 gears, ends only")
def _(rng, seed):
    """Six joints, each off by up to 0.3 degrees, one to three times around, seen by a laser tracker."""
    joints, tool = dh_joints(rng)
    around, phase, size = rng.integers(1, 4, 6), rng.uniform(0, 2 * np.pi, 6), rng.uniform(.05, .3, 6) * DEG
    body = tree(joints, {1: (0, placed(rng)), 2: (6, tool @ placed(rng))})
    return record(rng, seed, body, [-2] * 6, 2, n=200, noise=METROLOGY, drive=lambda u: u + size * np.sin(around * u + phase))
@family("31 positioner, wobbling axes")
def _(rng, seed):
    """Both axes lean by 0.02 to 0.05 degrees towards where they turn; the second turns all around."""
    size, phase, tags = rng.uniform(.02, .05, 2) * DEG, rng.uniform(0, 2 * np.pi, 2), [placed(rng), pose([.6, .3, .1], rng.normal(0, 1, 3))]
    def turn(q, i):
        lean = size[i] * np.stack([np.cos(2 * q + phase[i]), np.sin(2 * q + phase[i]), 0 * q], 1)
        return pose(w=lean) @ pose(w=np.outer(q, Z))
    def body(q):
        first = pose([0, 0, .3]) @ turn(q[:, 0], 0) @ pose([.1, 0, .2], [-np.pi / 2, 0, 0])
        return {1: np.broadcast_to(tags[0], first.shape), 2: first @ turn(q[:, 1], 1) @ tags[1]}
    return record(rng, seed, body, [-.6, -3], [.6, 3], n=150, noise=METROLOGY)
@family("32 soft arm that creeps, stream")
def _(rng, seed):
    """One section of three chambers at 10 Hz; a fifth of its bend follows within 3 s."""
    t, share, tags = np.arange(3600) / 10, rng.uniform(.1, .25), [placed(rng, .02), placed(rng, .02)]
    f, phase, around = rng.uniform(.03, .2, (3, 3)), rng.uniform(0, 2 * np.pi, (3, 3)), 2 * np.pi / 3 * np.arange(3) + rng.uniform(0, 2)
    def drive(u):
        out = u.copy()
        for i in range(1, len(u)):
            out[i] = out[i - 1] + (u[i] - out[i - 1]) / 30
        return (1 - share) * u + share * out
    def body(u):
        bend = .75 * np.tanh(1.8 * u) @ np.stack([-np.sin(around), np.cos(around), 0 * around], 1)
        half = pose(w=bend / 2)
        return {1: np.broadcast_to(tags[0], half.shape), 2: half @ pose([0, 0, .1]) @ half @ tags[1]}
    inputs = .5 * np.sin(2 * np.pi * f * t[:, None, None] + phase).sum(1)
    rec = record(rng, seed, body, [0] * 3, 1, inputs=inputs, drive=drive, noise=(3e-4, .2 * DEG), distance=.6)
    rec.times, rec.train = t, t < 180
    return rec
@family("33 wrist of tendons, ends only")
def _(rng, seed):
    """Yaw, pitch, insertion, roll and a wrist of two joints, each of which moves with both of its motors."""
    axes, slides = [Z, Y, X, X, Y, Z], [False, False, True, False, False, False]
    joints = [(i, pose([[.3, 0, .4], [0, 0, 0], [0, 0, 0], [.02, 0, 0], [.05, 0, 0], [.012, 0, 0]][i]), axes[i], slides[i], i) for i in range(6)]
    mix = np.eye(6)
    mix[4, 5], mix[5, 4] = rng.uniform(.2, .5, 2) * rng.choice([-1, 1], 2)
    body = tree(joints, {1: (0, placed(rng)), 2: (6, placed(rng, .02))})
    low, high = np.array([-1, -.7, 0, -2, -1, -1]), np.array([1, .7, .2, 2, 1, 1])
    return record(rng, seed, body, low, high, n=250, noise=(2e-4, .09 * DEG), drive=lambda u: u @ mix, distance=1)
@family("34 stream, delay, velocities beside positions")
def _(rng, seed):
    rec = record_stream(rng, seed, .08, 0)
    q, t = rec.commands[rec.train], rec.times[rec.train]
    rates = np.gradient(q, t, axis=0) * (1 + .02 * rng.normal(0, 1, q.shape))
    rec.commands = np.hstack([rec.commands, np.vstack([rates, np.zeros((len(rec.times) - len(t), 4))])])
    return rec
@family("35 commands and encoders")
def _(rng, seed):
    """Drives miss their commands by 0.02 to 0.5 degrees, as encoders report; by the last four signals the body moves."""
    arm, u = marked(rng, serial_joints(rng, 4)), rng.uniform(-1.2, 1.2, (200, 4))
    inputs = np.hstack([u, u + rng.choice([.02, .1, .5]) * DEG * rng.normal(0, 1, u.shape)])
    return record(rng, seed, lambda q: arm(q[:, 4:]), [-1.2] * 8, 1.2, inputs=inputs)
@family("36 hard stop")
def _(rng, seed):
    """The second joint stops for a part of its range."""
    arm, stop = marked(rng, serial_joints(rng, 4)), rng.uniform(-.6, .6)
    return record(rng, seed, lambda q: arm(np.column_stack([q[:, 0], np.maximum(q[:, 1], stop), q[:, 2:]])), [-1.2] * 4, 1.2)
@family("37 one joint at a time, ends only")
def _(rng, seed):
    """A range check to learn from; joints are not in the order of the columns, and rest where they begin. Odd seeds: a few poses of all joints too."""
    order, few = rng.permutation(3), 4 * (seed % 2)
    arm = marked(rng, serial_joints(rng, 3), frames=[0, 3])
    sweeps = np.vstack([np.linspace(-1, 1, 30)[:, None] * np.eye(3)[j] for j in range(3)])
    inputs = np.vstack([sweeps, rng.uniform(-.5, .5, (few, 3)), rng.uniform(-.9, .9, (100, 3))])
    rec = record(rng, seed, lambda q: arm(q[:, order]), [0] * 3, 1, inputs=inputs)
    rec.train = np.arange(len(inputs)) < 90 + few
    return rec
@family("38 object in the hand or on the table")
def _(rng, seed):
    rec = record(rng, seed, marked(rng, serial_joints(rng, 4)), [-1.2] * 4, 1.2)
    laid, table = rng.random(len(rec.times)) < rng.uniform(.1, .45), rec.seen[1] @ placed(rng, .4)
    rec.seen[5] = np.where(laid[:, None, None], table, rec.seen[5])
    rec.read[5] = noisy(rng, rec.seen[5], rec.position_sd, rec.rotation_sd)
    return rec
@family("39 joint that moves in few poses")
def _(rng, seed):
    """One joint rests but for 5 to 14 % of the poses."""
    inputs, j = rng.uniform(-1.2, 1.2, (200, 4)), seed % 4
    inputs[:, j] = np.where(rng.random(200) < rng.uniform(.05, .14), inputs[:, j], 0)
    return record(rng, seed, marked(rng, serial_joints(rng, 4)), [-1.2] * 4, 1.2, inputs=inputs)
@family("40 joint that is not recorded")
def _(rng, seed):
    """One of the joints between two parts stands elsewhere in 10 to 18 % of the poses, and no signal tells."""
    arm, inputs = marked(rng, serial_joints(rng, 5), frames=[0, 2, 5]), rng.uniform(-1.2, 1.2, (200, 4))
    state = np.where(rng.random(200) < rng.uniform(.1, .18), rng.uniform(.2, .6), 0)
    return record(rng, seed, lambda q: arm(np.insert(q, 3, state[:len(q)], axis=1)), [-1.2] * 4, 1.2, inputs=inputs)
@family("41 tracker's frame, ends only")
def _(rng, seed):
    """The tracker's frame, 1 to 2 m away, is part 1: its pose is the same in all rows, to the last digit."""
    joints, tool = dh_joints(rng)
    away = pose(rng.uniform(1, 2) * unit(rng), rng.normal(0, 1, 3))
    rec = record(rng, seed, tree(joints, {1: (0, away), 2: (6, tool @ placed(rng))}), [-1.5] * 6, 1.5, n=120, noise=(4e-4, .8 * DEG))
    rec.read[1] = rec.seen[1].copy()
    return rec
@family("42 stream, joint that mostly rests")
def _(rng, seed):
    """One of four joints moves in the first 2 to 5 s of each 20 s alone."""
    t, lasts, j = np.arange(1800) / 30, rng.uniform(2, 5), seed % 4
    f, phase = rng.uniform(.05, .35, (3, 4)), rng.uniform(0, 2 * np.pi, (3, 4))
    inputs = .5 * np.sin(2 * np.pi * f * t[:, None, None] + phase).sum(1)
    inputs[:, j] = np.where(t % 20 < lasts, .8 * np.sin(np.pi * (t % 20) / lasts) ** 2, 0)
    rests = rng.uniform(.9 * inputs.min(0), .9 * inputs.max(0), (100, 4))
    rec = record(rng, seed, marked(rng, serial_joints(rng, 4)), [0] * 4, 1, inputs=np.vstack([inputs, rests]))
    rec.times = np.concatenate([t, 70 + 2.0 * np.arange(100)])
    rec.train = np.arange(1900) < 1800
    return rec
@family("43 booms moved by cylinders")
def _(rng, seed):
    """Slew and three hinges, each turned by a cylinder whose length is the input (law of cosines). Odd seeds: two joints between parts."""
    near, far = rng.uniform(.15, .25, 3), rng.uniform(.3, .4, 3)
    joints = [(i, pose([[0, 0, .2], [.05, 0, .1], [.5, 0, 0], [.4, 0, 0]][i]), Y if i else Z, False, i) for i in range(4)]
    booms = marked(rng, joints, frames=[0, 2, 4] if seed % 2 else None)
    angle = lambda s: np.arccos(np.clip((near ** 2 + far ** 2 - s ** 2) / (2 * near * far), -1, 1))
    length = lambda a: np.sqrt(near ** 2 + far ** 2 - 2 * near * far * np.cos(a))
    inputs = np.column_stack([rng.uniform(-1.5, 1.5, 200), length(rng.uniform(20 * DEG, 130 * DEG, (200, 3)))])
    return record(rng, seed, lambda q: booms(np.column_stack([q[:, 0], angle(q[:, 1:])])), inputs.min(0), inputs.max(0), inputs=inputs)
