import { expect, test } from 'vitest';
import type { Trajectory } from '../api/schema';
import { planned, withApproach } from './approach';

const line = Array.from({ length: 101 }, (_, index) => ({ x_m: index / 10, y_m: 0 }));
const path = { step_m: 0.1, points: line };

test('an approach of a stated length ends there, and is never longer than its path', () => {
  expect(withApproach(path, 2.5).approach).toBe(25);
  expect(withApproach(path, 0).approach).toBe(0);
  expect(withApproach(path, 99).approach).toBe(101);
  expect(withApproach({ step_m: 0, points: [] }, 1).approach).toBe(0);
});

test('what a plan is longer than the turns of its circle is the approach', () => {
  const circle = { circle: { center: { x_m: 0, y_m: 0 }, radius_m: 1, turns: 3 } } as unknown as Trajectory;
  expect(planned(path, circle, 6 * Math.PI + 4).approach).toBe(40);
  // Nothing is known of the plan: nothing is dashed.
  expect(planned(path, circle, undefined).approach).toBe(0);
});

test('an approach ends at the first waypoint', () => {
  const through = (x_m: number) =>
    ({ waypoints: { points: [{ x_m, y_m: 0.01 }, { x_m: 9, y_m: 0 }] } }) as unknown as Trajectory;
  expect(planned(path, through(3.04), undefined).approach).toBe(30);
  expect(planned(path, through(0), undefined).approach).toBe(0);
  expect(planned(path, through(-5), undefined).approach).toBe(0);
});
