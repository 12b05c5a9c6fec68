import { expect, test } from 'vitest';
import type { Mission, Robot } from './api/schema';
import { Pace, remainingS, roughly, startsInS } from './eta';

const LENGTH_M = 60;
const DURATION_S = 120;

function mission(changes: object = {}): Mission {
  const plan = { length_m: LENGTH_M, duration_s: DURATION_S, speed_peak_m_s: 0.6 };
  const asked = { id: 'm-1', robot: 'rover-1', state: 'active', pause_requested: false, priority: 0, revision: 1, plan };
  return { ...asked, ...changes } as unknown as Mission;
}

function progress(driven_m: number, changes: object = {}) {
  const said = { id: 'm-1', driven_m, length_m: LENGTH_M, cross_track_m: 0, plan_hash: 'p', revision: 1 };
  return { ...said, ...changes } as unknown as NonNullable<NonNullable<Robot['live']>['mission']>;
}

function robot(driven_m: number, changes: object = {}, live: object = {}): Robot {
  const said = { mode: 'tracking', safety: { stop: null }, mission: progress(driven_m), ...live };
  return { id: 'rover-1', link: 'online', live: said, ...changes } as unknown as Robot;
}

/** A robot that drives at a speed for a time, heard once a second. */
function driven(speed_m_s: number, time_s: number, from_m = 0): { pace: Pace; at_m: number } {
  const pace = new Pace();
  for (let at_s = 0; at_s <= time_s; at_s += 1) pace.note('rover-1', progress(from_m + speed_m_s * at_s), at_s * 1000);
  return { pace, at_m: from_m + speed_m_s * time_s };
}

test('without anything observed the plan counts', () => {
  expect(remainingS(mission(), robot(0), 0, new Pace())).toBe(DURATION_S);
  expect(remainingS(mission(), robot(LENGTH_M / 2), 0, new Pace())).toBe(DURATION_S / 2);
  expect(remainingS(mission(), robot(LENGTH_M / 2), 1.5, new Pace())).toBe(DURATION_S / 2 - 1.5);
  expect(remainingS(mission(), robot(LENGTH_M), 1, new Pace())).toBe(0);
});

test('a robot that keeps to its plan counts down second by second', () => {
  for (let at_s = 0; at_s <= DURATION_S; at_s += 1) {
    const { pace, at_m } = driven(LENGTH_M / DURATION_S, at_s);
    expect(remainingS(mission(), robot(at_m), 0, pace)).toBeCloseTo(DURATION_S - at_s, 6);
  }
});

test('a robot that is held to half of its speed is expected later, and the closer the better', () => {
  const speed_m_s = LENGTH_M / DURATION_S / 2;
  const wrong = (at_s: number) => {
    const { pace, at_m } = driven(speed_m_s, at_s);
    const truth_s = (LENGTH_M - at_m) / speed_m_s;
    return Math.abs((remainingS(mission(), robot(at_m), 0, pace) ?? NaN) - truth_s) / truth_s;
  };
  expect([wrong(0), wrong(20), wrong(60)].map((share) => Math.round(share * 100))).toEqual([50, 33, 20]);
  expect(wrong(200)).toBeLessThan(0.15);
});

test('only the last two minutes count', () => {
  const pace = new Pace();
  let at_m = 0;
  for (let at_s = 0; at_s <= 400; at_s += 1) {
    at_m += at_s < 250 ? 0.01 : 0.5;
    pace.note('rover-1', progress(at_m), at_s * 1000);
  }
  expect(pace.of('rover-1').time_s).toBe(120);
  expect(pace.of('rover-1').distance_m).toBeCloseTo(60, 6);
});

test('nothing is said where the end cannot be known', () => {
  const { pace, at_m } = driven(0.5, 10);
  const known = remainingS(mission(), robot(at_m), 0, pace);
  expect(known).toBeCloseTo(110, 6);
  for (const changes of [
    { state: 'paused' },
    { state: 'cancelling' },
    { state: 'queued' },
    { pause_requested: true },
    { plan: null },
    { replacement: { revision: 2 } },
    { revision: 2 },
    { id: 'm-2' },
  ]) {
    expect(remainingS(mission(changes), robot(at_m), 0, pace), JSON.stringify(changes)).toBeNull();
  }
  for (const other of [
    robot(at_m, { link: 'stale' }),
    robot(at_m, { link: 'offline' }),
    robot(at_m, { live: null }),
    robot(at_m, {}, { mode: 'teleoperated' }),
    robot(at_m, {}, { safety: { stop: { id: 's' } } }),
    robot(at_m, {}, { mission: null }),
    robot(at_m, {}, { mission: progress(at_m, { paused: true }) }),
    robot(at_m, {}, { mission: progress(at_m, { paused_by: 'stop' }) }),
    undefined,
  ]) {
    expect(remainingS(mission(), other, 0, pace)).toBeNull();
  }
  // Not heard for some time.
  expect(remainingS(mission(), robot(at_m), 6, pace)).toBeNull();
  // It does not get on.
  expect(remainingS(mission(), robot(5), 0, driven(0.02, 12, 4).pace)).toBeNull();
  expect(remainingS(mission(), robot(5), 0, driven(0.02, 5, 4).pace)).not.toBeNull();
});

test('a pause, another path and a step back begin the observation anew', () => {
  for (const after of [progress(9, { paused: true }), progress(9, { plan_hash: 'q' }), progress(3), null]) {
    const { pace } = driven(0.5, 20);
    pace.note('rover-1', after, 21_000);
    expect(pace.of('rover-1').time_s).toBe(0);
  }
});

test('what waits begins after what is before it, in the order of its robot', () => {
  const active = mission();
  const first = mission({ id: 'm-2', state: 'queued', plan: null });
  const urgent = mission({ id: 'm-3', state: 'queued', priority: 5 });
  const foreign = mission({ id: 'm-0', state: 'queued', robot: 'rover-2' });
  const left = (other: Mission) => (other === active ? 40 : null);
  expect(startsInS(first, [active, first, foreign], left)).toBe(40);
  // The urgent one has a plan, and is driven before.
  expect(startsInS(urgent, [active, first, urgent], left)).toBe(40);
  expect(startsInS(first, [active, first, urgent], left)).toBe(40 + DURATION_S);
  // How long the first one takes is not known.
  const last = mission({ id: 'm-4', state: 'queued', plan: null });
  expect(startsInS(last, [active, first, last], left)).toBeNull();
  expect(startsInS(first, [active, first], () => null)).toBeNull();
  expect(startsInS(first, [first], left)).toBeNull();
  expect(startsInS(active, [active], left)).toBeNull();
});

test('an estimate is no more exact than it can be', () => {
  expect([0, 7, 8, 57, 58, 61, 66, 594, 596, 3_569, 3_571, 5_000].map(roughly)).toEqual(
    [5, 5, 10, 55, 60, 60, 70, 590, 600, 3_540, 3_600, 5_100],
  );
});
