import { expect, test } from 'vitest';
import { CIVIDIS, STEPS } from './cividis';
import { HATCHED, RANGES, colourOf, hatchOf, shade, share } from './friction';
import { GROUND_SATURATION_MAX, groundFill } from './palette';
import { slate, teal } from './single_hue';

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
});

test('a colour of the scale of slip means nothing else on any other scale', () => {
  const shares = Array.from({ length: 101 }, (_, step) => step / 100);
  const distance = (a: readonly number[], b: readonly number[]) => Math.hypot(...a.map((channel, index) => channel - (b[index] ?? NaN)));
  for (const range of [RANGES.friction, RANGES.age, RANGES.visits]) {
    for (const share of shares) {
      const [red, , blue] = range.scale(share);
      // None of them comes near the yellow half of cividis, which is slippery ground.
      const nearest = Math.min(...shares.filter((other) => other >= 0.6).map((other) => distance(range.scale(share), RANGES.theta.scale(other))));
      expect(nearest).toBeGreaterThan(25);
      expect(blue).toBeGreaterThanOrEqual(red);
    }
  }
  expect(RANGES.theta.scale).toBe(RANGES.stiffness.scale);
  expect(colourOf(RANGES.theta, 2)).not.toEqual(colourOf(RANGES.friction, 0));
});

test('scales of one hue grow darker all along, the more there is or the better it is known', () => {
  for (const scale of [teal, slate]) {
    let last = Infinity;
    for (let step = 0; step <= 100; step += 1) {
      const [red, green, blue] = scale(step / 100);
      const bright = 0.299 * red + 0.587 * green + 0.114 * blue;
      expect(bright).toBeLessThan(last);
      last = bright;
    }
  }
  expect(shade(RANGES.friction, 1)).toBe(1);
  expect(shade(RANGES.visits, 1_000)).toBe(1);
  // What was measured just now is deep, what is a month old pale.
  expect(shade(RANGES.age, 1 / 60)).toBe(1);
  expect(shade(RANGES.age, 720)).toBe(0);
});

test('ground is grey, so that colours are those of the scale', () => {
  for (const theme of ['light', 'dark'] as const) {
    for (const kind of ['grass', 'sand', 'ice', 'mud'] as const) {
      const saturation = Number(/ (\d+)% /.exec(groundFill(kind, theme))?.[1]);
      expect(saturation).toBeLessThanOrEqual(GROUND_SATURATION_MAX);
    }
  }
});
