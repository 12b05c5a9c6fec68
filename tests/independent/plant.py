"""Equations of motion of a skid-steered robot: a rigid body on four wheels, in a plane.

Contacts are single points with transient slip (Pacejka, Tire and Vehicle Dynamics, ch. 7): a deflection follows the
slip over the relaxation length, and force over load is a curve of the deflection. LuGre contacts have bristles instead
(Canudas de Wit et al., IEEE Trans. Automatic Control 40(3), 1995; the tyre's average lumped form). Loads shift with
the accelerations of the body. Motors have speed servos with lag and a torque limit; gears have dry and viscous
friction. None of this is taken from the project's own simulators.

x is forward, y to the left, angles counter-clockwise. Wheels are in the order front left, front right, rear left,
rear right.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

LINEAR, BRUSH, MAGIC_FORMULA, LUGRE = 0, 1, 2, 3
GRAVITY_M_S2 = 9.80665

# Columns of a record.
TIME, WHEEL_ANGLES, TORQUES, YAW_RATE, FORCE_X, FORCE_Y, POSITION_X, POSITION_Y, HEADING, SPEED = (
    0, 1, 5, 9, 10, 11, 12, 13, 14, 15,
)
COLUMNS = 16
# Entries of the energies, joules. The sum of the first two is that of the others.
MOTORS, GRAVITY, GEARS, CONTACTS, KINETIC = 0, 1, 2, 3, 4

LOAD_LAG_S = 0.03  # of suspension and tyres, assumed
CONTACT_DAMPING_S = 0.002  # damping of a contact over its stiffness, assumed
DRY_FRICTION_RAD_S = 0.05  # wheel speed at which dry friction of gears has its full size, nearly
LUGRE_MOST = 1.05  # peak of a LuGre contact over its sliding friction


class Plant(NamedTuple):
    """One robot on one ground."""

    shape: int  # of the friction curve
    stiffness: float  # K, slope of force over load at zero slip
    peak: float  # of force over load
    magic_shape: float  # C of the Magic Formula
    magic_curvature: float  # E of the Magic Formula
    anisotropy: float  # lateral stiffness over the longitudinal one
    relaxation_m: float
    mass_kg: float
    yaw_inertia_kg_m2: float
    wheelbase_m: float
    track_m: float
    height_m: float  # of the centre of mass
    centre_x_m: float  # centre of mass against the middle of the wheels
    centre_y_m: float
    wheel_radii_m: np.ndarray
    wheel_inertia_kg_m2: float  # of one wheel with its rotor
    sides_coupled: bool  # both wheels of a side have one speed
    rolling_resistance: float
    gear_friction_n_m: float  # dry, of each wheel
    gear_damping_n_m_s: float
    slope_rad: float
    uphill_rad: float  # heading uphill
    servo_rad_s: float  # bandwidth of the speed servos
    motor_lag_s: float
    torque_limit_n_m: float
    imu_x_m: float  # inertial unit against the middle of the wheels
    imu_y_m: float
    pull_n: float  # force forward at the centre of mass
    wheels_forced: bool  # wheels have the commanded speeds exactly


@njit(cache=True)
def force_over_load(plant, deflection):
    """Force over load of a contact that is deflected by so much slip."""
    shape, stiffness, peak = plant.shape, plant.stiffness, plant.peak
    if shape == LINEAR:
        return min(stiffness * deflection, peak)
    if shape == BRUSH:
        part = stiffness * deflection / peak
        if part >= 3.0:
            return peak
        return peak * (part - part * part / 3.0 + part * part * part / 27.0)
    if shape == MAGIC_FORMULA:
        scaled = stiffness / (plant.magic_shape * peak) * deflection
        bent = scaled - plant.magic_curvature * (scaled - np.arctan(scaled))
        return peak * np.sin(plant.magic_shape * np.arctan(bent))
    return min(stiffness * deflection, LUGRE_MOST * peak)


@njit(cache=True)
def largest_deflection(plant):
    """Deflection at which a contact slides as a whole."""
    ratio = plant.peak / plant.stiffness
    if plant.shape == LINEAR:
        return ratio
    if plant.shape == BRUSH:
        return 3.0 * ratio
    if plant.shape == MAGIC_FORMULA:
        return 12.0 * ratio
    return 1e9


@njit(cache=True)
def decay_m_s(plant, rolling_m_s, forward_m_s, slip_m_s):
    """Speed at which a contact renews its deflection over the relaxation length."""
    if plant.shape == LUGRE:
        return abs(rolling_m_s) + plant.stiffness * slip_m_s / plant.peak
    if plant.shape == MAGIC_FORMULA:
        return abs(forward_m_s)
    return abs(rolling_m_s)


@njit(cache=True)
def static_loads_n(plant):
    """Loads of the wheels of a robot at rest."""
    loads_n = np.zeros(4)
    weight_n = plant.mass_kg * GRAVITY_M_S2 * np.cos(plant.slope_rad)
    for i in range(4):
        front = plant.centre_x_m / plant.wheelbase_m * (1.0 if i < 2 else -1.0)
        left = plant.centre_y_m / plant.track_m * (1.0 if i % 2 == 0 else -1.0)
        loads_n[i] = weight_n * (0.5 + front) * (0.5 + left)
    return loads_n


@njit(cache=True)
def turn_motors(plant, command_left_rad_s, command_right_rad_s, speeds, integrals, torques, step_s):
    """Advance the servos of all wheels by one step, in place."""
    radius_m = np.mean(plant.wheel_radii_m)
    gain = (plant.wheel_inertia_kg_m2 + plant.mass_kg * radius_m**2 / 4) * plant.servo_rad_s
    for i in range(4):
        error = (command_left_rad_s if i % 2 == 0 else command_right_rad_s) - speeds[i]
        wanted = gain * error + gain * plant.servo_rad_s * 0.5 * integrals[i]
        if abs(wanted) < plant.torque_limit_n_m:
            integrals[i] += error * step_s
        else:
            wanted = plant.torque_limit_n_m * np.sign(wanted)
        torques[i] += step_s / plant.motor_lag_s * (wanted - torques[i])
    if plant.sides_coupled:
        for side in range(2):
            shared = 0.5 * (torques[side] + torques[side + 2])
            torques[side] = shared
            torques[side + 2] = shared


@njit(cache=True)
def turn_wheels(plant, torques, losses, forces_x, speeds, step_s):
    """Advance the wheels' speeds by one step, in place."""
    net = torques - losses - forces_x * plant.wheel_radii_m
    for i in range(4):
        if plant.sides_coupled:
            other = (i + 2) % 4
            speeds[i] += step_s * (net[i] + net[other]) / (2 * plant.wheel_inertia_kg_m2)
        else:
            speeds[i] += step_s * net[i] / plant.wheel_inertia_kg_m2


@njit(cache=True)
def deflect(plant, deflections, wheel, rolling_m_s, forward_m_s, slip_x, slip_y, step_s):
    """Advance a contact's deflection by one step, in place; the slip that its spring and damper feel."""
    before_x, before_y = deflections[wheel]
    decay = decay_m_s(plant, rolling_m_s, forward_m_s, np.hypot(slip_x, slip_y))
    share = step_s / plant.relaxation_m
    after_x = (before_x + share * slip_x) / (1 + share * decay)
    after_y = (before_y + share * slip_y) / (1 + share * decay)
    size, most = np.hypot(after_x, after_y), largest_deflection(plant)
    if size > most:
        after_x *= most / size
        after_y *= most / size
    deflections[wheel, 0] = after_x
    deflections[wheel, 1] = after_y
    damping = CONTACT_DAMPING_S / step_s
    return after_x + damping * (after_x - before_x), after_y + damping * (after_y - before_y)


@njit(cache=True)
def simulate(plant, command_left_rad_s, command_right_rad_s, command_step_s, duration_s, step_s, every):
    """Drive a robot open loop; a record of every so many steps, and energies in joules.

    Columns of a record and entries of the energies are the constants above. FORCE_X and FORCE_Y are the specific
    force at the inertial unit, m/s^2; TORQUES are those of the motors at the wheels.
    """
    count = int(round(duration_s / step_s))
    record = np.zeros((count // every, COLUMNS))
    energies_j = np.zeros(5)
    mass_kg, inertia = plant.mass_kg, plant.yaw_inertia_kg_m2
    wheel_x = np.array([0.5, 0.5, -0.5, -0.5]) * plant.wheelbase_m - plant.centre_x_m
    wheel_y = np.array([0.5, -0.5, 0.5, -0.5]) * plant.track_m - plant.centre_y_m
    imu_x, imu_y = plant.imu_x_m - plant.centre_x_m, plant.imu_y_m - plant.centre_y_m
    at_rest_n = static_loads_n(plant)
    pitching_kg = mass_kg * plant.height_m / (2 * plant.wheelbase_m)
    rolling_kg = mass_kg * plant.height_m / (2 * plant.track_m)
    deflections = np.zeros((4, 2))
    speeds, angles, torques, integrals = np.zeros(4), np.zeros(4), np.zeros(4), np.zeros(4)
    forces_x, forces_y, losses = np.zeros(4), np.zeros(4), np.zeros(4)
    x, y, heading, velocity_x, velocity_y, yaw_rate = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    lagged_x, lagged_y = 0.0, 0.0  # accelerations that have reached the loads
    for k in range(count):
        command = min(int(k * step_s / command_step_s), len(command_left_rad_s) - 1)
        moment = 0.0
        for i in range(4):
            load_n = at_rest_n[i] - lagged_x * pitching_kg * (1.0 if i < 2 else -1.0)
            load_n -= lagged_y * rolling_kg * (1.0 if i % 2 == 0 else -1.0)
            load_n = max(load_n, 0.0)
            forward_m_s = velocity_x - yaw_rate * wheel_y[i]
            rolling_m_s = speeds[i] * plant.wheel_radii_m[i]
            slip_x = rolling_m_s - forward_m_s
            slip_y = -(velocity_y + yaw_rate * wheel_x[i])
            felt_x, felt_y = deflect(plant, deflections, i, rolling_m_s, forward_m_s, slip_x, slip_y, step_s)
            felt_y *= plant.anisotropy
            size = np.hypot(felt_x, felt_y)
            forces_x[i], forces_y[i] = 0.0, 0.0
            if size > 1e-12:
                friction = force_over_load(plant, size)
                forces_x[i] = load_n * friction * felt_x / size
                forces_y[i] = load_n * friction * felt_y / size
            moment += wheel_x[i] * forces_y[i] - wheel_y[i] * forces_x[i]
            energies_j[CONTACTS] += step_s * (forces_x[i] * slip_x + forces_y[i] * slip_y)
            dry = plant.gear_friction_n_m + plant.rolling_resistance * load_n * plant.wheel_radii_m[i]
            losses[i] = dry * np.tanh(speeds[i] / DRY_FRICTION_RAD_S) + plant.gear_damping_n_m_s * speeds[i]
        turn_motors(
            plant, command_left_rad_s[command], command_right_rad_s[command], speeds, integrals, torques, step_s
        )
        turn_wheels(plant, torques, losses, forces_x, speeds, step_s)
        if plant.wheels_forced:
            speeds[:] = command_left_rad_s[command]
        angles += step_s * speeds
        energies_j[MOTORS] += step_s * np.sum(torques * speeds)
        energies_j[GEARS] += step_s * np.sum(losses * speeds)

        downhill = -GRAVITY_M_S2 * np.sin(plant.slope_rad)
        gravity_x = downhill * np.cos(plant.uphill_rad - heading)
        gravity_y = downhill * np.sin(plant.uphill_rad - heading)
        specific_x = (np.sum(forces_x) + plant.pull_n) / mass_kg
        specific_y = np.sum(forces_y) / mass_kg
        yaw_acceleration = moment / inertia
        lagged_x += step_s / LOAD_LAG_S * (specific_x - lagged_x)
        lagged_y += step_s / LOAD_LAG_S * (specific_y - lagged_y)
        next_x = velocity_x + step_s * (specific_x + gravity_x)
        next_y = velocity_y + step_s * (specific_y + gravity_y)
        given_n = gravity_x * mass_kg + plant.pull_n
        energies_j[GRAVITY] += step_s * given_n * 0.5 * (velocity_x + next_x)
        energies_j[GRAVITY] += step_s * gravity_y * mass_kg * 0.5 * (velocity_y + next_y)
        yaw_rate += step_s * yaw_acceleration
        # Velocities are in the body's frame, which turns exactly, so that turning adds no energy.
        turned = yaw_rate * step_s
        velocity_x = np.cos(turned) * next_x + np.sin(turned) * next_y
        velocity_y = -np.sin(turned) * next_x + np.cos(turned) * next_y
        heading += turned
        x += step_s * (velocity_x * np.cos(heading) - velocity_y * np.sin(heading))
        y += step_s * (velocity_x * np.sin(heading) + velocity_y * np.cos(heading))

        row = (k + 1) // every - 1
        if (k + 1) % every == 0 and row < len(record):
            record[row, TIME] = (k + 1) * step_s
            record[row, WHEEL_ANGLES : WHEEL_ANGLES + 4] = angles
            record[row, TORQUES : TORQUES + 4] = torques
            record[row, YAW_RATE] = yaw_rate
            record[row, FORCE_X] = specific_x - yaw_acceleration * imu_y - yaw_rate * yaw_rate * imu_x
            record[row, FORCE_Y] = specific_y + yaw_acceleration * imu_x - yaw_rate * yaw_rate * imu_y
            record[row, POSITION_X], record[row, POSITION_Y] = x, y
            record[row, HEADING], record[row, SPEED] = heading, velocity_x
    energies_j[KINETIC] = 0.5 * mass_kg * (velocity_x**2 + velocity_y**2) + 0.5 * inertia * yaw_rate**2
    energies_j[KINETIC] += 0.5 * plant.wheel_inertia_kg_m2 * np.sum(speeds * speeds)
    return record, energies_j
