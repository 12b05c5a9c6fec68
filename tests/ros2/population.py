"""Runs `logs` on recordings of robots on different grounds, and compares its intervals with the truth.

    python population.py LOGS [--runs N] [--seed S] [--jobs J] [--json | --markdown]

LOGS is the program. The robots are those of write_logs.py, without torque. What is drawn for each: the friction curve,
its peak, the relaxation length, what slip is relative to, the motion resistance, the height of the centre of mass, the
payload; K is one of four values, and every third robot has white noise on its wheel speeds. The program knows the mass
of the data sheet and the wheels' places. It ends with 1 if a check does not hold, and with 2 if `logs` fails.
"""

import math
import statistics
import sys
import tempfile
from pathlib import Path

import numpy as np

import write_logs
from write_logs import ROBOT, WHEEL_NOISE_RAD_S, Ground

sys.path.append(str(Path(__file__).resolve().parent.parent))
import logs_runs

STIFFNESSES = (0.7, 1.5, 4.0, 8.0)
COVERAGE_MIN = 0.9
"""Goal for 95 % intervals on robots that are unlike the estimator's."""
HALF_WIDTH_MAX = 0.6
"""Half-width over θ above which an interval counts as no estimate."""
WHEEL_HZ = 50


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
        path = Path(folder, f"seed-{seed}.mcap")
        write_logs.write_mcap(path, write_logs.messages(samples, WHEEL_HZ, np.random.default_rng([seed, 3]), noise_rad_s))
        theta = logs_runs.theta_of(program, path, model)
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


def main():
    options = logs_runs.options_of(__doc__, [("runs", 120, "robots")], seed=1000)
    work = [(options.logs, options.seed + run) for run in range(options.runs)]
    lines = lines_of(logs_runs.run_all(drive, work, options.jobs))
    logs_runs.report(lines, checks_of(lines), markdown(lines), options.json)


if __name__ == "__main__":
    main()
