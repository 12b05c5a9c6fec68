// What a value of the friction map means for a robot model. Pure.
//
// θ is slip per friction coefficient that is demanded: σ = θ μ. In a steady turn of radius R at v the
// four wheels together need μ = v²/(gR) laterally, and accelerating by a needs a/g longitudinally,
// whatever the mass. The robot drives with a sideslip of β = θ v²/(gR) (1 − (W² + L²)/(4R²)) then
// (docs/control.md, "The model"), and its rims run ahead of the ground by λ = θ a/g.
//
// θ says nothing of how much friction there is at most. That is the traction limit, which is shown
// by what robots have used: a stop from v with all of it takes v²/(2 μ g), or more where the model's own
// limit of braking is less. Neither is derived from the other.
import type { RobotModel } from '../api/schema';

/** Standard gravity, m/s². */
const G_M_S2 = 9.80665;
/** Slip up to which friction is proportional to it, so that θ tells the slip. */
export const SLIP_LINEAR = 0.2;
/** The model holds for turns that are wider than this many times the diagonal of the wheels. */
const WIDE = 2;

/** What a robot model does at the limits that its agent declares. */
export interface Demand {
  speed_m_s: number;
  radius_m: number;
  acceleration_m_s2: number;
  /** Friction coefficient that it needs. */
  mu: number;
  /** Force of the ground that it needs, newtons. */
  force_n: number;
  /** Share of lateral slip that is sideslip, less than 1 in tight turns. */
  tight_ratio: number;
}

/** The turn at top speed with the most lateral acceleration, while it gathers or loses speed as fast as it may. */
export function demandOf(model: RobotModel): Demand {
  const { limits, track_width_m, wheelbase_m } = model;
  const speed_m_s = limits.linear_max_m_s;
  const diagonal_m = Math.hypot(track_width_m, wheelbase_m);
  const radius_m = Math.max(
    speed_m_s ** 2 / limits.lateral_acceleration_max_m_s2,
    speed_m_s / limits.angular_max_rad_s,
    WIDE * diagonal_m,
  );
  const acceleration_m_s2 = limits.linear_acceleration_max_m_s2;
  const total_m_s2 = Math.hypot(speed_m_s ** 2 / radius_m, acceleration_m_s2);
  return {
    speed_m_s,
    radius_m,
    acceleration_m_s2,
    mu: total_m_s2 / G_M_S2,
    force_n: model.mass_kg * total_m_s2,
    tight_ratio: 1 - (diagonal_m / (2 * radius_m)) ** 2,
  };
}

/** Expected slip on ground of a θ; null beyond the range in which θ tells it. */
export function slipOf(theta: number, demand: Demand): number | null {
  const lateral = ((theta * demand.speed_m_s ** 2) / (G_M_S2 * demand.radius_m)) * demand.tight_ratio;
  const longitudinal = (theta * demand.acceleration_m_s2) / G_M_S2;
  const slip = Math.hypot(lateral, longitudinal);
  return slip <= SLIP_LINEAR ? slip : null;
}

/**
 * Distance in which a robot stops from its top speed once it brakes, with a friction coefficient and
 * no harder than its model may, metres; null where no friction was shown.
 */
export function stoppingM(mu: number | null | undefined, { speed_m_s, acceleration_m_s2 }: Demand): number | null {
  return mu ? speed_m_s ** 2 / (2 * Math.min(mu * G_M_S2, acceleration_m_s2)) : null;
}
