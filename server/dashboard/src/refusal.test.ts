import { expect, test } from 'vitest';
import type { ProblemBody } from './api/schema';
import { counted, refusalOf } from './refusal';

const problem = (detail: string | null, more: Partial<ProblemBody> = {}): ProblemBody => ({
  type: '/problems/invalid-body',
  title: 'The body is invalid',
  status: 422,
  detail,
  ...more,
});

test('indices of the server become the numbers of the table, which begins at 1', () => {
  for (const [said, kind, points] of [
    ['the side from corner 0 at (0.00 m, 0.00 m) crosses or touches the side from corner 2 at (4.00 m, 0.00 m)', 'crosses', [1, 3]],
    ['corners 2 and 3 are the same point; leave out the closing corner', 'same', [3, 4]],
    ['corner 9 is not within 1000000 m of the origin', 'far', [10]],
    ['points[1] repeats the point before it; keep neighbours 0.01 m apart', 'repeats', [2]],
    ['waypoint 4 is at the same place as the one before', 'repeats', [5]],
    ['the path turns too sharply near waypoint 0', 'tight', [1]],
    ['points[3].heading_rad must be a finite number', null, [4]],
  ] as const) {
    const refusal = refusalOf(problem(said), true);
    expect([refusal.kind, refusal.points]).toEqual([kind, points]);
  }
});

test('the field of a problem names the point and its coordinate', () => {
  for (const [field, point, axis] of [
    ['polygon[3].x_m', 4, 'x_m'],
    ['keep_out[1][2].y_m', 3, 'y_m'],
    ['trajectory.waypoints.points[0].x_m', 1, 'x_m'],
    ['/corners/3/x_m', 4, 'x_m'],
    ['/keep_in/0/5/y_m', 6, 'y_m'],
    ['polygon[7]', 8, null],
  ] as const) {
    const { points, axis: said } = refusalOf(problem('expected f64', { field }), true);
    expect([points, said], field).toEqual([[point], axis]);
  }
  expect(refusalOf(problem('it cannot be driven', { place: { point: { x_m: 1, y_m: 2 }, waypoint: 6 } }), true).points).toEqual([7]);
  // The place of an area in the geofence is no corner.
  expect(refusalOf(problem('too small', { field: 'keep_out[3]' }), true).points).toEqual([]);
});

test('of a circle, which has no points, the field is named', () => {
  for (const [said, field] of [
    ['the radius must be at least 0.1 m, not 0.05 m', 'radius'],
    ['turns must be 0.05 to 1000, not 99999', 'turns'],
    ['the speed must be 0.05 to 50 m/s, not 0', 'speed'],
    ['the centre must be within 1000000 m of the origin', 'center'],
    ['the path is 700000 m long, above the limit of 100000 m', null],
  ] as const) {
    const refusal = refusalOf(problem(said), false);
    expect([refusal.field, refusal.points, refusal.detail]).toEqual([field, [], said]);
  }
  expect(refusalOf(problem('the path turns too sharply near waypoint 0'), false).detail).toBe('the path turns too sharply');
});

test('the words of the server keep everything but its indices', () => {
  expect(counted('points[1].speed_m_s must be 0.05 to 50, not 90')).toBe('speed_m_s of point 2 must be 0.05 to 50, not 90');
  expect(counted('near corner 11 at (2.00 m, 0.00 m)')).toBe('near corner 12 at (2.00 m, 0.00 m)');
  expect(counted('a polygon has 3 to 1000 corners, this one has 2')).toBe('a polygon has 3 to 1000 corners, this one has 2');
});

test('what is wrong is known from the type and the draft, whatever the server’s sentence', () => {
  const corners = ([[-9, -9], [-5, -9], [-9, -7], [-4, -8]] as const).map(([x_m, y_m]) => ({ x_m, y_m }));
  const crossed = refusalOf(problem('words of another release', { field: 'polygon' }), true, { points: corners, isArea: true });
  expect([crossed.kind, crossed.points]).toEqual(['crosses', [2, 4]]);
  const repeated = refusalOf(problem('words of another release'), true, { points: [...corners, corners[3] ?? { x_m: 0, y_m: 0 }], isArea: false });
  expect([repeated.kind, repeated.points]).toEqual(['repeats', [5]]);
  // Another type is no matter of its shape.
  const busy = refusalOf(problem('busy', { type: '/problems/robot-busy' }), true, { points: corners, isArea: true });
  expect([busy.kind, busy.points, busy.detail]).toEqual([null, [], 'busy']);
});

test('a place or a field says which point it is, also if the sentence names something else', () => {
  const place = { point: { x_m: 1, y_m: 2 }, waypoint: 6 };
  const outside = refusalOf(problem('the path leaves the geofence near corner 2', { type: '/problems/crosses-geofence', place }), true);
  expect(outside.points).toEqual([7]);
  expect(refusalOf(problem('the path turns too sharply near waypoint 6', { place }), true)).toMatchObject({ kind: 'tight', points: [7] });
  expect(refusalOf(problem('turns and speed do not fit', { field: 'trajectory.circle.speed_m_s' }), false).field).toBe('speed');
});
