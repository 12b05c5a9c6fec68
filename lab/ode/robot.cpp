// A skid-steered robot in the Open Dynamics Engine (ODE): the plant of the held-out check.
//
// The simulator is not ours: rigid bodies, hinges, motors and contacts are ODE's, solved by its exact
// solver (dWorldStep). A chassis carries four wheels on hinges. Every wheel is a sphere on a plane,
// so that it has one contact point below its centre, and has its own motor. Wheels of one side get
// the same command. Gravity is tilted instead of the ground.
//
// The true theta. theta = 1/K, where K is the slope at zero slip of the friction coefficient over
// slip: F/N = s/theta, with the contact force F, the load N, and the slip s = v_slip/|r w| of a wheel
// that turns with w. ODE's contacts have force-dependent slip ("FDS"): v_slip = slip1 * F, and the
// same across by slip2. So slip1 = slip2 = theta*|r w|/N gives exactly this theta in both directions.
// N is the load that ODE's contact feedback gave for this wheel in the last step, |r w| the rim speed
// of the last step. Tyres have a relaxation length l: v_slip = theta*|r w|*F/N + l*theta*d(F/N)/dt.
// With the step h and the last step's F'/N' this is slip1 = theta*(|r w| + l/h)/N and a surface motion
// of l*theta/h*F'/N', both by ODE's own contact (dContactSlip, dContactMotion). In steady motion the
// second part is zero.
//
// ODE limits each of the two friction forces to mu*N (dContactApprox1): a pyramid. With is_cone=1 its
// first direction is that of the force which slip and deflection would give without a limit, so that a
// sliding contact's force is mu*N against its sliding, as Coulomb's law and every tyre model say. With
// is_cone=0 the first direction is that of the wheel. Then a tyre that slides sideways with mu*N still
// gives longitudinal force with the full stiffness K, which no tyre does, but which is what many users
// of ODE have. Below the limit both are the same.
//
// `wheels` prints force and slip as they are, from contact feedback and from the
// motion of the bodies; with `pull` they are measured against a known force. lab/tests/held_out.rs
// compares them with theta.
//
// Below RIM_MIN_M_S the rim speed in slip1 is RIM_MIN_M_S. So a robot at rest on a slope creeps, and
// its tyres' oscillation decays.
//
// Loads follow from soft contacts (dContactSoftERP, dContactSoftCFM): four vertical springs and
// dampers under a rigid body.
//
// Protocol, one line each way, SI units, angles in radians. Left is positive, wheels are front left,
// rear left, front right, rear right.
//   robot KEY=VALUE ...      creates the robot at rest              -> ready
//   drive LEFT RIGHT STEPS   commands wheel speeds for STEPS steps   -> state and the numbers below
//   pull FORWARD LEFT        pulls from now on, newtons, body frame,
//                            below the centre of mass at the ground  -> ok
//   wheels                   means over the last drive, 6 numbers a wheel: load, force forward, force
//                            left, slip speed forward, slip speed left, rim speed -> wheels ...
// A line that cannot be obeyed is answered by `error TEXT`, and the program ends.

#include <ode/ode.h>

#include <array>
#include <cmath>
#include <cstdarg>
#include <cstdio>
#include <cstdlib>
#include <iostream>
#include <map>
#include <sstream>
#include <string>

namespace {

// Lowest rim speed in the slip compliance.
constexpr double RIM_MIN_M_S = 0.005;
// Natural frequency and damping ratio of the body on its vertical springs.
constexpr double SPRINGS_RAD_S = 100.0;
constexpr double SPRINGS_DAMPING = 0.4;
// Share of a wheel in the mass of the robot.
constexpr double WHEEL_MASS_SHARE = 0.01;
// Roll and pitch inertia of the chassis over its yaw inertia: between plate and cube.
constexpr double ROLL_OVER_YAW = 0.75;
// A wheel's inertia about its diameter over that about its axle: a disc's is 0.5.
constexpr double DIAMETER_OVER_AXLE = 0.55;
// Rim speed scale of the smooth sign change of rolling resistance and gear losses.
constexpr double RESISTANCE_TURNS_M_S = 0.01;
// Time constant of the servo's integral part over its lag.
constexpr double RESET_OVER_LAG = 4.0;
// Time in which gravity is tilted before the robot is ready, and time after it.
constexpr double TILTS_S = 1.0;
constexpr double RESTS_S = 0.5;
// Slip speed below which a contact's friction has the directions of its wheel.
constexpr double SLIP_MIN_M_S = 1.0e-6;
// Least load in the slip compliance, over a quarter of the weight.
constexpr double LOAD_MIN_RATIO = 0.01;
// Most steps of one drive command, which bounds the time of an answer.
constexpr long STEPS_MAX = 1'000'000;
constexpr int WHEELS = 4;
// Longest integration step.
constexpr double STEP_MAX_S = 1.0e-3;

// What a robot is, as the line `robot` gives it.
struct Parameters {
    double step_s, mass_kg, yaw_inertia_kg_m2, center_forward_m, center_left_m, center_height_m, track_m,
        wheelbase_m, radius_left_m, radius_right_m, wheel_inertia_kg_m2, stiffness, mu_peak, is_cone,
        relaxation_m, slope_x_rad, slope_y_rad, gear_loss_ratio, rolling_resistance_ratio, servo_lag_s,
        torque_limit_n_m, x_m, y_m, heading_rad, gravity_m_s2;
};

struct Key {
    const char *name;
    double Parameters::*value;
    // Values that are possible.
    enum { ANY, POSITIVE, NOT_NEGATIVE } range;
};

const Key KEYS[] = {
    {"step_s", &Parameters::step_s, Key::POSITIVE},
    {"mass_kg", &Parameters::mass_kg, Key::POSITIVE},
    {"yaw_inertia_kg_m2", &Parameters::yaw_inertia_kg_m2, Key::POSITIVE},
    {"center_forward_m", &Parameters::center_forward_m, Key::ANY},
    {"center_left_m", &Parameters::center_left_m, Key::ANY},
    {"center_height_m", &Parameters::center_height_m, Key::POSITIVE},
    {"track_m", &Parameters::track_m, Key::POSITIVE},
    {"wheelbase_m", &Parameters::wheelbase_m, Key::POSITIVE},
    {"radius_left_m", &Parameters::radius_left_m, Key::POSITIVE},
    {"radius_right_m", &Parameters::radius_right_m, Key::POSITIVE},
    {"wheel_inertia_kg_m2", &Parameters::wheel_inertia_kg_m2, Key::POSITIVE},
    {"stiffness", &Parameters::stiffness, Key::POSITIVE},
    {"mu_peak", &Parameters::mu_peak, Key::POSITIVE},
    {"is_cone", &Parameters::is_cone, Key::ANY},
    {"relaxation_m", &Parameters::relaxation_m, Key::NOT_NEGATIVE},
    {"slope_x_rad", &Parameters::slope_x_rad, Key::ANY},
    {"slope_y_rad", &Parameters::slope_y_rad, Key::ANY},
    {"gear_loss_ratio", &Parameters::gear_loss_ratio, Key::NOT_NEGATIVE},
    {"rolling_resistance_ratio", &Parameters::rolling_resistance_ratio, Key::NOT_NEGATIVE},
    {"servo_lag_s", &Parameters::servo_lag_s, Key::POSITIVE},
    {"torque_limit_n_m", &Parameters::torque_limit_n_m, Key::POSITIVE},
    {"x_m", &Parameters::x_m, Key::ANY},
    {"y_m", &Parameters::y_m, Key::ANY},
    {"heading_rad", &Parameters::heading_rad, Key::ANY},
    {"gravity_m_s2", &Parameters::gravity_m_s2, Key::POSITIVE},
};

[[noreturn]] void fail(const std::string &text) {
    std::cout << "error " << text << std::endl;
    std::exit(1);
}

// ODE prints messages when its solver gives up on a step: then the figures would be wrong.
void on_message(int number, const char *text, va_list arguments) {
    char line[256];
    std::vsnprintf(line, sizeof line, text, arguments);
    fail("ODE message " + std::to_string(number) + ": " + line);
}

double dot(const dReal *a, const dReal *b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

// Means over the steps of one drive command.
struct WheelMeans {
    double load_n, forward_n, left_n, slip_forward_m_s, slip_left_m_s, rim_m_s;
};

struct Wheel {
    dBodyID body;
    dGeomID geom;
    dJointID hinge;
    double radius_m;
    dJointFeedback hinge_feedback;
    dJointFeedback contact_feedback;
    bool touches = false;
    double load_n = 0.0;
    double force_n[2] = {0.0, 0.0};
    // Friction coefficients of the last step, [forward, left].
    double mu[2] = {0.0, 0.0};
    double slip_m_s[2] = {0.0, 0.0};
    double rate_rad_s = 0.0;
    double motor_n_m = 0.0;
    double integral_n_m = 0.0;
    double turned_rad = 0.0;
    // Directions of the last step's friction: forward and left.
    dVector3 direction[2] = {};
    WheelMeans means = {};
};

class Robot {
public:
    explicit Robot(const Parameters &parameters) : is(parameters), step_s(is.step_s) {
        world = dWorldCreate();
        group = dJointGroupCreate(0);
        plane = dCreatePlane(nullptr, 0, 0, 1, 0);
        mass_kg = is.mass_kg;
        build();
        const double deflected_m = is.gravity_m_s2 / (SPRINGS_RAD_S * SPRINGS_RAD_S);
        shift(0.0, 0.0, -deflected_m);
        settle();
    }

    void pull(double forward_n, double left_n) {
        pull_n[0] = forward_n;
        pull_n[1] = left_n;
    }

    // Drives, and returns the state line.
    std::string drive(double left_rad_s, double right_rad_s, long steps) {
        double yaw_rate = 0.0, wheels[2] = {0, 0}, torques[2] = {0, 0}, acceleration[2] = {0, 0};
        double peak = 0.0;
        for (Wheel &wheel : wheels_of) wheel.means = {};
        for (long count = 0; count < steps; ++count) {
            double before[3], after[3];
            momentum_speed(before);
            step(left_rad_s, right_rad_s);
            momentum_speed(after);
            const dReal *rotation = dBodyGetRotation(chassis);
            for (int axis = 0; axis < 2; ++axis) {
                double sum = 0.0;
                for (int row = 0; row < 3; ++row) sum += rotation[4 * row + axis] * (after[row] - before[row]);
                acceleration[axis] += sum / step_s / steps;
            }
            yaw_rate += body_rate(2) / steps;
            for (int number = 0; number < WHEELS; ++number) {
                Wheel &wheel = wheels_of[number];
                const int side = number / 2;
                wheels[side] += 0.5 * wheel.rate_rad_s / steps;
                torques[side] += wheel.motor_n_m / steps;
                wheel.means.load_n += wheel.load_n / steps;
                wheel.means.forward_n += wheel.force_n[0] / steps;
                wheel.means.left_n += wheel.force_n[1] / steps;
                wheel.means.slip_forward_m_s += wheel.slip_m_s[0] / steps;
                wheel.means.slip_left_m_s += wheel.slip_m_s[1] / steps;
                wheel.means.rim_m_s += wheel.rate_rad_s * wheel.radius_m / steps;
            }
        }
        for (const Wheel &wheel : wheels_of) {
            peak = std::max(peak, std::hypot(wheel.mu[0], wheel.mu[1]) / is.mu_peak);
        }
        dVector3 place, speed;
        dBodyGetRelPointPos(chassis, middle[0], middle[1], middle[2], place);
        dBodyGetRelPointVel(chassis, middle[0], middle[1], middle[2], speed);
        const dReal *rotation = dBodyGetRotation(chassis);
        const double heading = std::atan2(rotation[4], rotation[0]);
        const double cosine = std::cos(heading), sine = std::sin(heading);
        // Between the chassis' own axis and the vertical.
        dVector3 gravity;
        dWorldGetGravity(world, gravity);
        const double up = -(gravity[0] * rotation[2] + gravity[1] * rotation[6] + gravity[2] * rotation[10]);
        const double tilt = std::acos(std::min(1.0, up / std::sqrt(dot(gravity, gravity))));
        const double numbers[] = {
            place[0], place[1], heading,
            cosine * speed[0] + sine * speed[1], -sine * speed[0] + cosine * speed[1], body_rate(2),
            yaw_rate, acceleration[0], acceleration[1], wheels[0], wheels[1], torques[0], torques[1],
            0.5 * (wheels_of[0].turned_rad + wheels_of[1].turned_rad),
            0.5 * (wheels_of[2].turned_rad + wheels_of[3].turned_rad),
            tilt, peak,
            wheels_of[0].load_n, wheels_of[1].load_n, wheels_of[2].load_n, wheels_of[3].load_n};
        std::ostringstream line;
        line.precision(17);
        line << "state";
        for (double number : numbers) {
            if (!std::isfinite(number)) fail("the simulation diverged: use a smaller step_s");
            line << ' ' << number;
        }
        return line.str();
    }

    std::string wheels() const {
        std::ostringstream line;
        line.precision(17);
        line << "wheels";
        for (const Wheel &wheel : wheels_of) {
            const WheelMeans &m = wheel.means;
            line << ' ' << m.load_n << ' ' << m.forward_n << ' ' << m.left_n << ' '
                 << m.slip_forward_m_s << ' ' << m.slip_left_m_s << ' ' << m.rim_m_s;
        }
        return line.str();
    }

private:
    Parameters is;
    double step_s;
    double mass_kg = 0.0;
    dWorldID world;
    dJointGroupID group;
    dGeomID plane;
    dBodyID chassis = nullptr;
    std::array<Wheel, WHEELS> wheels_of;
    // Centre of the wheels on the height of the axles, and point at the ground below the centre of
    // mass of the whole robot, both relative to the centre of mass of the chassis.
    double middle[3] = {0, 0, 0};
    double pulled[3] = {0, 0, 0};
    double pull_n[2] = {0, 0};

    void build() {
        const double half_base = 0.5 * is.wheelbase_m, half_track = 0.5 * is.track_m;
        const double radius[2] = {is.radius_left_m, is.radius_right_m};
        const double wheel_kg = WHEEL_MASS_SHARE * mass_kg;
        const double chassis_kg = mass_kg - WHEELS * wheel_kg;
        const double center[3] = {is.center_forward_m, is.center_left_m, is.center_height_m};
        const double axle_kg_m2 = is.wheel_inertia_kg_m2;
        const double diameter_kg_m2 = DIAMETER_OVER_AXLE * axle_kg_m2;
        // The chassis is what is left of mass, centre of mass and yaw inertia without the wheels.
        double sum[3] = {mass_kg * center[0], mass_kg * center[1], mass_kg * center[2]};
        double yaw_kg_m2 = is.yaw_inertia_kg_m2;
        double at[WHEELS][3];
        for (int number = 0; number < WHEELS; ++number) {
            at[number][0] = number % 2 == 0 ? half_base : -half_base;
            at[number][1] = number < 2 ? half_track : -half_track;
            at[number][2] = radius[number / 2];
            for (int axis = 0; axis < 3; ++axis) sum[axis] -= wheel_kg * at[number][axis];
            const double x = at[number][0] - center[0], y = at[number][1] - center[1];
            yaw_kg_m2 -= diameter_kg_m2 + wheel_kg * (x * x + y * y);
        }
        double own[3];
        for (int axis = 0; axis < 3; ++axis) own[axis] = sum[axis] / chassis_kg;
        const double x = own[0] - center[0], y = own[1] - center[1];
        yaw_kg_m2 -= chassis_kg * (x * x + y * y);
        if (yaw_kg_m2 <= 0.0) fail("yaw_inertia_kg_m2 is less than that of the wheels alone");
        chassis = dBodyCreate(world);
        dMass mass;
        dMassSetParameters(&mass, chassis_kg, 0, 0, 0, ROLL_OVER_YAW * yaw_kg_m2,
                           ROLL_OVER_YAW * yaw_kg_m2, yaw_kg_m2, 0, 0, 0);
        dBodySetMass(chassis, &mass);
        const double cosine = std::cos(is.heading_rad), sine = std::sin(is.heading_rad);
        const auto place = [&](dBodyID body, const double *point) {
            dBodySetPosition(body, is.x_m + cosine * point[0] - sine * point[1],
                             is.y_m + sine * point[0] + cosine * point[1], point[2]);
            dMatrix3 rotation;
            dRFromAxisAndAngle(rotation, 0, 0, 1, is.heading_rad);
            dBodySetRotation(body, rotation);
        };
        place(chassis, own);
        middle[0] = -own[0];
        middle[1] = -own[1];
        middle[2] = 0.5 * (radius[0] + radius[1]) - own[2];
        pulled[0] = center[0] - own[0];
        pulled[1] = center[1] - own[1];
        pulled[2] = -own[2];
        for (int number = 0; number < WHEELS; ++number) {
            Wheel &wheel = wheels_of[number];
            wheel.radius_m = radius[number / 2];
            wheel.body = dBodyCreate(world);
            dMassSetParameters(&mass, wheel_kg, 0, 0, 0, diameter_kg_m2, axle_kg_m2, diameter_kg_m2, 0, 0, 0);
            dBodySetMass(wheel.body, &mass);
            // Most of the inertia is that of a rotor behind a gear, which does not turn with the wheel.
            dBodySetGyroscopicMode(wheel.body, 0);
            dBodySetFiniteRotationMode(wheel.body, 1);
            place(wheel.body, at[number]);
            wheel.geom = dCreateSphere(nullptr, wheel.radius_m);
            dGeomSetBody(wheel.geom, wheel.body);
            wheel.hinge = dJointCreateHinge(world, nullptr);
            dJointAttach(wheel.hinge, wheel.body, chassis);
            const dReal *position = dBodyGetPosition(wheel.body);
            dJointSetHingeAnchor(wheel.hinge, position[0], position[1], position[2]);
            dJointSetHingeAxis(wheel.hinge, -sine, cosine, 0);
            dJointSetFeedback(wheel.hinge, &wheel.hinge_feedback);
            // The motor is ODE's: a torque of gain * (target - speed), within its limit.
            dJointSetHingeParam(wheel.hinge, dParamFMax, is.torque_limit_n_m);
            dJointSetHingeParam(wheel.hinge, dParamCFM, 1.0 / gain(wheel));
            wheel.load_n = 0.25 * mass_kg * is.gravity_m_s2;
        }
    }

    double gain(const Wheel &wheel) const {
        const double carried = 0.25 * mass_kg * wheel.radius_m * wheel.radius_m;
        return (carried + is.wheel_inertia_kg_m2) / is.servo_lag_s;
    }

    // Tilts gravity slowly, so that tyres and springs do not oscillate; then puts the robot back.
    void settle() {
        const long tilts = std::lround(TILTS_S / step_s), rests = std::lround(RESTS_S / step_s);
        for (long count = 0; count < tilts + rests; ++count) {
            tilt(std::min(1.0, static_cast<double>(count) / tilts));
            step(0.0, 0.0);
        }
        dVector3 place;
        dBodyGetRelPointPos(chassis, middle[0], middle[1], middle[2], place);
        shift(is.x_m - place[0], is.y_m - place[1], 0.0);
        for (Wheel &wheel : wheels_of) wheel.turned_rad = 0.0;
    }

    void shift(double x_m, double y_m, double z_m) {
        const auto move = [&](dBodyID body) {
            const dReal *from = dBodyGetPosition(body);
            dBodySetPosition(body, from[0] + x_m, from[1] + y_m, from[2] + z_m);
        };
        move(chassis);
        for (Wheel &wheel : wheels_of) move(wheel.body);
    }

    void tilt(double share) {
        const double x = std::tan(share * is.slope_x_rad), y = std::tan(share * is.slope_y_rad);
        const double down = is.gravity_m_s2 / std::sqrt(1.0 + x * x + y * y);
        dWorldSetGravity(world, -x * down, -y * down, -down);
    }

    double body_rate(int axis) const {
        const dReal *rotation = dBodyGetRotation(chassis), *rate = dBodyGetAngularVel(chassis);
        return rotation[axis] * rate[0] + rotation[4 + axis] * rate[1] + rotation[8 + axis] * rate[2];
    }

    // Velocity of the centre of mass of chassis and wheels.
    void momentum_speed(double *speed) const {
        dMass mass;
        dBodyGetMass(chassis, &mass);
        for (int axis = 0; axis < 3; ++axis) speed[axis] = mass.mass / mass_kg * dBodyGetLinearVel(chassis)[axis];
        for (const Wheel &wheel : wheels_of) {
            for (int axis = 0; axis < 3; ++axis) speed[axis] += WHEEL_MASS_SHARE * dBodyGetLinearVel(wheel.body)[axis];
        }
    }

    void step(double left_rad_s, double right_rad_s) {
        for (int number = 0; number < WHEELS; ++number) {
            motor(wheels_of[number], number < 2 ? left_rad_s : right_rad_s);
            touch(wheels_of[number]);
        }
        if (pull_n[0] != 0.0 || pull_n[1] != 0.0) {
            const dReal *rotation = dBodyGetRotation(chassis);
            dBodyAddForceAtRelPos(chassis, rotation[0] * pull_n[0] + rotation[1] * pull_n[1],
                                  rotation[4] * pull_n[0] + rotation[5] * pull_n[1], 0.0,
                                  pulled[0], pulled[1], pulled[2]);
        }
        dWorldStep(world, step_s);
        for (int number = 0; number < WHEELS; ++number) {
            measure(wheels_of[number], number < 2 ? left_rad_s : right_rad_s);
        }
        dJointGroupEmpty(group);
    }

    // Commands the servo, and applies what gears and rolling take of its torque.
    void motor(Wheel &wheel, double target_rad_s) {
        dJointSetHingeParam(wheel.hinge, dParamVel, target_rad_s + wheel.integral_n_m / gain(wheel));
        const double turns = std::tanh(wheel.rate_rad_s * wheel.radius_m / RESISTANCE_TURNS_M_S);
        const double lost = is.gear_loss_ratio * std::fabs(wheel.force_n[0]) * wheel.radius_m * turns;
        dJointAddHingeTorque(wheel.hinge, -lost);
        const double rolling =
            wheel.touches ? is.rolling_resistance_ratio * wheel.load_n * wheel.radius_m * turns : 0.0;
        dVector3 axle;
        dJointGetHingeAxis(wheel.hinge, axle);
        dBodyAddTorque(wheel.body, -rolling * axle[0], -rolling * axle[1], -rolling * axle[2]);
    }

    // Forward direction of a wheel on the ground, and left of it. A tyre's deflection turns with its
    // wheel, so a step's force is resolved in the directions of that step.
    void directions(Wheel &wheel) const {
        dReal *forward = wheel.direction[0], *left = wheel.direction[1];
        dVector3 axle;
        dJointGetHingeAxis(wheel.hinge, axle);
        const double size = std::hypot(axle[0], axle[1]);
        forward[0] = axle[1] / size;
        forward[1] = -axle[0] / size;
        left[0] = axle[0] / size;
        left[1] = axle[1] / size;
        forward[2] = left[2] = 0.0;
    }

    void touch(Wheel &wheel) {
        dContact contact = {};
        directions(wheel);
        wheel.touches = dCollide(wheel.geom, plane, 1, &contact.geom, sizeof contact.geom) == 1;
        if (!wheel.touches) return;
        const double theta = 1.0 / is.stiffness;
        const double weight_n = 0.25 * mass_kg * is.gravity_m_s2;
        const double load_n = std::max(wheel.load_n, LOAD_MIN_RATIO * weight_n);
        const double rim_m_s = std::max(std::fabs(wheel.rate_rad_s) * wheel.radius_m, RIM_MIN_M_S);
        const double bends_m_s = is.relaxation_m / step_s;
        const double motion[2] = {theta * bends_m_s * wheel.mu[0], theta * bends_m_s * wheel.mu[1]};
        // First direction of friction, in those of the wheel.
        double first[2] = {1.0, 0.0};
        if (is.is_cone != 0.0) {
            const double goal[2] = {motion[0] + wheel.slip_m_s[0], motion[1] + wheel.slip_m_s[1]};
            const double size = std::hypot(goal[0], goal[1]);
            if (size > SLIP_MIN_M_S) {
                first[0] = goal[0] / size;
                first[1] = goal[1] / size;
            }
        }
        for (int axis = 0; axis < 3; ++axis) {
            contact.fdir1[axis] = first[0] * wheel.direction[0][axis] + first[1] * wheel.direction[1][axis];
        }
        dSurfaceParameters &surface = contact.surface;
        surface.mode = dContactFDir1 | dContactSoftERP | dContactSoftCFM | dContactApprox1_1 |
                       dContactApprox1_2 | dContactSlip1 | dContactSlip2 | dContactMotion1 | dContactMotion2;
        surface.mu = is.mu_peak;
        surface.slip1 = surface.slip2 = theta * (rim_m_s + bends_m_s) / load_n;
        surface.motion1 = first[0] * motion[0] + first[1] * motion[1];
        surface.motion2 = first[0] * motion[1] - first[1] * motion[0];
        // A spring and a damper (ODE manual, section 3.8.2).
        const double spring = 0.25 * mass_kg * SPRINGS_RAD_S * SPRINGS_RAD_S;
        const double damper = 2.0 * SPRINGS_DAMPING * 0.25 * mass_kg * SPRINGS_RAD_S;
        surface.soft_erp = step_s * spring / (step_s * spring + damper);
        surface.soft_cfm = 1.0 / (step_s * spring + damper);
        const dJointID joint = dJointCreateContact(world, group, &contact);
        dJointAttach(joint, wheel.body, nullptr);
        dJointSetFeedback(joint, &wheel.contact_feedback);
    }

    void measure(Wheel &wheel, double target_rad_s) {
        dVector3 axle;
        dJointGetHingeAxis(wheel.hinge, axle);
        if (!wheel.touches) wheel.contact_feedback = {};
        wheel.load_n = wheel.contact_feedback.f1[2];
        dVector3 speed;
        const dReal *center = dBodyGetPosition(wheel.body);
        dBodyGetPointVel(wheel.body, center[0], center[1], center[2] - wheel.radius_m, speed);
        for (int axis = 0; axis < 2; ++axis) {
            wheel.force_n[axis] = dot(wheel.contact_feedback.f1, wheel.direction[axis]);
            wheel.mu[axis] = wheel.load_n > 0.0 ? wheel.force_n[axis] / wheel.load_n : 0.0;
            wheel.slip_m_s[axis] = -dot(speed, wheel.direction[axis]);
        }
        wheel.rate_rad_s = dJointGetHingeAngleRate(wheel.hinge);
        wheel.turned_rad += step_s * wheel.rate_rad_s;
        wheel.motor_n_m = dot(wheel.hinge_feedback.t1, axle);
        // Anti-windup: the integral does not change while the torque is limited.
        if (std::fabs(wheel.motor_n_m) < (1.0 - 1.0e-6) * is.torque_limit_n_m) {
            const double rate = gain(wheel) / (RESET_OVER_LAG * is.servo_lag_s);
            wheel.integral_n_m += rate * (target_rad_s - wheel.rate_rad_s) * step_s;
        }
    }
};

// Reads KEY=VALUE pairs: each key once, and no other.
Parameters parameters_of(std::istringstream &words) {
    std::map<std::string, double> found;
    for (std::string word; words >> word;) {
        const size_t equals = word.find('=');
        if (equals == std::string::npos) fail("`" + word + "` is not KEY=VALUE");
        char *end = nullptr;
        const std::string key = word.substr(0, equals), text = word.substr(equals + 1);
        const double value = std::strtod(text.c_str(), &end);
        if (text.empty() || *end != '\0' || !std::isfinite(value)) fail("`" + word + "` has no number");
        if (!found.emplace(key, value).second) fail("`" + key + "` is there twice");
    }
    Parameters parameters = {};
    for (const Key &key : KEYS) {
        const auto given = found.find(key.name);
        if (given == found.end()) fail(std::string("`") + key.name + "` is missing");
        const double value = given->second;
        if (key.range == Key::POSITIVE && value <= 0.0) fail(std::string("`") + key.name + "` must be above zero");
        if (key.range == Key::NOT_NEGATIVE && value < 0.0) {
            fail(std::string("`") + key.name + "` must not be below zero");
        }
        parameters.*key.value = value;
        found.erase(given);
    }
    if (!found.empty()) fail("nothing is named `" + found.begin()->first + "`");
    if (parameters.step_s > STEP_MAX_S) fail("`step_s` must be at most 0.001");
    return parameters;
}

} // namespace

int main() {
    dInitODE2(0);
    dSetMessageHandler(on_message);
    Robot *robot = nullptr;
    for (std::string line; std::getline(std::cin, line);) {
        std::istringstream words(line);
        std::string verb;
        words >> verb;
        if (verb == "robot") {
            if (robot != nullptr) fail("there is a robot already");
            robot = new Robot(parameters_of(words));
            std::cout << "ready" << std::endl;
            continue;
        }
        if (robot == nullptr) fail("begin with `robot KEY=VALUE ...`");
        double first = 0.0, second = 0.0;
        long steps = 0;
        if (verb == "drive" && words >> first >> second >> steps && steps > 0 && steps <= STEPS_MAX) {
            std::cout << robot->drive(first, second, steps) << std::endl;
        } else if (verb == "pull" && words >> first >> second) {
            robot->pull(first, second);
            std::cout << "ok" << std::endl;
        } else if (verb == "wheels") {
            std::cout << robot->wheels() << std::endl;
        } else {
            fail("`" + line + "` is no command");
        }
    }
    return 0;
}
