"""Draws robots, grounds and courses: a population in which everything differs, and single deviations."""

import numpy as np

from plant import BRUSH, GRAVITY_M_S2, LINEAR, LUGRE, MAGIC_FORMULA, Plant

# Mass, track, wheelbase and wheel radius are those that Clearpath Robotics publishes. The height of the centre of mass
# and the inertia of a wheel with its rotor are assumed. `size` scales courses.
MAKES = {
    "Husky": {
        "mass_kg": 46.0, "track_m": 0.555, "wheelbase_m": 0.512, "wheel_radius_m": 0.165, "height_m": 0.17,
        "size": 1.0, "sides_coupled": True, "wheel_inertia_kg_m2": 0.10,
    },
    "Jackal": {
        "mass_kg": 17.0, "track_m": 0.376, "wheelbase_m": 0.262, "wheel_radius_m": 0.098, "height_m": 0.11,
        "size": 0.65, "sides_coupled": True, "wheel_inertia_kg_m2": 0.012,
    },
    "Warthog": {
        "mass_kg": 280.0, "track_m": 1.08, "wheelbase_m": 0.914, "wheel_radius_m": 0.30, "height_m": 0.36,
        "size": 1.9, "sides_coupled": False, "wheel_inertia_kg_m2": 1.6,
    },
}  # fmt: skip
COURSES = ["figure-8", "circles", "stops"]
CURVES = {LINEAR: "linear", BRUSH: "brush", MAGIC_FORMULA: "Magic Formula", LUGRE: "LuGre"}
COMMAND_STEP_S = 0.01
STANDING_S = 5.0
STEP_S = 2.5e-4
STEPS_PER_RECORD = 4  # so a record is 1 kHz

POPULATION = "population"
SINGLES = {
    "nothing": {},
    "payload 20 %": {"payload": 0.2},
    "yaw inertia +25 %": {"inertia_ratio": 1.25},
    "brush": {"shape": BRUSH},
    "Magic Formula": {"shape": MAGIC_FORMULA},
    "LuGre": {"shape": LUGRE},
    "relaxation 1 cm": {"relaxation_m": 0.01},
    "relaxation 10 cm": {"relaxation_m": 0.10},
    "torque scale +3 %": {"torque_scale": 0.03},
    "torque scale -3 %": {"torque_scale": -0.03},
    "slope 5°": {"slope_rad": np.radians(5.0)},
    "centre of mass 5 % rearward and left": {"centre_x": -0.05, "centre_y": 0.05},
    "accelerometer bias 0.15, -0.12 m/s²": {"accelerometer_bias_m_s2": [0.15, -0.12]},
    "wheels at 50 Hz": {"joints_hz": 50},
    "gyroscope 20 ms late": {"gyro_delay_s": 0.02},
    "accelerometer 30 ms late": {"accelerometer_delay_s": 0.03},
    "wheel radius +2 %": {"radius_ratio": 1.02},
    "wheel radius -2 %": {"radius_ratio": 0.98},
    "lateral stiffness -20 %": {"anisotropy": 0.8},
    "gear friction threefold": {"gear_friction": 0.05, "rolling_resistance": 0.03},
    "no poses": {"has_poses": False},
}


def draw(line, seed):
    """Parameters of a robot. One seed has the same make, ground and course in all single deviations."""
    random = np.random.default_rng([seed, 77])
    uniform = random.uniform
    parameters = {
        "line": line,
        "seed": seed,
        "make": list(MAKES)[seed % 3],
        "stiffness": [1.0, 3.0, 8.0][(seed // 3) % 3],
        "course": COURSES[(seed + seed // 3 + seed // 9) % 3],
        "peak": uniform(0.4, 0.9),  # from wet grass or gravel to dry asphalt (Wong, Theory of Ground Vehicles)
        "duration_s": uniform(65, 115),
        "shape": LINEAR,
        "magic_shape": 1.3,
        "magic_curvature": 0.0,
        "anisotropy": 1.0,
        "relaxation_m": 0.035,
        "payload": 0.0,
        "inertia_ratio": 1.0,
        "centre_x": 0.0,  # over the wheelbase
        "centre_y": 0.0,  # over the track
        "joints_hz": 100,
        "imu_hz": 100,
        "ticks": int(uniform(8000, 60000)),  # of the encoder, per revolution of the wheel
        "phase": random.random(4),
        "torque_scale": 0.0,
        "slope_rad": 0.0,
        "uphill_rad": uniform(0, 6.28),
        "rolling_resistance": 0.012,
        "gear_friction": 0.015,  # over load times wheel radius
        "gear_damping_1_s": 0.0,  # over the wheel's inertia
        "servo_rad_s": uniform(10, 18),
        "motor_lag_s": uniform(0.005, 0.02),
        "gyro_bias_rad_s": random.normal(0, 0.005),
        "gyro_walk_rad_s_root_s": 2e-4,
        "gyro_noise_rad_s": 0.002,  # MEMS data sheets, 100 Hz
        "accelerometer_bias_m_s2": [0.0, 0.0],
        "accelerometer_noise_m_s2": 0.04,  # MEMS data sheets, 100 Hz, with vibration
        "gyro_delay_s": 0.0,
        "accelerometer_delay_s": 0.0,
        "imu_x_m": 0.0,
        "imu_y_m": 0.0,
        "radius_ratio": 1.0,
        "radius_std": 0.0,
        "wheel_inertia_ratio": 1.0,
        "height_ratio": 1.0,
        "turn_multiplier": uniform(1.5, 1.9),  # effective track of skid steering (Mandow et al., IROS 2007)
        "has_poses": True,
    }
    if line == POPULATION:
        parameters.update(draw_everything(random))
    else:
        parameters.update(SINGLES[line])
    return parameters


def draw_everything(random):
    """What differs in the population. Where no source is named, the spread is assumed."""
    uniform = random.uniform
    return {
        "shape": int(random.integers(4)),
        "stiffness": float(np.exp(uniform(0, np.log(8)))),
        "magic_shape": uniform(1.1, 1.6),  # Pacejka, Tire and Vehicle Dynamics, ch. 4, and looser ground
        "magic_curvature": uniform(-1, 0.5),
        "anisotropy": uniform(0.85, 1.1),
        "relaxation_m": float(np.exp(uniform(np.log(0.01), np.log(0.09)))),
        "payload": uniform(0, 0.25),
        "inertia_ratio": uniform(0.85, 1.2),
        "centre_x": uniform(-0.05, 0.05),
        "centre_y": uniform(-0.04, 0.04),
        "joints_hz": int(random.choice([50, 100])),
        "imu_hz": int(random.choice([100, 200])),
        "torque_scale": random.normal(0, 0.02),
        "slope_rad": np.radians(abs(random.normal(0, 2))),
        "rolling_resistance": uniform(0.005, 0.03),  # hard floor to grass (Wong, Theory of Ground Vehicles)
        "gear_friction": uniform(0.005, 0.04),
        "gear_damping_1_s": uniform(0, 0.02),
        "gyro_noise_rad_s": uniform(0.001, 0.004),
        "accelerometer_noise_m_s2": uniform(0.02, 0.1),
        "accelerometer_bias_m_s2": random.normal(0, 0.08, 2),
        "gyro_delay_s": float(random.choice([0, 0, 0.005, 0.01])),
        "accelerometer_delay_s": float(random.choice([0, 0, 0.005, 0.01])),
        "imu_x_m": uniform(-0.05, 0.05),
        "imu_y_m": uniform(-0.05, 0.05),
        "radius_ratio": 1 + random.normal(0, 0.007),  # pressure and wear
        "radius_std": 0.002,
        "wheel_inertia_ratio": uniform(0.5, 1.6),
        "height_ratio": uniform(0.8, 1.3),
        "has_poses": bool(uniform() < 0.7),
    }


def plant_of(parameters, random):
    """The plant with these parameters. Wheel radii of one robot are drawn here."""
    make = MAKES[parameters["make"]]
    mass_kg = make["mass_kg"] * (1 + parameters["payload"])
    box_m2 = (make["wheelbase_m"] + 2 * make["wheel_radius_m"]) ** 2 + make["track_m"] ** 2
    differing = 1 + parameters["radius_std"] * random.standard_normal(4)
    traction_n_m = traction_torque_n_m(parameters)
    shared = ["shape", "stiffness", "peak", "magic_shape", "magic_curvature", "anisotropy", "relaxation_m"]
    shared += ["rolling_resistance", "slope_rad", "uphill_rad", "servo_rad_s", "motor_lag_s", "imu_x_m", "imu_y_m"]
    return Plant(
        mass_kg=mass_kg,
        yaw_inertia_kg_m2=parameters["inertia_ratio"] * mass_kg * box_m2 / 12,
        wheelbase_m=make["wheelbase_m"],
        track_m=make["track_m"],
        height_m=make["height_m"] * parameters["height_ratio"],
        centre_x_m=parameters["centre_x"] * make["wheelbase_m"],
        centre_y_m=parameters["centre_y"] * make["track_m"],
        wheel_radii_m=make["wheel_radius_m"] * parameters["radius_ratio"] * differing,
        wheel_inertia_kg_m2=make["wheel_inertia_kg_m2"] * parameters["wheel_inertia_ratio"],
        sides_coupled=make["sides_coupled"],
        gear_friction_n_m=parameters["gear_friction"] * traction_n_m,
        gear_damping_n_m_s=parameters["gear_damping_1_s"] * make["wheel_inertia_kg_m2"],
        torque_limit_n_m=1.3 * traction_n_m,
        pull_n=0.0,
        wheels_forced=False,
        **{name: parameters[name] for name in shared},
    )


def traction_torque_n_m(parameters):
    """Torque of one wheel whose force is its load."""
    make = MAKES[parameters["make"]]
    return make["mass_kg"] * (1 + parameters["payload"]) * GRAVITY_M_S2 / 4 * make["wheel_radius_m"]


def course(kind, make_name, random, duration_s, turn_multiplier):
    """Commanded speeds of left and right wheels, rad/s, after some seconds of standing."""
    make = MAKES[make_name]
    size = make["size"]
    speed_m_s = np.zeros(int(duration_s / COMMAND_STEP_S))
    turn_rad_s = np.zeros_like(speed_m_s)
    end_s = duration_s - 2

    def draw_speed():
        return random.uniform(0.4 * np.sqrt(size), 1.0 * np.sqrt(size))

    def fill(begin_s, seconds, speed, curvature):
        within = slice(int(begin_s / COMMAND_STEP_S), int(min(begin_s + seconds, end_s, duration_s) / COMMAND_STEP_S))
        speed_m_s[within] = speed
        turn_rad_s[within] = speed * curvature

    now_s, side = STANDING_S, random.choice([-1, 1])
    if kind == "figure-8":
        radius_m = random.uniform(1.0, 2.2) * size
        speed, turned_rad, until_s = draw_speed(), 0.0, now_s + random.uniform(2, 4)
        while now_s < end_s:
            fill(now_s, COMMAND_STEP_S, speed, side / radius_m)
            turned_rad += speed / radius_m * COMMAND_STEP_S
            if turned_rad > 2 * np.pi:
                turned_rad, side = 0.0, -side
            now_s += COMMAND_STEP_S
            if now_s > until_s:
                speed, until_s = draw_speed(), now_s + random.uniform(2, 4)
    elif kind == "circles":
        while now_s < end_s:
            radius_m = random.uniform(1.2, 3.0) * size
            until_s = min(now_s + random.uniform(12, 20), end_s)
            while now_s < until_s:
                speed, seconds = draw_speed(), random.uniform(2, 4)
                fill(now_s, seconds, speed, side / radius_m)
                now_s += seconds
            side = -side
    else:
        while now_s < end_s:
            until_s = min(now_s + random.uniform(6, 11), end_s)
            while now_s < until_s:
                speed, seconds = draw_speed(), random.uniform(1.5, 3.5)
                fill(now_s, seconds, speed, random.uniform(-0.8, 0.8) / size)
                now_s += seconds
            now_s += random.uniform(1.0, 1.8)
    speed_m_s = limited(speed_m_s, random.uniform(0.5, 1.0) * np.sqrt(size))
    turn_rad_s = limited(turn_rad_s, random.uniform(1.0, 2.0) / np.sqrt(size))
    half_track_m = make["track_m"] * turn_multiplier / 2
    left_m_s, right_m_s = speed_m_s - turn_rad_s * half_track_m, speed_m_s + turn_rad_s * half_track_m
    return left_m_s / make["wheel_radius_m"], right_m_s / make["wheel_radius_m"]


def limited(values, most_per_s):
    """Values that change by at most so much per second, smoothed over 0.15 s."""
    limited_values, value = np.zeros_like(values), 0.0
    for i, wanted in enumerate(values):
        value += np.clip(wanted - value, -most_per_s * COMMAND_STEP_S, most_per_s * COMMAND_STEP_S)
        limited_values[i] = value
    return np.convolve(limited_values, np.ones(15) / 15)[: len(values)]
