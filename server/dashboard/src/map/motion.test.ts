import { expect, test } from 'vitest';
import { DELAY_MAX_MS, EXTRAPOLATION_MAX_MS, JUMP_M, Motion, turnOf, type State } from './motion';

const PERIOD_MS = 200;

/** A state on a straight line along x at a speed. */
function straight(at_ms: number, speed_m_s: number, heading_rad = 0): State {
  return {
    at_ms,
    pose: { x_m: (speed_m_s * at_ms) / 1000, y_m: 0, heading_rad },
    twist: { linear_m_s: speed_m_s, angular_rad_s: 0 },
  };
}

/** States of some seconds at the rate of robots. */
function driven(speed_m_s: number, until_ms: number): Motion {
  const motion = new Motion();
  for (let at_ms = 0; at_ms <= until_ms; at_ms += PERIOD_MS) motion.push(straight(at_ms, speed_m_s));
  return motion;
}

test('a robot that drives evenly is drawn evenly, about one state period late', () => {
  const motion = new Motion();
  for (let at_ms = -10_000; at_ms < 0; at_ms += PERIOD_MS) motion.push(straight(at_ms, 0.8));
  const speed_m_s = 0.8;
  let next_ms = 0;
  let last_m: number | null = null;
  for (let now_ms = 0; now_ms < 6_000; now_ms += 20) {
    if (now_ms >= next_ms) {
      motion.push(straight(next_ms, speed_m_s));
      next_ms += PERIOD_MS;
    }
    const shown = motion.at(now_ms);
    if (!shown) throw new Error('a state was heard');
    const late_ms = now_ms - (shown.pose.x_m / speed_m_s) * 1000;
    if (now_ms > 1_000) {
      expect(late_ms).toBeGreaterThan(PERIOD_MS);
      expect(late_ms).toBeLessThan(1.5 * PERIOD_MS);
      expect(shown.isMoving).toBe(true);
      expect(shown.pose.x_m - (last_m ?? 0)).toBeCloseTo(speed_m_s * 0.02, 5);
    }
    last_m = shown.pose.x_m;
  }
});

test('states that come unevenly, about once a second, never let a robot that moves freeze', () => {
  const motion = new Motion();
  // As a server says them: each second the newest of a robot's five.
  for (let now_ms = 0, next_ms = 0; now_ms < 60_000; now_ms += 20) {
    if (now_ms >= next_ms) {
      motion.push(straight(Math.floor((now_ms - 10) / PERIOD_MS) * PERIOD_MS, 0.7));
      next_ms = now_ms + 1_030 + (now_ms % 7) * 10;
    }
    if (now_ms > 3_000) expect(motion.at(now_ms)?.isFrozen).toBe(false);
  }
});

test('of states that come once a second most of the time is bridged by the twist', () => {
  const motion = new Motion();
  const speed_m_s = 0.8;
  let last_m: number | null = null;
  for (let now_ms = 0; now_ms < 12_000; now_ms += 20) {
    if (now_ms % 1_000 === 100) motion.push(straight(now_ms - 100, speed_m_s));
    const shown = motion.at(now_ms);
    if (now_ms < 4_000) continue;
    expect(shown).toMatchObject({ isMoving: true, isFrozen: false });
    const late_ms = now_ms - ((shown?.pose.x_m ?? NaN) / speed_m_s) * 1000;
    expect(late_ms).toBeCloseTo(DELAY_MAX_MS, 5);
    if (last_m !== null) expect((shown?.pose.x_m ?? NaN) - last_m).toBeCloseTo(speed_m_s * 0.02, 5);
    last_m = shown?.pose.x_m ?? NaN;
  }
});

test('between states that are far apart a bend is drawn as a bend', () => {
  const motion = new Motion();
  const radius_m = 2;
  const angular_rad_s = 0.4;
  const on = (at_ms: number): State => {
    const turned = (angular_rad_s * at_ms) / 1000;
    return {
      at_ms,
      pose: { x_m: radius_m * Math.sin(turned), y_m: radius_m * (1 - Math.cos(turned)), heading_rad: turned },
      twist: { linear_m_s: radius_m * angular_rad_s, angular_rad_s },
    };
  };
  motion.push(on(0));
  motion.push(on(1_000));
  for (const at_ms of [200, 500, 900]) {
    const pose = motion.at(at_ms + motion.delay_ms)?.pose;
    const away_m = Math.abs(Math.hypot(pose?.x_m ?? NaN, (pose?.y_m ?? NaN) - radius_m) - radius_m);
    // A chord would be 40 mm off the bend.
    expect(away_m).toBeLessThan(0.001);
  }
});

test('a bend of which states come once a second is drawn on its arc, no later than a line', () => {
  const motion = new Motion();
  const [radius_m, angular_rad_s] = [2, 0.3];
  const on = (at_ms: number): State => {
    const turned = (angular_rad_s * at_ms) / 1000;
    const pose = { x_m: radius_m * Math.sin(turned), y_m: radius_m * (1 - Math.cos(turned)), heading_rad: turned };
    return { at_ms, pose, twist: { linear_m_s: radius_m * angular_rad_s, angular_rad_s } };
  };
  for (let now_ms = 0; now_ms < 20_000; now_ms += 20) {
    // As a server says it: up to a fifth of a second old.
    if (now_ms % 1_040 === 0) motion.push(on(now_ms - (now_ms % 200)));
    const [drawn, is] = [motion.at(now_ms)?.pose, on(now_ms - DELAY_MAX_MS).pose];
    if (now_ms > 2_000) expect(Math.hypot((drawn?.x_m ?? NaN) - is.x_m, (drawn?.y_m ?? NaN) - is.y_m)).toBeLessThan(0.01);
  }
});

test('what the twist predicted wrong is made good without a step', () => {
  const motion = new Motion();
  for (let at_ms = 0; at_ms <= 4_000; at_ms += 1_000) motion.push(straight(at_ms, 1));
  const now_ms = 5_000 + 100;
  const before = motion.at(now_ms)?.pose.x_m ?? NaN;
  expect(before).toBeCloseTo(4.85, 9);
  // It had braked to a stand meanwhile.
  motion.push({ at_ms: 5_000, pose: { x_m: 4.1, y_m: 0, heading_rad: 0 }, twist: { linear_m_s: 0, angular_rad_s: 0 } });
  expect(motion.at(now_ms)?.pose.x_m).toBeCloseTo(before, 9);
  let last_m = before;
  let last_m_s = 1;
  for (let later_ms = 20; later_ms <= 1_500; later_ms += 20) {
    const x_m = motion.at(now_ms + later_ms)?.pose.x_m ?? NaN;
    const speed_m_s = (x_m - last_m) / 0.02;
    expect(Math.abs(speed_m_s)).toBeLessThan(2.5);
    // Neither does its speed make a step beyond that of the braking itself.
    if (later_ms > 200) expect(Math.abs(speed_m_s - last_m_s)).toBeLessThan(0.5);
    [last_m, last_m_s] = [x_m, speed_m_s];
  }
  expect(last_m).toBeCloseTo(4.1, 9);
  expect(motion.at(now_ms + 1_520)?.isMoving).toBe(false);
});

test('a robot that slows down is carried on to where it will stand, and not beyond', () => {
  const motion = new Motion();
  motion.push(straight(0, 1));
  // From 1 to 0.5 m/s within a second: it stands a second later, 0.25 m farther.
  motion.push({ at_ms: 1_000, pose: { x_m: 0.75, y_m: 0, heading_rad: 0 }, twist: { linear_m_s: 0.5, angular_rad_s: 0 } });
  const at = (later_ms: number) => motion.at(1_000 + motion.delay_ms + later_ms)?.pose.x_m;
  expect(at(500)).toBeCloseTo(0.75 + 0.5 * 0.5 - 0.25 * 0.25, 9);
  expect(at(1_000)).toBeCloseTo(1, 9);
  expect(at(1_150)).toBeCloseTo(1, 9);
});

test('a robot that is no longer heard is carried no farther, and goes on from there when it is heard again', () => {
  const motion = driven(1, 8_000);
  const at = (now_ms: number) => motion.at(now_ms + motion.delay_ms);
  const held = at(8_300);
  motion.hold();
  expect(held?.isMoving).toBe(true);
  for (const now_ms of [8_300, 8_320, 8_900]) expect(at(now_ms)).toEqual({ ...held, isMoving: false, isFrozen: true });
  motion.hold();
  expect(at(8_950)?.pose).toEqual(held?.pose);
  // It had driven on.
  motion.push(straight(9_000, 1));
  let last_m = held?.pose.x_m ?? NaN;
  for (let now_ms = 8_970; now_ms < 9_800; now_ms += 20) {
    const shown = at(now_ms);
    expect(Math.abs((shown?.pose.x_m ?? NaN) - last_m)).toBeLessThan(0.08);
    last_m = shown?.pose.x_m ?? NaN;
    expect(shown?.isFrozen).toBe(false);
  }
  expect(last_m).toBeCloseTo(9.79, 1);
});

test('states that come twice as often are drawn half as late, and seldom ones no later than a quarter of a second', () => {
  const motion = new Motion();
  for (let at_ms = 0; at_ms <= 4_000; at_ms += 100) motion.push(straight(at_ms, 1));
  expect(motion.delay_ms).toBeLessThan(130);
  expect(driven(1, 8_000).delay_ms).toBeGreaterThan(200);
  const seldom = new Motion();
  for (let at_ms = 0; at_ms <= 20_000; at_ms += 1_000) seldom.push(straight(at_ms, 1));
  expect(seldom.delay_ms).toBe(DELAY_MAX_MS);
});

test('a heading turns the short way, over the end of its range too', () => {
  const motion = new Motion();
  const turning = (at_ms: number, heading_rad: number): State => ({
    at_ms,
    pose: { x_m: 0, y_m: 0, heading_rad },
    twist: { linear_m_s: 0, angular_rad_s: 1 },
  });
  motion.push(turning(0, Math.PI - 0.1));
  motion.push(turning(PERIOD_MS, -Math.PI + 0.1));
  const shown = motion.at(PERIOD_MS / 2 + motion.delay_ms);
  expect(Math.cos(shown?.pose.heading_rad ?? 0)).toBeCloseTo(-1, 9);
  for (const [from, to, turn] of [
    [0, 1, 1],
    [3, -3, 2 * Math.PI - 6],
    [-3, 3, 6 - 2 * Math.PI],
    [0, 7, 7 - 2 * Math.PI],
  ] as const) {
    expect(turnOf(from, to)).toBeCloseTo(turn, 9);
  }
});

test('a late state is bridged by the twist for a bounded time; then the robot stands, and is frozen', () => {
  const motion = driven(1, 8_000);
  const at = (late_ms: number) => motion.at(8_000 + motion.delay_ms + late_ms);
  expect(at(200)?.pose.x_m).toBeCloseTo(8.2, 9);
  expect(at(200)).toMatchObject({ isMoving: true, isFrozen: false });
  const [ended, later] = [at(EXTRAPOLATION_MAX_MS + 10), at(60_000)];
  expect(ended?.pose.x_m).toBeCloseTo(8 + EXTRAPOLATION_MAX_MS / 1000, 9);
  expect(later).toEqual(ended);
  expect(later).toMatchObject({ isMoving: false, isFrozen: true });
  // Heard again far later: it is where it is said to be, not somewhere between.
  motion.push({ ...straight(70_000, 1), pose: { x_m: 3, y_m: 0, heading_rad: 0 } });
  expect(motion.at(70_000 + motion.delay_ms)).toMatchObject({ pose: { x_m: 3 }, isFrozen: false });
});

test('a bend is carried on along its arc', () => {
  const motion = new Motion();
  motion.push({ at_ms: 0, pose: { x_m: 0, y_m: 0, heading_rad: 0 }, twist: { linear_m_s: 1, angular_rad_s: 2 } });
  const pose = motion.at(400 + motion.delay_ms)?.pose;
  // Radius 0.5 m, turned by 0.8 rad.
  expect(pose?.x_m).toBeCloseTo(0.5 * Math.sin(0.8), 9);
  expect(pose?.y_m).toBeCloseTo(0.5 * (1 - Math.cos(0.8)), 9);
  expect(pose?.heading_rad).toBeCloseTo(0.8, 9);
});

test('a jump is not driven through', () => {
  const motion = new Motion();
  const still = { linear_m_s: 0, angular_rad_s: 0 };
  motion.push({ at_ms: 0, pose: { x_m: 0, y_m: 0, heading_rad: 0 }, twist: still });
  motion.push({ at_ms: PERIOD_MS, pose: { x_m: JUMP_M + 0.1, y_m: 0, heading_rad: 0 }, twist: still });
  const { delay_ms } = motion;
  expect(motion.at(PERIOD_MS - 1 + delay_ms)).toMatchObject({ pose: { x_m: 0 }, isMoving: true });
  expect(motion.at(PERIOD_MS + delay_ms)).toMatchObject({ pose: { x_m: JUMP_M + 0.1 }, isMoving: false });
});

test('a robot that stands needs no frames, though its localisation is never quite still', () => {
  const motion = new Motion();
  const poses = new Set<number>();
  for (let state = 0; state < 50; state += 1) {
    const at_ms = state * PERIOD_MS;
    const pose = { x_m: 4 + 0.003 * Math.sin(state), y_m: 0, heading_rad: 0.002 * Math.cos(state) };
    motion.push({ at_ms, pose, twist: { linear_m_s: 0.001, angular_rad_s: -0.002 } });
    const shown = motion.at(at_ms);
    if (state > 4) expect(shown?.isMoving).toBe(false);
    poses.add(shown?.pose.x_m ?? NaN);
  }
  expect(poses.size).toBe(1);
});

test('a robot that stands says so seldom, which makes it no later when it moves again', () => {
  const motion = driven(1, 8_000);
  const { delay_ms } = motion;
  const { pose } = straight(8_000, 1);
  const still = { linear_m_s: 0, angular_rad_s: 0 };
  for (let at_ms = 9_100; at_ms < 20_000; at_ms += 1_100) motion.push({ at_ms, pose, twist: still });
  expect(motion.at(20_000)?.isMoving).toBe(false);
  expect(motion.delay_ms).toBe(delay_ms);
});

test('what is drawn never goes back in time, and states that were heard twice count once', () => {
  const motion = driven(1, 8_000);
  const now_ms = 8_000;
  const { delay_ms } = motion;
  const before = motion.at(now_ms)?.pose.x_m ?? NaN;
  motion.push(straight(8_005, 1));
  motion.push(straight(7_600, 1));
  expect(motion.delay_ms).toBe(delay_ms);
  // States that come more seldom make what is drawn later: it waits instead.
  expect(delay_ms).toBeLessThan(DELAY_MAX_MS);
  for (let at_ms = 9_000; at_ms <= 12_000; at_ms += 1_000) motion.push(straight(at_ms, 1));
  expect(motion.delay_ms).toBe(DELAY_MAX_MS);
  expect(motion.at(now_ms + 5)?.pose.x_m).toBeGreaterThanOrEqual(before);
});

test('before the first state there is nothing to draw', () => {
  expect(new Motion().at(0)).toBeNull();
});
