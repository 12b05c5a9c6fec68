import { expect, test } from 'vitest';
import type { RobotModel } from '../api/schema';
import { demandOf, slipOf, stoppingM } from './meaning';

const model = {
  mass_kg: 30,
  track_width_m: 0.4,
  wheelbase_m: 0.3,
  limits: {
    linear_max_m_s: 1,
    angular_max_rad_s: 2,
    linear_acceleration_max_m_s2: 0.8,
    lateral_acceleration_max_m_s2: 0.5,
  },
} as unknown as RobotModel;

test('the turn and the acceleration are those of the limits of the model', () => {
  const demand = demandOf(model);
  expect(demand.radius_m).toBeCloseTo(2, 12);
  expect(demand.mu).toBeCloseTo(Math.hypot(0.5, 0.8) / 9.80665, 12);
  expect(demand.force_n).toBeCloseTo(30 * Math.hypot(0.5, 0.8), 12);
  // A robot that cannot turn so fast turns as fast as it can.
  const slow = { ...model, limits: { ...model.limits, angular_max_rad_s: 0.25 } };
  expect(demandOf(slow).radius_m).toBeCloseTo(4, 12);
});

test('the slip is θ times the friction coefficient that is demanded, whatever the mass', () => {
  const demand = demandOf(model);
  const wide = { ...demand, tight_ratio: 1 };
  expect(slipOf(0.3, wide)).toBeCloseTo(0.3 * demand.mu, 12);
  expect(slipOf(0.6, demand)).toBeCloseTo(2 * (slipOf(0.3, demand) ?? NaN), 12);
  expect(slipOf(0.3, demandOf({ ...model, mass_kg: 90 }))).toBe(slipOf(0.3, demand));
  // In tight turns the sideslip is less: by (W² + L²)/(4R²).
  expect(demand.tight_ratio).toBeCloseTo(1 - 0.25 / 16, 12);
});

test('beyond the linear range θ does not tell the slip', () => {
  expect(slipOf(4, demandOf(model))).toBeNull();
});

test('a stop takes v²/(2 μ g), longer where the model brakes more softly, and is unknown where no friction was shown', () => {
  const demand = demandOf(model);
  expect(stoppingM(0.04, demand)).toBeCloseTo(1 / (2 * 0.04 * 9.80665), 12);
  expect(stoppingM(0.9, demand)).toBeCloseTo(1 / (2 * 0.8), 12);
  expect(stoppingM(null, demand)).toBeNull();
  expect(stoppingM(0, demand)).toBeNull();
});
