#!/usr/bin/env python3
"""Lets `bodyschema learn` learn robots that are outside its model class, and judges the answers from outside.

    foreign_robots.py [--seeds N] [--family WORDS] [--keep DIR]    of the build folder that BODYSCHEMA_BUILD names

Nothing is shared with the project: generators (foreign_families.py), geometry and judge are its own.

Every family makes recordings of 2N instants, N of them to learn from, at random. Predictions of the others are compared with what the camera
would read without random noise: backlash, hysteresis, drift, slip and systematic errors of tags and lens are part of that truth. Predictions
marked as outside the training do not count. Odd seeds tell the noise (--noise). An edge is right if its signals are those that move its two
parts against each other, which is found by trying; every tree of right edges is right. Ratio: rms error / told standard deviation.
Units: m, rad, s; `X_AB` is the pose of B in A; arrays of poses have one 4x4 matrix an instant.
"""
import argparse, csv, json, os, subprocess, sys, tempfile, time
from pathlib import Path

try:
    import numpy as np
except ImportError:
    sys.exit("foreign_robots needs numpy: apt-get install python3-numpy")

from foreign_families import DEG, FAMILIES, angle_of, pose, quaternions_wxyz

LEARN_LIMIT_S = 60

def write_csv(path, rec, mask):
    quats = {part: quaternions_wxyz(T[:, :3, :3]) for part, T in rec.read.items()}
    with open(path, "w", newline="") as file:
        out = csv.writer(file)
        out.writerow(["t", *(f"q{i + 1}" for i in range(rec.commands.shape[1])), "part", "x", "y", "z", "qw", "qx", "qy", "qz"])
        for i, (part, T) in ((i, item) for i in np.flatnonzero(mask) for item in rec.read.items()):
            if part not in rec.visible or rec.visible[part][i]:
                q = [""] * 4 if part in rec.positions_only else [f"{v:.9f}" for v in quats[part][i]]
                out.writerow([f"{rec.times[i]:.6f}", *(f"{v:.9g}" for v in rec.commands[i]), part, *(f"{v:.7f}" for v in T[i, :3, 3]), *q])

def relative(poses, a, b):
    return np.linalg.inv(poses[a]) @ poses[b]

def dependence(rec, a, b):
    """Signals that clearly move b against a, and those that move it at all: each is set to other values of the recording."""
    rng, base, moved = np.random.default_rng(0), rec.inputs[:200], {}
    for i in range(base.shape[1]):
        (q := base.copy())[:, i] = rng.permutation(rec.inputs[:, i])[:len(base)]
        change = np.linalg.inv(relative(rec.body(base), a, b)) @ relative(rec.body(q), a, b)
        turn = 0 if {a, b} & rec.positions_only else angle_of(change[:, :3, :3]) / rec.rotation_sd
        moved[f"q{i + 1}"] = np.maximum(turn, np.linalg.norm(change[:, :3, 3], axis=1) / rec.position_sd) / np.sqrt(3)
    return {s for s, m in moved.items() if np.sqrt(np.mean(m ** 2)) > 3}, {s for s, m in moved.items() if m.max() > 1e-3}

def wrong_edges(rec, learned):
    """A soft edge may use signals that the answer calls undecided."""
    for edge in learned["edges"]:
        needed, possible = dependence(rec, edge["from"], edge["to"])
        used, idle = set(edge["signals"]), set(learned["undecided_signals"] if edge["kind"].endswith("_gp") else ())
        if needed - used or used - possible - idle:
            yield f"{edge['from']}-{edge['to']} uses {sorted(used)}, moved by {sorted(needed)} of {sorted(possible)}"

def compare(rec, learned, predictions):
    """Rms of the error and of what was told, as lengths, of all parts and by part."""
    index, root, errors = {round(t, 4): i for i, t in enumerate(rec.times)}, learned["root"], {}
    seen = rec.seen | ({root: pose(rec.seen[root][:, :3, 3])} if root in rec.positions_only else {})
    truth = {part: relative(seen, root, part)[:, :3, 3] for part in seen}
    with open(predictions, newline="") as file:
        for row in csv.DictReader(file):
            part = int(row["part"])
            if part != root and not row["outside_training"]:
                error = np.linalg.norm(truth[part][index[round(float(row["t"]), 4)]] - [float(row[c]) for c in "xyz"])
                errors.setdefault(part, []).append((error, np.sqrt(3) * float(row["position_sd_m"] or "nan")))
    rms = lambda v: np.sqrt(np.mean(np.square(v), axis=0))
    return rms(sum(errors.values(), [])), {part: rms(v).tolist() for part, v in errors.items()}

def judge(program, name, seed, folder):
    rec = FAMILIES[name](np.random.default_rng([int(name[:2]), seed]), seed)
    file = lambda ending: str(folder / f"{name[:2]}_{seed}_{ending}")
    write_csv(file("train.csv"), rec, rec.train), write_csv(file("held_out.csv"), rec, ~rec.train)
    noise = ["--noise", f"{rec.position_sd:.6f}", f"{rec.rotation_sd / DEG:.4f}"]
    learn = [program, "learn", file("train.csv"), "--out", file("schema.lcmlog"), "--json", *(noise if rec.told else [])]
    start = time.monotonic()
    done = subprocess.run(["timeout", str(LEARN_LIMIT_S), *learn], capture_output=True, text=True)
    result = dict(name=name, seed=seed, command=" ".join(learn), instants=int(rec.train.sum()), seconds=time.monotonic() - start, wrong=[],
                  told_noise=rec.told, reading=np.sqrt(3) * rec.position_sd, warnings=done.stderr)
    if done.returncode:
        return result | dict(verdict="slow" if done.returncode == 124 else "refused")
    Path(file("learn.json")).write_text(done.stdout)
    learned = json.loads(done.stdout)
    result["wrong"] = list(wrong_edges(rec, learned))
    if not learned["complete"]:
        return result | dict(verdict="incomplete", unconnected=learned["unconnected"])
    subprocess.run([program, "predict", file("schema.lcmlog"), file("held_out.csv"), "--out", file("predicted.csv")], check=True, capture_output=True)
    (error, told), parts = compare(rec, learned, file("predicted.csv"))
    bad = result["wrong"] or (error / told > 3 and error > 2 * result["reading"])
    return result | dict(verdict="wrong" if bad else "right", error=error, told=told, ratio=error / told, parts=parts)

def row_of(name, results):
    count = lambda verdict: sum(r["verdict"] == verdict for r in results)
    of = lambda key: [r[key] for r in results if key in r]
    mm = lambda key: f"{1e3 * np.median(of(key)):.2f} mm" if of(key) else "–"
    ratio = f"{max(of('ratio')):.2f}, {np.median(of('ratio')):.2f}" if of("ratio") else "–"
    others = "".join(f" + {count(v)} {v}" for v in ("slow", "refused") if count(v))
    return (f"| {name} | {len(results)} | {count('right')} | {count('incomplete')}{others} | {count('wrong')} | {ratio} | {mm('error')} | "
            f"{mm('told')} | {max(of('seconds')):.2f} |")

def measure(program, options):
    options.keep.mkdir(parents=True, exist_ok=True)
    columns = "family|recordings|complete right|incomplete|complete wrong|ratio among complete: worst, median|median error|told (median)|slowest s"
    print(f"| {columns.replace('|', ' | ')} |\n" + "| --- " * 9 + "|", flush=True)
    for name in (name for name in FAMILIES if any(word in name for word in options.family.split() or [""])):
        results = []
        for seed in range(options.seeds):
            results.append(r := judge(program, name, seed, options.keep))
            (options.keep / f"{name[:2]}_{seed}_verdict.json").write_text(json.dumps(r, default=float, indent=1))
            print(name, seed, r["verdict"], f"ratio {r.get('ratio', np.nan):.2f}", f"error {1e3 * r.get('error', np.nan):.2f} mm",
                  f"{r['seconds']:.2f} s", *r["wrong"], sep="; ", file=sys.stderr, flush=True)
        print(row_of(name, results), flush=True)

def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=12, help="a family")
    parser.add_argument("--family", default="", help="words; families whose name has one of them")
    parser.add_argument("--keep", type=Path, help="folder that recordings and answers are kept in")
    options = parser.parse_args()
    program = str(Path(os.environ["BODYSCHEMA_BUILD"]) / "bin/bodyschema")
    with tempfile.TemporaryDirectory() as folder:
        options.keep = options.keep or Path(folder)
        measure(program, options)

if __name__ == "__main__":
    main()
