import { expect, test } from 'vitest';
import { CIVIDIS, STEPS, colour } from './cividis';
import { RANGES, doubt, share } from './friction';

const known = { theta: 0.2, stiffness: 5, std_dev: 0.01, newest_at: '2026-01-01T00:00:00Z', segments: 4 };

test('brightness grows along the whole colour map', () => {
  let last = -1;
  for (let step = 0; step < STEPS; step += 1) {
    const [red, green, blue] = [...CIVIDIS.subarray(step * 3, step * 3 + 3)];
    const bright = 0.299 * (red ?? 0) + 0.587 * (green ?? 0) + 0.114 * (blue ?? 0);
    expect(bright).toBeGreaterThanOrEqual(last);
    last = bright;
  }
});

test('a value outside of the range has the colour of its end', () => {
  for (const range of Object.values(RANGES)) {
    expect(share(range, range.low)).toBeCloseTo(0, 9);
    expect(share(range, range.high)).toBeCloseTo(1, 9);
    expect(share(range, range.low - 100)).toBe(0);
    expect(share(range, range.high * 100)).toBe(1);
    expect(range.ticks.at(0)).toBe(range.low);
    expect(range.ticks.at(-1)).toBe(range.high);
  }
});

test('what is unsure is grey, what is sure has its colour', () => {
  const as = (std_dev: number) => doubt({ ...known, std_dev } as Parameters<typeof doubt>[0]);
  expect(as(0.005)).toBe(0);
  expect(as(0.2)).toBe(1);
  const [red, green, blue] = colour(1, 1);
  expect(red).toBe(green);
  expect(green).toBe(blue);
  expect(colour(1, 0)).not.toEqual(colour(1, 1));
});
