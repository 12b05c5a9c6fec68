"""Verifies the plant: the slip of a pulled robot, the balance of energies, and drives with half the step."""

import numpy as np

import plant
import robots

PULL = 0.005  # over the weight
FORCED_M_S = 0.3


def pulled_theta(make_name, shape, stiffness):
    """Slip per force over load of a robot that rolls at constant speed and is pulled forward and rearward."""
    parameters = robots.draw("nothing", 0) | {"make": make_name, "shape": shape, "stiffness": stiffness, "peak": 0.6}
    robot = robots.plant_of(parameters, np.random.default_rng(0))
    command = np.full(10, FORCED_M_S / robots.MAKES[make_name]["wheel_radius_m"])
    slips = []
    for pull in (PULL, -PULL):
        pulled = robot._replace(pull_n=-pull * robot.mass_kg * plant.GRAVITY_M_S2, wheels_forced=True)
        record, _ = plant.simulate(pulled, command, command, 0.01, 12.0, robots.STEP_S, robots.STEPS_PER_RECORD)
        metres, seconds = (record[-1, column] - record[-2000, column] for column in (plant.POSITION_X, plant.TIME))
        slips.append(1 - metres / seconds / FORCED_M_S)
    return (slips[0] - slips[1]) / (2 * PULL)


def drive_twice(make_name, shape, course_name):
    """Energy that is missing over that of the motors, and RMS difference of yaw rates with half the step, rad/s."""
    changes = {"make": make_name, "shape": shape, "stiffness": 3.0, "peak": 0.6, "slope_rad": 0.03}
    parameters = robots.draw("nothing", 0) | changes
    robot = robots.plant_of(parameters, np.random.default_rng(0))
    commands = robots.course(course_name, make_name, np.random.default_rng(3), 90.0, 1.8)
    yaw_rates, missing = [], []
    for part in (1, 2):
        record, energies_j = plant.simulate(
            robot, *commands, robots.COMMAND_STEP_S, 90.0, robots.STEP_S / part, robots.STEPS_PER_RECORD * part
        )
        yaw_rates.append(record[:, plant.YAW_RATE])
        given_j = energies_j[plant.MOTORS] + energies_j[plant.GRAVITY]
        spent_j = energies_j[plant.GEARS] + energies_j[plant.CONTACTS] + energies_j[plant.KINETIC]
        missing.append(abs(given_j - spent_j) / energies_j[plant.MOTORS])
    return missing[0], np.sqrt(np.mean((yaw_rates[0] - yaw_rates[1]) ** 2))


def verify():
    """Checks of the plant: name, goal, value, whether it holds."""
    makes, courses = list(robots.MAKES), robots.COURSES
    slopes = [abs(pulled_theta(make, shape, 3.0) * 3.0 - 1) for make in makes for shape in robots.CURVES]
    # Each make and each course with each curve once.
    drives = [
        drive_twice(make, shape, courses[(index + shape) % 3])
        for index, make in enumerate(makes)
        for shape in robots.CURVES
    ]
    missing, differences = np.max(drives, axis=0)
    return [
        check("plant: largest error of θ of a pulled robot", "≤", 0.01, max(slopes)),
        check("plant: largest missing energy over that of the motors", "≤", 0.001, missing),
        check("plant: largest RMS difference of yaw rates with half the step, rad/s", "≤", 0.001, differences),
    ]


def check(name, relation, goal, value):
    """A check as the project's reports print it. There is no value if nothing could be counted."""
    holds = value is not None and (value <= goal if relation == "≤" else value >= goal)
    shown = f"{relation} {goal:.0%}" if relation == "≥" else f"{relation} {goal:g}"
    return {
        "name": name,
        "goal": shown.replace("%", " %"),
        "value": None if value is None else float(value),
        "holds": bool(holds),
    }
