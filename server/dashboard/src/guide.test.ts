import { expect, test } from 'vitest';
import type { CellFriction, Mission, Robot } from './api/schema';
import { around, doneOf, enrolment, followed, measuredSince, nextOf, type Sent } from './guide';

const robot = (link: string) => ({ id: 'rover-1', link }) as unknown as Robot;
const sent: Sent = { id: 'm-1', site: 'yard', robot: 'rover-1', started_at: null };
const BEGAN = '2026-01-31T12:00:00Z';
const driving = { ...sent, started_at: BEGAN };
const PLACE = [{ x_m: 1, y_m: 1 }];

test('each step is done when the state shows it, and the first that is not comes next', () => {
  const next = (...of: Parameters<typeof doneOf>) => nextOf(doneOf(...of));
  expect(next([], null, [])).toBe('robot');
  expect(next([robot('offline'), robot('stale')], null, [])).toBe('robot');
  expect(next([robot('offline'), robot('online')], null, [])).toBe('mission');
  expect(next([robot('online')], sent, [])).toBe('mission');
  expect(next([robot('online')], driving, [])).toBe('friction');
  expect(next([robot('online')], driving, PLACE)).toBeNull();
  // A robot that goes away is missed again.
  expect(next([robot('offline')], driving, PLACE)).toBe('robot');
});

test('a mission that was sent is followed by its identifier', () => {
  const mission = { id: 'm-1', started_at: BEGAN } as unknown as Mission;
  expect(followed(sent, mission)).toEqual(driving);
  expect(followed(sent, { ...mission, id: 'm-2' })).toEqual(sent);
  expect(followed(driving, { ...mission, started_at: null })).toEqual(driving);
  expect([followed(sent, undefined), followed(null, mission)]).toEqual([sent, null]);
});

test('friction counts that was measured since the mission began, by its robot’s model', () => {
  const cell = (ix: number, newest_at: string, configuration = 'a') =>
    ({ cell: { ix, iy: 2 }, size_m: 0.5, configuration, friction: { newest_at } }) as unknown as CellFriction;
  const cells = [cell(4, '2026-01-31T12:00:07+00:00'), cell(5, '2026-01-31T11:59:59Z'), cell(6, '2026-01-31T12:00:07Z', 'b')];
  expect(measuredSince(cells, BEGAN, 'a')).toEqual([
    { x_m: 2, y_m: 1 },
    { x_m: 2.5, y_m: 1.5 },
  ]);
  expect(measuredSince(cells, BEGAN, undefined)).toEqual([]);
});

test('friction is looked for around the path', () => {
  expect(around([{ x_m: 1, y_m: 5 }, { x_m: 3, y_m: 2 }], 0.5)).toEqual({ xMin: 0.5, yMin: 1.5, xMax: 3.5, yMax: 5.5 });
  expect(around([], 1)).toBeNull();
});

test('the commands for a robot to join name this server and site', () => {
  const lines = enrolment('https://tread.example.org:8420', 'yard').split('\n');
  expect(lines[0]).toMatch(/^tread robots join-token --site yard /);
  expect(lines[1]).toMatch(/^tread-agent enroll --server https:\/\/tread\.example\.org:8420 /);
  expect(lines.length).toBe(3);
});
