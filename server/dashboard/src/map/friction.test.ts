import { expect, test } from 'vitest';
import { CIVIDIS, STEPS } from './cividis';
import { HATCHED, RANGES, hatchOf, shade, share } from './friction';
import { GROUND_SATURATION_MAX, groundFill } from './palette';

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

test('the less sure a value is, the denser it is hatched, and nothing else', () => {
  const as = (std_dev: number) => hatchOf({ ...known, std_dev } as Parameters<typeof hatchOf>[0]);
  const [some, more, most] = HATCHED.map((relative) => relative * known.theta * 1.001);
  expect([0, 0.019, some, more, most, 9].map((std_dev) => as(std_dev ?? NaN))).toEqual([0, 0, 1, 2, 3, 3]);
});

test('slippery ground has the same colour whatever of it is shown', () => {
  for (const theta of [0.06, 0.2, 0.9]) {
    expect(shade(RANGES.stiffness, 1 / theta)).toBeCloseTo(shade(RANGES.theta, theta), 9);
  }
  expect(shade(RANGES.theta, 2)).toBe(1);
  expect(shade(RANGES.friction, 1)).toBe(0);
});

test('ground is grey, so that colours are those of the scale', () => {
  for (const theme of ['light', 'dark'] as const) {
    for (const kind of ['grass', 'sand', 'ice', 'mud'] as const) {
      const saturation = Number(/ (\d+)% /.exec(groundFill(kind, theme))?.[1]);
      expect(saturation).toBeLessThanOrEqual(GROUND_SATURATION_MAX);
    }
  }
});
