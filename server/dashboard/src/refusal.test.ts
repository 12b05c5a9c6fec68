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

const beyond = (more: Partial<ProblemBody> = {}) => problem('it cannot be driven', { type: '/problems/beyond-limits', ...more });
const tight = (more: Partial<ProblemBody> = {}) => problem('it turns', { type: '/problems/turn-too-sharp', ...more });
const at = (waypoint: number) => ({ place: { point: { x_m: 1, y_m: 2 }, waypoint } });

test('the field of a problem names the point and its coordinate', () => {
  for (const [field, point, axis] of [
    ['polygon[3].x_m', 4, 'x_m'],
    ['keep_out[1][2].y_m', 3, 'y_m'],
    ['trajectory.waypoints.points[0].x_m', 1, 'x_m'],
    ['trajectory.waypoints.points[1].speed_m_s', 2, null],
    ['/corners/3/x_m', 4, 'x_m'],
    ['/keep_in/0/5/y_m', 6, 'y_m'],
    ['polygon[7]', 8, null],
  ] as const) {
    const { points, axis: said, field: ofForm } = refusalOf(problem('expected f64', { field }), true);
    expect([points, said, ofForm], field).toEqual([[point], axis, null]);
  }
  // The place of an area in the geofence is no corner.
  expect(refusalOf(problem('too small', { field: 'keep_out[3]' }), true).points).toEqual([]);
});

test('the place of a problem names the point where the field names none', () => {
  expect(refusalOf(beyond(at(6)), true)).toMatchObject({ kind: null, points: [7] });
  expect(refusalOf(beyond({ field: 'trajectory.waypoints.points[2]', ...at(6) }), true).points).toEqual([3]);
});

test('a turn that is too sharp is known from the type, and its point from the place', () => {
  expect(refusalOf(tight(at(0)), true)).toMatchObject({ kind: 'tight', points: [1] });
  // On the approach to a circle there is no point.
  expect(refusalOf(tight(), false)).toMatchObject({ kind: null, points: [], field: null, detail: 'it turns' });
});

test('the field of a problem names the field of the form', () => {
  for (const [path, field] of [
    ['trajectory.circle.radius_m', 'radius'],
    ['trajectory.circle.turns', 'turns'],
    ['trajectory.circle.speed_m_s', 'speed'],
    ['trajectory.circle.period_s', 'speed'],
    ['trajectory.circle.center', 'center'],
    ['trajectory.circle.center.x_m', 'center'],
    ['trajectory.circle.options.excitation.period_s', null],
    ['trajectory.circle', null],
    ['priority', 'priority'],
  ] as const) {
    const refusal = refusalOf(problem('it is not within its range', { field: path }), false);
    expect([refusal.field, refusal.points, refusal.detail], path).toEqual([field, [], 'it is not within its range']);
  }
  expect(refusalOf(beyond({ field: 'trajectory.waypoints.speed_m_s' }), true)).toMatchObject({ field: 'speed', points: [] });
});

test('the sentence of the server is quoted and never read', () => {
  for (const said of ['the path turns too sharply near waypoint 0', 'points[3].heading_rad must be a finite number']) {
    expect(refusalOf(problem(said), true)).toMatchObject({ kind: null, points: [], axis: null, field: null, detail: counted(said) });
  }
  expect(refusalOf(problem('the radius must be at least 0.1 m, not 0.05 m'), false).field).toBeNull();
});

test('the words of the server keep everything but its indices', () => {
  expect(counted('points[1].speed_m_s must be 0.05 to 50, not 90')).toBe('speed_m_s of point 2 must be 0.05 to 50, not 90');
  expect(counted('corners 2 and 3 are the same point')).toBe('corners 3 and 4 are the same point');
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
