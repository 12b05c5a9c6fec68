"""Runs `logs` on recordings of an independent simulator, and compares its intervals with the truth.

    python independent.py LOGS [--runs N] [--singles N] [--seed S] [--jobs J] [--json | --markdown]

LOGS is the program. The plant is verified first. It ends with 1 if a check does not hold, and with 2 if `logs` fails
or is missing.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np

import plant
import recording
import robots
import tables
import verification

sys.path.append(str(Path(__file__).resolve().parent.parent))
import logs_runs


def interval_of(program, path, make, effort):
    """θ and its interval over the whole recording; None if `logs` abstains."""
    robot = {name: make[name] for name in ("mass_kg", "track_m", "wheelbase_m", "wheel_radius_m")}
    theta = logs_runs.theta_of(program, path, robot, "--effort", effort)
    return theta and (theta["theta"], theta["low_95"], theta["high_95"])


def drive(work):
    """Simulate one robot, record it, and run `logs` on the recording with torque and without."""
    program, line, seed = work
    parameters = robots.draw(line, seed)
    random = np.random.default_rng([seed, 5, int(line == robots.POPULATION)])
    commands = robots.course(
        parameters["course"], parameters["make"], random, parameters["duration_s"], parameters["turn_multiplier"]
    )
    record, _ = plant.simulate(
        robots.plant_of(parameters, random), *commands, robots.COMMAND_STEP_S, parameters["duration_s"],
        robots.STEP_S, robots.STEPS_PER_RECORD,
    )  # fmt: skip
    if not np.isfinite(record).all():
        raise ArithmeticError(f"{line}, seed {seed}: the simulation diverged")
    make = robots.MAKES[parameters["make"]]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, f"seed-{seed}.mcap")
        recording.write(path, record, parameters, random)
        intervals = {effort: interval_of(program, path, make, effort) for effort in tables.EFFORTS}
    kept = {key: parameters[key] for key in ("line", "seed", "make", "course", "shape")}
    return kept | {"theta": 1 / parameters["stiffness"], "intervals": intervals}


def main():
    counts = [("runs", 120, "robots of the population"), ("singles", 9, "robots of each single deviation")]
    options = logs_runs.options_of(__doc__, counts, seed=5_000_000)
    print("verifying the plant", file=sys.stderr, flush=True)
    checks = verification.verify()
    program = options.logs
    work = [(program, robots.POPULATION, options.seed + run) for run in range(options.runs)]
    work += [(program, line, options.seed + run) for run in range(options.singles) for line in robots.SINGLES]
    lines = tables.lines_of(logs_runs.run_all(drive, work, options.jobs))
    checks += tables.checks_of(lines)
    markdown = f"{tables.table(lines)}\n\n{tables.table_of_checks(checks)}"
    logs_runs.report(lines, checks, markdown, options.json)


if __name__ == "__main__":
    main()
