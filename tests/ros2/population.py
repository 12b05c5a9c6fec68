"""Runs `logs` on recordings of robots on different grounds, and compares its intervals with the truth.

    python population.py LOGS [--runs N] [--seed S] [--jobs J] [--json | --markdown]

LOGS is the program. The robots are those of write_logs.py, without torque. What is drawn for each: the friction curve,
its peak, the relaxation length, what slip is relative to, the motion resistance, the height of the centre of mass, the
payload; K is one of four values, and every third robot has white noise on its wheel speeds. The program knows the mass
of the data sheet and the wheels' places. It ends with 1 if a check does not hold, and with 2 if `logs` fails.
"""

import argparse
import json
import math
import multiprocessing
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

import write_logs
from write_logs import ROBOT, WHEEL_NOISE_RAD_S, Ground

STIFFNESSES = (0.7, 1.5, 4.0, 8.0)
COVERAGE_MIN = 0.9
"""Goal for 95 % intervals on robots that are unlike the estimator's."""
HALF_WIDTH_MAX = 0.6
"""Half-width over θ above which an interval counts as no estimate."""
WHEEL_HZ = 50
LOGS_MAX_S = 600


class LogsFailed(Exception):
    """`logs` printed no result: the seed of the robot, and its output."""


def magic_formula(curvature):
    """A curve of the Magic Formula with C 1.5 and this E (Pacejka, Tire and Vehicle Dynamics, ch. 4)."""

    def curve(slip, ground):
        if slip < 1e-9:
            return ground.stiffness
        x = ground.stiffness / (1.5 * ground.peak) * slip
        return ground.peak * math.sin(1.5 * math.atan(x - curvature * (x - math.atan(x)))) / slip

    return curve


CURVES = {
    "hyperbolic tangent": write_logs.saturating,
    "bends from the beginning": write_logs.bending,
    "Magic Formula, E -1": magic_formula(-1.0),
    "Magic Formula, E 0": magic_formula(0.0),
    "Magic Formula, E 0.5": magic_formula(0.5),
}


def draw(seed):
    """What is drawn for a robot: its ground, the name of the curve, the wheel noise, and the mass of its data sheet."""
    random = np.random.default_rng([seed, 1])
    name = list(CURVES)[random.integers(len(CURVES))]
    ground = Ground(
        stiffness=STIFFNESSES[seed % len(STIFFNESSES)],
        peak=random.uniform(0.45, 0.9),
        curve=CURVES[name],
        relaxation_m=math.exp(random.uniform(math.log(0.015), math.log(0.06))),
        resistance=random.uniform(0.0, 0.03),
        practical_slip=random.choice([0.0, 0.5, 1.0]),
        height_m=random.uniform(0.1, 0.3),
    )
    payload = random.uniform(0.0, 0.2)
    return ground, name, WHEEL_NOISE_RAD_S if seed % 3 == 0 else 0.0, ROBOT["mass_kg"] / (1.0 + payload)


def drive(work):
    """Simulates a robot, records it, and runs `logs` on the recording."""
    program, seed = work
    ground, curve, noise_rad_s, sheet_kg = draw(seed)
    samples = write_logs.simulate(np.random.default_rng([seed, 2]), ground)
    model = ROBOT | {"mass_kg": sheet_kg, "yaw_inertia_kg_m2": ROBOT["yaw_inertia_kg_m2"] * sheet_kg / ROBOT["mass_kg"]}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "drive.mcap")
        write_logs.write_mcap(path, write_logs.messages(samples, WHEEL_HZ, np.random.default_rng([seed, 3]), noise_rad_s))
        command = [str(program), str(path), "--json"]
        for name, value in model.items():
            command += [f"--{name.replace('_', '-')}", str(value)]
        try:
            ended = subprocess.run(command, capture_output=True, text=True, timeout=LOGS_MAX_S, check=False)
        except subprocess.TimeoutExpired as error:
            raise LogsFailed(f"seed {seed}: no result after {LOGS_MAX_S} s") from error
    try:
        theta = json.loads(ended.stdout)["overall"]["theta"]
    except (json.JSONDecodeError, KeyError, TypeError) as error:
        raise LogsFailed(f"seed {seed}: it ended with {ended.returncode}: {ended.stdout}{ended.stderr}") from error
    kind = {"curve": curve.split(",", maxsplit=1)[0], "K": ground.stiffness, "practical_slip": float(ground.practical_slip)}
    return kind | {"noise": noise_rad_s > 0.0, "theta": 1.0 / ground.stiffness, "found": theta}


def line(name, drives):
    """Figures of some robots: robots, estimates, coverage, median half-width and error."""
    estimates = []
    for robot in drives:
        found = robot["found"]
        if found is None:
            continue
        half = 0.5 * (found["high_95"] - found["low_95"])
        if half <= HALF_WIDTH_MAX * found["theta"]:
            is_covered = found["low_95"] <= robot["theta"] <= found["high_95"]
            estimates.append((is_covered, half / found["theta"], found["theta"] / robot["theta"] - 1.0))
    figures = {"name": name, "robots": len(drives), "estimates": len(estimates)}
    if estimates:
        covered, halves, errors = zip(*estimates, strict=True)
        figures |= {
            "coverage": statistics.mean(covered), "half_width": statistics.median(halves),
            "error": statistics.median(errors), "rms_error": math.sqrt(statistics.mean(error**2 for error in errors)),
        }
    return figures


def lines_of(drives):
    """Lines of all robots, with smooth and with noisy wheel speeds, and of what was drawn."""
    smooth = [robot for robot in drives if not robot["noise"]]
    lines = [line("all", drives), line("smooth wheel speeds", smooth)]
    lines.append(line("noisy wheel speeds", [robot for robot in drives if robot["noise"]]))
    for key, label in (("K", "K {}"), ("curve", "{}"), ("practical_slip", "practical slip {}")):
        for value in sorted({robot[key] for robot in smooth}):
            lines.append(line(f"smooth, {label.format(value)}", [robot for robot in smooth if robot[key] == value]))
    return lines


def checks_of(lines):
    goal = f"at least {COVERAGE_MIN}"
    checks = []
    for figures in lines[:3]:
        value = figures.get("coverage")
        holds = value is not None and value >= COVERAGE_MIN
        checks.append({"name": f"coverage of 95 % intervals, {figures['name']}", "goal": goal, "value": value, "holds": holds})
    return checks


def markdown(lines):
    rows = ["| robots | drives | estimates | coverage | half-width | error | RMS error |", "|---|---|---|---|---|---|---|"]
    for figures in lines:
        names = ("coverage", "half_width", "error", "rms_error")
        cells = [f"{round(100.0 * figures[name])} %" if name in figures else "-" for name in names]
        rows.append(f"| {figures['name']} | {figures['robots']} | {figures['estimates']} | {' | '.join(cells)} |")
    return "\n".join(rows)


def run_all(work, jobs):
    """All drives, with progress on standard error."""
    begin, drives = time.monotonic(), []
    with multiprocessing.Pool(jobs) as pool:
        for robot in pool.imap(drive, work):
            drives.append(robot)
            if len(drives) % 10 == 0 or len(drives) == len(work):
                seconds = time.monotonic() - begin
                print(f"{len(drives)} of {len(work)} recordings, {seconds:.0f} s", file=sys.stderr, flush=True)
    return drives


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("logs", type=Path, help="the program `logs`")
    parser.add_argument("--runs", type=int, default=120, help="robots")
    parser.add_argument("--seed", type=int, default=1000, help="first seed")
    parser.add_argument("--jobs", type=int, default=1, help="recordings at once")
    form = parser.add_mutually_exclusive_group()
    form.add_argument("--json", action="store_true", help="print one JSON object")
    form.add_argument("--markdown", action="store_true", help="print Markdown, which is the default")
    options = parser.parse_args()
    if not options.logs.is_file():
        parser.error(f"there is no program `{options.logs}`")
    work = [(options.logs.resolve(), options.seed + run) for run in range(options.runs)]
    try:
        lines = lines_of(run_all(work, options.jobs))
    except LogsFailed as failure:
        print(f"population.py: `logs` failed: {failure}", file=sys.stderr)
        sys.exit(2)
    checks = checks_of(lines)
    if options.json:
        print(json.dumps({"lines": lines, "checks": checks}, ensure_ascii=False))
    else:
        print(markdown(lines))
    sys.exit(0 if all(check["holds"] for check in checks) else 1)


if __name__ == "__main__":
    main()
