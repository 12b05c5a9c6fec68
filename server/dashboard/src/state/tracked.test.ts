import { expect, test } from 'vitest';
import type { DriveView, Robot } from '../api/schema';
import { Tracked } from './tracked';

/** rover-1 at a place of the x axis, driving along it. */
function robot(x_m: number, speed_m_s: number, link = 'online'): Robot {
  return {
    id: 'rover-1',
    name: 'rover-1',
    link,
    live: {
      state_age_ms: 0,
      pose: { value: { x_m, y_m: 0, heading_rad: 0 }, age_ms: 0 },
      twist: { value: { linear_m_s: speed_m_s, angular_rad_s: 0 }, age_ms: 0 },
      safety: {},
    },
  } as unknown as Robot;
}

function driven(until_ms: number): Tracked {
  const tracked = new Tracked(robot(0, 1), 0);
  for (let at_ms = 200; at_ms <= until_ms; at_ms += 200) tracked.update(robot(at_ms / 1000, 1), at_ms);
  return tracked;
}

test('a trail ends where its robot is drawn, and not before it', () => {
  const tracked = driven(9_000);
  const shown = tracked.shownAt(9_000);
  const end_m = tracked.trail.at(-2) ?? NaN;
  expect(end_m).toBeLessThanOrEqual(shown?.pose.x_m ?? NaN);
  expect(end_m).toBeGreaterThan((shown?.pose.x_m ?? NaN) - 0.21);
});

test('a trail grows while nobody looks at the page, too', () => {
  const tracked = driven(60_000);
  expect(tracked.trail.length).toBeGreaterThan(300);
});

test('a robot that is lost is drawn where it was last', () => {
  const tracked = driven(9_000);
  tracked.update(robot(9, 1, 'offline'), 9_400);
  expect(tracked.shownAt(15_000)).toMatchObject({ pose: { x_m: 9 }, isMoving: false, isFrozen: false });
});

test('a robot whose link is stale stands where it is drawn', () => {
  const tracked = driven(9_000);
  const moving = tracked.shownAt(9_700);
  expect(moving?.isMoving).toBe(true);
  tracked.update(robot(9, 1, 'stale'), 9_000);
  expect(tracked.shownAt(9_900)).toEqual({ pose: moving?.pose, isMoving: false, isFrozen: true });
});

test('the drive socket moves its robot between the states of the stream', () => {
  const tracked = driven(9_000);
  const { live } = robot(9.1, 1);
  for (let at_ms = 9_100; at_ms <= 12_000; at_ms += 100) {
    const pose = { value: { x_m: at_ms / 1000, y_m: 0, heading_rad: 0 }, age_ms: 0 };
    expect(tracked.seen({ ...live, pose } as unknown as DriveView, at_ms)).toBe(true);
  }
  // Twice as many states make it half as late.
  expect(12 - (tracked.shownAt(12_000)?.pose.x_m ?? NaN)).toBeLessThan(0.13);
});

test('a robot that stands and says the same needs no frame, one that is stopped does', () => {
  const tracked = new Tracked(robot(1, 0), 0);
  expect(tracked.update(robot(1, 0), 200)).toBe(false);
  const stopped = robot(1, 0);
  if (stopped.live) stopped.live.safety = { stop: { id: 'a stop' } } as unknown as typeof stopped.live.safety;
  expect(tracked.update(stopped, 400)).toBe(true);
  expect(tracked.update(stopped, 600)).toBe(false);
});

test('samples of curves have the time at which they came, and sparse ones are kept from the first on', () => {
  const tracked = new Tracked(robot(0, 1), 10);
  for (let at_ms = 210; at_ms <= 2_210; at_ms += 200) tracked.update(robot(at_ms / 1000, 1), at_ms, 900);
  expect(tracked.samples.map((sample) => sample.at_s)).toEqual([0.01, 1.01, 2.01]);
});
