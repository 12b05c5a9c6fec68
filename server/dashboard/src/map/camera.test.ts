import { expect, test } from 'vitest';
import { Camera, boundsOf, roundUp } from './camera';

function camera(): Camera {
  const made = new Camera();
  made.width = 800;
  made.height = 600;
  return made;
}

/** Seeded, so that a failure can be repeated. */
function* places(count: number): Generator<{ x: number; y: number }> {
  let state = 12_345;
  const next = () => (state = (state * 1_103_515_245 + 12_345) % 2 ** 31) / 2 ** 31;
  for (let index = 0; index < count; index += 1) yield { x: next() * 800, y: next() * 600 };
}

test('pixels to metres and back is the same place, after any pan and zoom', () => {
  const made = camera();
  for (const at of places(200)) {
    made.pan(at.x - 400, at.y - 300);
    made.zoom(at.x / 400 + 0.3, at);
    const back = made.toPx(made.toM(at));
    expect(back.x).toBeCloseTo(at.x, 6);
    expect(back.y).toBeCloseTo(at.y, 6);
  }
});

test('a zoom keeps what is under the pointer', () => {
  const made = camera();
  for (const at of places(100)) {
    const before = made.toM(at);
    made.zoom(1.3, at);
    const after = made.toM(at);
    expect(after.x_m).toBeCloseTo(before.x_m, 6);
    expect(after.y_m).toBeCloseTo(before.y_m, 6);
    made.zoom(1 / 1.3);
  }
});

test('up on the screen is north', () => {
  const made = camera();
  expect(made.toM({ x: 0, y: 0 }).y_m).toBeGreaterThan(made.toM({ x: 0, y: 1 }).y_m);
});

test('a fit shows everything', () => {
  const made = camera();
  const points = [...places(20)].map(({ x, y }) => ({ x_m: x * 3 - 900, y_m: y - 77 }));
  const bounds = boundsOf(points);
  expect(bounds).not.toBeNull();
  if (bounds) made.fit(bounds);
  for (const point of points) {
    const { x, y } = made.toPx(point);
    expect(x).toBeGreaterThanOrEqual(0);
    expect(x).toBeLessThanOrEqual(800);
    expect(y).toBeGreaterThanOrEqual(0);
    expect(y).toBeLessThanOrEqual(600);
  }
});

/** Panels of the page, on canvases of a desk and of a phone. */
const COVERED = [
  [{ left: 550, top: 10, right: 790, bottom: 480 }],
  [
    { left: 550, top: 0, right: 800, bottom: 600 },
    { left: 10, top: 10, right: 160, bottom: 44 },
    { left: 10, top: 350, right: 310, bottom: 560 },
  ],
  [
    { left: 10, top: 380, right: 790, bottom: 590 },
    { left: 500, top: 10, right: 790, bottom: 44 },
  ],
];

test('a fit and a place that is shown stay clear of what covers the canvas', () => {
  for (const covered of COVERED) {
    const isFree = (point: { x_m: number; y_m: number }) => {
      const { x, y } = made.toPx(point);
      expect(x).toBeGreaterThanOrEqual(0);
      expect(x).toBeLessThanOrEqual(800);
      expect(y).toBeGreaterThanOrEqual(0);
      expect(y).toBeLessThanOrEqual(600);
      for (const { left, top, right, bottom } of covered) {
        expect(x > left && x < right && y > top && y < bottom).toBe(false);
      }
    };
    const made = camera();
    for (const [width, height] of [
      [36, 28],
      [200, 2],
      [1, 90],
    ] as const) {
      made.fit({ xMin: 5, yMin: -3, xMax: 5 + width, yMax: -3 + height }, covered);
      for (const point of places(100)) isFree({ x_m: 5 + (width * point.x) / 800, y_m: -3 + (height * point.y) / 600 });
    }
    made.showPlace({ x_m: 70, y_m: -40 }, 40, covered);
    expect(made.scale).toBe(40);
    isFree({ x_m: 70, y_m: -40 });
  }
});

test('a canvas that is covered as a whole is fitted as a whole', () => {
  const [made, other] = [camera(), camera()];
  const bounds = { xMin: 0, yMin: 0, xMax: 30, yMax: 20 };
  made.fit(bounds, [{ left: -5, top: -5, right: 805, bottom: 605 }]);
  other.fit(bounds);
  expect(made.center).toEqual(other.center);
  expect(made.scale).toBe(other.scale);
  expect(made.center).toEqual({ x_m: 15, y_m: 10 });
});

test('round lengths are 1, 2 or 5 and never less than asked for', () => {
  expect([0.011, 0.2, 3, 7, 10, 4_999].map(roundUp)).toEqual([0.02, 0.2, 5, 10, 10, 5_000]);
});
